"""The report of a study: pictures for print, tables, a self-contained page, an animation."""
