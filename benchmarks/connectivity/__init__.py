"""Connectivity against what others use, between processes, shared memory off, every payload checked.

`python -m benchmarks connectivity` measures round trips and rates on loopback, a directory of 10,000 names, the time from
start to first message, and round trips over an emulated wide-area network.
"""

from benchmarks.connectivity.measure import run

__all__ = ["run"]
