"""A cell that is changed by hand and judged at once: a session, and its page in a browser."""
