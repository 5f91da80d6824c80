"""Counts by name, from several threads."""

from __future__ import annotations

import threading


class Counts:
    """Numbers that go up. All names are given at the start, so that what never happened shows as 0."""

    def __init__(self, *names: str) -> None:
        self._counts = dict.fromkeys(names, 0)
        self._lock = threading.Lock()

    def add(self, name: str, count: int = 1) -> None:
        """Count."""
        with self._lock:
            self._counts[name] += count

    def as_dict(self, **more: int) -> dict[str, int]:
        """A copy, with further numbers."""
        with self._lock:
            return {**self._counts, **more}
