"""Display of carries, fronts and timings in a terminal and in a notebook.

objects, table: texts and HTML tables, with plots as inline pictures. scene: the cell in three
dimensions, for notebooks and for the page of a report. Plots need Matplotlib.
"""
