"""Table 8.3: how long a fleet of 4 arms communicates in a step, over the network and over SSH and SFTP.

A step is an action to every robot and the image after it from every robot, without learning and motion. The published
numbers are of arms, a server and a link between buildings or states; ours are of processes on one machine, so they are what
the software takes. Both ways of using SSH are measured: connections that are kept open, and new ones for each step.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tutelage.errors import ConfigError, TutelageError
from tutelage.files import write_atomic

PUBLISHED = {"SSH + SFTP": 0.86, "FogROS2-SGC": 0.31}
"""Seconds, with the server in Berkeley; with the server in Pittsburgh it is 0.58 s, and SSH is stopped by a firewall."""

NAMES = {
    "ssh_sftp_each": "SSH + SFTP, new connections at each step",
    "ssh_sftp_open": "SSH + SFTP, connections kept open",
    "ours": "Tutelage: end-to-end encryption, over a router (TLS)",
}


@dataclass(frozen=True)
class Table83Config:
    """What to measure.

    Attributes:
        robots: N.
        steps: of ours; of SSH a fifteenth of it.
        sizes: of the images, height and width.
        results: folder of the small result file.
    """

    robots: int = 4
    steps: int = 200
    sizes: tuple[tuple[int, int], ...] = ((64, 64), (480, 640))
    results: Path = Path("results/single/table-8.3")

    def __post_init__(self) -> None:
        if not 1 <= self.robots <= 64 or self.steps < 5 or not self.sizes:
            raise ConfigError(f"table-8.3 needs 1 to 64 robots, 5 steps and a size; got {self.robots}, {self.steps}")


def reproduce(config: Table83Config) -> str:
    """Measure; returns the table as Markdown.

    Raises:
        TutelageError: the measurement failed, for instance as the extra sgc is missing.
    """
    results = [measure(config.robots, config.steps, size) for size in config.sizes]
    for result in results:
        name = "x".join(str(n).rjust(4, "0") for n in result["image"][:2])
        write_atomic(config.results / f"images-{name}.json", (json.dumps(result, indent=1) + "\n").encode())
    return table(results)


def measure(robots: int, steps: int, size: tuple[int, int]) -> dict[str, Any]:
    """One size of images, in a process of its own: this package does not know the one that it measures."""
    words = ["--robots", robots, "--steps", steps, "--ssh-steps", max(1, steps // 15), "--size", f"{size[0]}x{size[1]}"]
    command = [sys.executable, "-m", "tutelage.remote.steptime", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines()
        raise TutelageError(said[-1] if said else f"the measurement ended with {done.returncode}")
    return dict(json.loads(done.stdout))


def table(results: list[dict[str, Any]]) -> str:
    """A row for each way, the published numbers above ours, as Markdown."""
    sizes = " | ".join(f"{r['image'][1]} x {r['image'][0]}, median (p99)" for r in results)
    lines = [
        f"Seconds of communication in a step of a fleet of {results[0]['robots']} robots (table 8.3): an action to each, "
        "an image from each. Ours: processes on one machine.",
        "",
        f"| | published | {sizes} |",
        "| --- | ---: |" + " ---: |" * len(results),
    ]
    for name, title in NAMES.items():
        published = {"ssh_sftp_each": PUBLISHED["SSH + SFTP"], "ours": PUBLISHED["FogROS2-SGC"]}.get(name)
        cells = [_cell(r["rows"][name]) for r in results]
        lines.append(f"| {title} | {'–' if published is None else f'{published:.2f}'} | {' | '.join(cells)} |")  # noqa: RUF001
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any]) -> str:
    return str(row["why_not"]) if "why_not" in row else f"{row['p50']:.4f} ({row['p99']:.3f})"
