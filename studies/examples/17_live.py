"""Change a cell by hand in a browser.

`ho.live` serves a cell to a browser of this machine; a notebook shows it in its cell. What is
dragged there is judged at once. `hybrid_opt.extras.workbench.Session` is the same without a
browser. It needs `pip install "dual-arm-carry[live]"`.
"""

import hybrid_opt as ho

page = ho.live(ho.example("rack"))
print("open", page.url)
page.close()
