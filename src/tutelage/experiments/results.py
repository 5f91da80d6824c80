"""The small result files that `tutelage.experiments.study` writes, one a run, grouped by task and algorithm."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks import TASKS
from tutelage.errors import RunFolderError

Array = NDArray[Any]

ALGORITHMS = {
    "C. (BC)": "Behaviour cloning (C.)",
    "Random": "Random",
    "U.C.": "Fleet-EnsembleDAgger (U.C.)",
    "U.G.C.": "Fleet-ThriftyDAgger (U.G.C.)",
    "C.U.R.(-i)": "C.U.R.(-i)",
    "C.U.": "C.U.",
    "C.R.": "C.R.",
    "U.R.": "U.R.",
    "U.": "U.",
    "R.": "R.",
    "C.U.R.": "C.U.R.",
}
"""Algorithms in the order of their rows, and their names in tables."""
OURS = "C.U.R."


class Column(NamedTuple):
    """A column of a table: a metric, its title, whether more (+1) or less (-1) is better, decimals."""

    metric: str
    title: str
    better: int
    digits: int = 1


ONLINE = (
    Column("successes", "Successes", +1),
    Column("hard_resets", "Hard resets", -1),
    Column("idle_time", "Idle time", -1),
    Column("human_time", "Human time", -1),
    Column("rohe", "ROHE", +1, 3),
)
FROZEN = ONLINE[:3]


@dataclass(frozen=True)
class Group:
    """The runs of one algorithm on one task, by seed. At least one."""

    algorithm: str
    results: tuple[dict[str, Any], ...]

    @property
    def title(self) -> str:
        """The name in tables."""
        return ALGORITHMS.get(self.algorithm, self.algorithm)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds, in order."""
        return tuple(int(r["seed"]) for r in self.results)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration of the first run."""
        config: dict[str, Any] = self.results[0]["config"]
        return config

    def values(self, metric: str, part: str = "metrics") -> Array:
        """A number of every run that has it, (n,): `part` is metrics, evaluation or expert."""
        return np.array([float(r[part][metric]) for r in self.results if part in r])

    def mean(self, metric: str, part: str = "metrics") -> float:
        """The mean of `values`; NaN if there are none."""
        values = self.values(metric, part)
        return float(values.mean()) if len(values) else math.nan

    def text(self, column: Column, part: str = "metrics") -> str:
        """Mean and standard deviation over the runs, such as "746.3 ± 40.5"; one run has no deviation."""
        values = self.values(column.metric, part)
        if not len(values):
            return "–"  # noqa: RUF001 - an en dash
        mean = f"{values.mean():,.{column.digits}f}"
        return mean if len(values) == 1 else f"{mean} ± {values.std():,.{column.digits}f}"

    def band(self, metric: str) -> tuple[Array, Array, Array]:
        """Timesteps, mean and one standard deviation over the runs of a curve, (k,) each."""
        curves = [(np.array(r["curves"]["t"]), np.array(r["curves"][metric])) for r in self.results]
        end = min(t[-1] for t, _ in curves)
        grid = np.linspace(0.0, end, 61)  # a result file has 50 points
        values = np.array([np.interp(grid, np.append(0, t), np.append(0, v)) for t, v in curves])
        return grid, values.mean(axis=0), values.std(axis=0)


Groups = dict[str, Group]


def read(results: Path, kind: str) -> dict[str, Groups]:
    """The result files of a kind ("comparison" or "ablations"): task -> algorithm -> runs, in the order of the tables.

    Raises:
        RunFolderError: a file is damaged.
    """
    tasks: dict[str, Groups] = {}
    folders = {folder.name: folder for folder in (results / kind).glob("*") if folder.is_dir()}
    for task in in_order(folders, TASKS):
        found: dict[str, list[dict[str, Any]]] = {}
        for path in sorted(folders[task].glob("*.json")):
            result = _read(path)
            found.setdefault(str(result["algorithm"]), []).append(result)
        if found:
            tasks[task] = {
                name: Group(name, tuple(sorted(found[name], key=lambda r: int(r["seed"]))))
                for name in in_order(found, ALGORITHMS)
            }
    return tasks


def _read(path: Path) -> dict[str, Any]:
    try:
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        missing = {"algorithm", "seed", "metrics", "curves", "config"} - set(result)
    except (OSError, ValueError, TypeError) as error:
        raise RunFolderError(f"{path} is damaged: {error}") from None
    if missing:
        raise RunFolderError(f"{path} is no result of tutelage.experiments.study: it lacks {', '.join(sorted(missing))}")
    return result


def in_order(names: Iterable[str], known: Iterable[str]) -> list[str]:
    """The names in the order in which they are known; unknown ones follow, in alphabetical order."""
    order = {name: k for k, name in enumerate(known)}
    return sorted(names, key=lambda name: (order.get(name, len(order)), name))
