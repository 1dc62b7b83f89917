"""Research programs: what the methods reach and cost, and the plain reference of both."""
