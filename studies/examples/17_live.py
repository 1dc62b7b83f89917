"""Change a cell by hand in a browser."""

import hybrid_opt as ho

page = ho.live(ho.example("rack"))
print("open", page.url)
page.close()
