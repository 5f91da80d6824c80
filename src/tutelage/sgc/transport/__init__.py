"""How bytes move: one seam (`base`), in one process (`memory`) or over Zenoh (`zenoh`). Nothing here holds a key."""
