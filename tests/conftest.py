"""What all tests share: one thread, and random examples that are the same in every run."""

from __future__ import annotations

import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("tutelage", derandomize=True, deadline=None, database=None, max_examples=60)
settings.load_profile("tutelage")
