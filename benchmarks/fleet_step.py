"""A fleet step over the network: an action to every robot and the image after it from every robot (table 8.3).

Robots, router and server are processes of their own; beside it SSH and SFTP on the same machine, if OpenSSH is installed.
"""

from __future__ import annotations

from typing import Any

from benchmarks.timing import table
from tutelage.experiments.table_8_3 import NAMES, PUBLISHED, measure

SIZES = ((64, 64), (480, 640))


def run(quick: bool = False) -> dict[str, Any]:
    """Milliseconds of a step of 4 robots."""
    steps = 50 if quick else 300
    results = [measure(4, steps, size) for size in SIZES]
    rows = [
        [f"4 robots, {height} x {width}: {name}", *_times(result["rows"][key])]
        for (height, width), result in zip(SIZES, results, strict=True)
        for key, name in NAMES.items()
    ]
    print(table(["ms a step", "mean", "median", "p99"], rows))
    print(f"\npublished: {1000 * PUBLISHED['FogROS2-SGC']:.0f} ms, SSH + SFTP {1000 * PUBLISHED['SSH + SFTP']:.0f} ms")
    return {"fleet step": results}


def _times(row: dict[str, Any]) -> list[Any]:
    return [row["why_not"], "", ""] if "why_not" in row else [1000 * row[key] for key in ("mean", "p50", "p99")]
