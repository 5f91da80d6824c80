"""A server of the tests, to be killed: drives all robots slowly to and fro. `python server.py HOME`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from tutelage.remote.fleet import RemoteFleet

fleet = RemoteFleet.connect(Path(sys.argv[1]), hz=20.0)
fleet.reset()
print("Ctrl-C ends it", flush=True)
for step in range(1 << 30):
    *_, info = fleet.step(np.full((fleet.num_envs, 2), 0.1 if step // 20 % 2 else -0.1, np.float32))
    print("online", *info["online"].astype(int), flush=True)
