"""How a carry, a front and a timing look in a terminal and in a notebook.

objects, table: texts and HTML tables. svg: plots as inline pictures. scene: the cell in
three dimensions, for notebooks and for the report's page. Nothing here needs Matplotlib.
"""
