"""Display of carries, fronts and timings in a terminal and in a notebook.

objects, table: texts and HTML tables, plots as inline pictures. scene: the cell in three
dimensions, for notebooks and the report's page. Plots need Matplotlib.
"""
