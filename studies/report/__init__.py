"""The report of a study: pictures for print, tables, a self-contained page, an animation."""

PAGE = "report.html"
PICTURES = "figures"
TABLES = "tables"
"""Names of the page and of the folders of pictures and tables in a results folder."""
