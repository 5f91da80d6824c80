"""Supervised autonomy for robot fleets: a few people keep many robots working, every intervention makes the fleet better."""

import os

__version__ = "0.1.0"

# After each product, the OpenMP threads of PyTorch spin in the hope of more, and take the cores from physics, which comes
# next. This tells libgomp to spin for a shorter time than it would. It reads this when PyTorch is first imported; what the
# user has set stays.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
