"""Look at a carry in three dimensions, in a page of its own.

`carry.view()` shows the carry in a notebook's cell. Elsewhere it is saved as one page that needs no
network.
"""

from pathlib import Path

import hybrid_opt as ho

cell = ho.example("rack")
carry = cell.carry(cell.initial)
Path("out").mkdir(exist_ok=True)
carry.view().save("out/view.html")
print("open out/view.html in a browser; in a notebook, carry.view() is enough")
