"""The report of a study: figures for print, tables, a self-contained page, an animation."""
