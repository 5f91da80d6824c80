"""Timing on a machine that may be busy: variants take turns in one process, and medians of ratios are what counts."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch


def take_turns(
    variants: Mapping[str, Callable[[], Any]], rounds: int, before: Mapping[str, Callable[[], Any]] | None = None
) -> dict[str, list[float]]:
    """Seconds of each call of each variant, by name. Each round calls all of them, beginning with another one.

    before: what a variant needs beforehand and is not part of its time.
    """
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    names = list(variants)
    for k in range(rounds):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            (before or {}).get(name, lambda: None)()
            start = time.perf_counter()
            variants[name]()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def ratio(seconds: Mapping[str, Sequence[float]], above: str, *below: str) -> float:
    """Median over rounds of the time of `above` over the summed times of `below`: what loads a round cancels out."""
    return float(np.median(np.array(seconds[above]) / np.sum([seconds[name] for name in below], axis=0)))


class Phases:
    """Where the time of a loop goes: exclusive seconds by phase, of the thread that runs it.

    A phase inside another one is taken off it.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside = [0.0]

    @property
    def open(self) -> bool:
        """Whether a phase is being timed."""
        return len(self._inside) > 1

    def watch(self, owner: Any, method: str, phase: str) -> None:
        """Time a method of an object, or a function of a module, from now on."""
        setattr(owner, method, self.timed(getattr(owner, method), phase))

    def timed(self, inner: Callable[..., Any], phase: str) -> Callable[..., Any]:
        """The same function, timed."""

        def call(*args: Any, **kwargs: Any) -> Any:
            with self.phase(phase):
                return inner(*args, **kwargs)

        return call

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time a block."""
        start = time.perf_counter()
        self._inside.append(0.0)
        try:
            yield
        finally:
            took = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + took - self._inside.pop()
            self._inside[-1] += took


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table whose columns line up: the first to the left, numbers to the right."""
    cells = [[str(c) if not isinstance(c, float) else _number(c) for c in row] for row in [head, *rows]]
    width = [max(len(row[k]) for row in cells) for k in range(len(head))]
    lines = ["| " + " | ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, width, strict=True)))
             + " |" for row in cells]  # fmt: skip
    rule = "|" + "|".join("-" * (w + 2) if k == 0 else "-" * (w + 1) + ":" for k, w in enumerate(width)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def _number(x: float) -> str:
    return f"{x:,.0f}" if abs(x) >= 100 else f"{x:.3g}" if abs(x) < 1 else f"{x:.2f}"


def machine() -> dict[str, Any]:
    """What the numbers were measured on, and how busy it was with other work."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    info = Path("/proc/cpuinfo")
    models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")] \
        if info.exists() else []  # fmt: skip
    names = ("tutelage", "numpy", "torch", "mujoco", "gymnasium", "numba", "cryptography")
    there = {found.name.lower() for found in metadata.distributions() if found.name}
    packages = {name: metadata.version(name) for name in names if name in there}
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": cores,
        "simd": torch.backends.cpu.get_cpu_capability(),
        "load_average_before": round(os.getloadavg()[0], 1),
        "niceness": os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0,
        "system": platform.platform(),
        "python": platform.python_version(),
        **packages,
    }
