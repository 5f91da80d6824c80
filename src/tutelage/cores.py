"""How many cores there are for physics and for matrix products."""

from __future__ import annotations

import os


def available_cores() -> int:
    """How many cores this process may use (respects affinity masks)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def default_torch_threads() -> int:
    """Threads of matrix products: those of a policy are too small for more than four."""
    return min(4, available_cores())
