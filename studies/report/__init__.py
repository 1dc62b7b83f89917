"""The report of a study: pictures for print, tables, a self-contained page, an animation."""

PAGE = "report.html"
PICTURES = "figures"
TABLES = "tables"
"""Places in a results folder."""
