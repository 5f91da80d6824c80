"""Run folders in memory: what a finished, running or interrupted run wrote down, checked as it is read."""

from __future__ import annotations

import json
import math
import os
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ContractError, RunFolderError
from tutelage.fleet.attempts import attempts, request_rate
from tutelage.fleet.events import Events
from tutelage.fleet.metrics import EventLog, intervention_lengths, summary

Array = NDArray[Any]

MOST = 10**8
"""Robots or humans beyond which a number in a file is taken for damage, before memory is asked for."""


@dataclass(frozen=True)
class RunRecord:
    """A run folder in memory.

    Attributes:
        path: the folder.
        config: the resolved configuration.
        metrics: columns of metrics.jsonl by name, (K,) float64 each, NaN where a line does not have it; always `t`,
            completed timesteps, increasing.
        log: the events of the first t timesteps.
        evaluation: results of the evaluation after training by name; empty if there was none.
    """

    path: Path
    config: dict[str, Any]
    metrics: dict[str, Array]
    log: EventLog
    evaluation: dict[str, float]

    @property
    def label(self) -> str:
        """The algorithm: runs with the same label differ by their seed only."""
        return str(self.config.get("algorithm") or self.config.get("priority") or "run")

    @property
    def name(self) -> str:
        """The name of the folder."""
        return self.path.resolve().name

    @property
    def steps(self) -> int:
        """Completed timesteps."""
        return self.log.steps

    @cached_property
    def final(self) -> dict[str, float]:
        """The metrics at the end by name, with those that only the event log and the evaluation tell."""
        values = {name: float(column[-1]) for name, column in self.metrics.items() if not name.startswith("loss/")}
        lengths = intervention_lengths(self.log)
        values["intervention_length"] = float(np.median(lengths)) if len(lengths) else math.nan
        values["request_rate"] = request_rate(self.log)
        tried = attempts(self.log)
        if len(tried.robot):
            values["episode/interventions"] = float(tried.interventions.mean())
            values["episode/human_actions"] = float(tried.human_actions.mean())
            values["episode/robot_actions"] = float(tried.robot_actions.mean())
        return values | {f"evaluation/{name}": value for name, value in self.evaluation.items()}

    @cached_property
    def disagreement(self) -> str:
        """Which counts the event log does not confirm; empty if it confirms all (it may lag behind after a crash)."""
        counted = summary(self.log)
        wrong = [
            f"{name} {self.final[name]:,.0f} in metrics.jsonl, {value:,.0f} in events.sqlite"
            for name, value in counted.items()
            if isinstance(value, int) and name in self.final and self.final[name] != value
        ]
        return "; ".join(wrong)


def load_run(path: Path | str) -> RunRecord:
    """Read a run folder.

    Raises:
        RunFolderError: it is not a run folder, or a file in it is missing, damaged or of another schema.
    """
    path = Path(path)
    if not os.path.isfile(path / "config.json"):  # unlike a Path's, it says no where nothing may be read
        if path.is_dir() and not os.access(path, os.X_OK):
            raise RunFolderError(f"cannot read {path}: Permission denied")
        reason = "it has no config.json" if path.is_dir() else "no such folder"
        raise RunFolderError(f"{path} is not a run folder: {reason}; give a folder that `tutelage run` wrote")
    config = _object(path / "config.json", _parse(path / "config.json", _text(path / "config.json")))
    metrics = _read_metrics(path / "metrics.jsonl")
    size: dict[str, int] = {}
    for key in ("robots", "humans"):
        value = config.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MOST:
            raise RunFolderError(f"{path / 'config.json'} is damaged: {key!r} must be a positive number, got {value!r}")
        size[key] = value
    log = _read_log(path / "events.sqlite", size["robots"], size["humans"], steps=int(metrics["t"][-1]))
    evaluation: dict[str, float] = {}
    if (path / "evaluation.json").exists():
        evaluation = _object(path / "evaluation.json", _parse(path / "evaluation.json", _text(path / "evaluation.json")))
        evaluation = {name: float(value) for name, value in evaluation.items() if _is_number(value)}
    return RunRecord(path, config, metrics, log, evaluation)


def run_folders(paths: Sequence[Path | str], say: Callable[[str], None] = lambda line: None) -> list[Path]:
    """The run folders that are meant: each path itself, or those in it. What a report left beside them is passed over.

    Of several, so are folders that hold no run, such as that of an expert or of a run in preparation, and runs without a
    line of metrics.

    Args:
        paths: as a user names them.
        say: told what was passed over, if it is not a report's.

    Raises:
        RunFolderError: a path is no run folder, and holds none.
    """
    found: dict[Path, None] = {}
    for path in map(Path, paths):
        within = [one.parent for one in sorted(path.glob("*/config.json"))]
        if os.path.isfile(path / "config.json") or not within:
            if len(paths) > 1 and (path.name == "report.html" or _holds_only(path, "curves.png")):
                continue
            within = [path]
        found |= dict.fromkeys(within)
    reasons = {path: reason for path in found if (reason := _nothing_in(path))}
    if 0 < len(reasons) < len(found):
        for path, reason in reasons.items():
            del found[path]
            say(f"passed over {path}: {reason}")
    return list(found)


def _nothing_in(folder: Path) -> str:
    """Why there is nothing to report of a folder yet; empty if there is, or something is wrong with it."""
    if not folder.is_dir() or not os.access(folder, os.X_OK):
        return ""
    if not (folder / "config.json").exists():
        return "it holds no run"
    lines = folder / "metrics.jsonl"
    return "it has not completed a step yet" if lines.is_file() and not lines.stat().st_size else ""


def _holds_only(folder: Path, name: str) -> bool:
    return folder.is_dir() and os.access(folder, os.R_OK) and [entry.name for entry in folder.iterdir()] == [name]


def load_runs(paths: Sequence[Path | str]) -> list[RunRecord]:
    """Read run folders, at least one."""
    if not paths:
        raise RunFolderError("no run folder given; give one or more folders that `tutelage run` wrote")
    return [load_run(path) for path in paths]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RunFolderError(f"{path} is missing") from None
    except UnicodeDecodeError:
        raise RunFolderError(f"{path} is damaged: not text") from None
    except OSError as error:
        raise RunFolderError(f"cannot read {path}: {error.strerror}") from None


def _parse(where: Path | str, text: str) -> Any:
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        reason = error.msg if isinstance(error, json.JSONDecodeError) else "nested too deeply"
        raise RunFolderError(f"{where} is damaged: {reason}") from None


def _object(where: Path | str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RunFolderError(f"{where} is damaged: expected an object, got {type(value).__name__}")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _read_metrics(path: Path) -> dict[str, Array]:
    text = _text(path)
    lines = text.split("\n")
    lines.pop()  # empty, or a line that is still being written or was cut off by a crash
    rows: list[dict[str, float]] = []
    for k, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        where = f"{path}, line {k},"
        row = _object(where, _parse(where, line))
        for name, value in row.items():
            if value is not None and not _is_number(value):
                raise RunFolderError(f"{where} is damaged: {name!r} is not a number")
        t = row.get("t")
        if not isinstance(t, int | float) or not 0 <= t < 2**53 or t != int(t):
            raise RunFolderError(f"{where} is damaged: 't' must be a number of timesteps, got {t!r}")
        while rows and rows[-1]["t"] >= t:  # a resumed run repeats what came after its checkpoint
            rows.pop()
        rows.append(row)
    if not rows:
        raise RunFolderError(f"{path} is empty: the run has not completed a step yet")
    names = {name: None for row in rows for name in row}  # a set that keeps its order
    missing = math.nan
    return {
        name: np.array([missing if row.get(name) is None else row[name] for row in rows], dtype=np.float64) for name in names
    }


def _read_log(path: Path, robots: int, humans: int, steps: int) -> EventLog:
    if not path.is_file():
        raise RunFolderError(f"{path} is missing")
    uri = path.resolve().as_uri() + "?mode=ro"
    if not any(path.with_name(path.name + suffix).exists() for suffix in ("-wal", "-journal")):
        uri += "&immutable=1"  # nobody writes; SQLite must not want to create files in a folder that may be read-only
    query = "SELECT t, robot, human, event, mode FROM events WHERE t < ? ORDER BY rowid"
    try:
        connection = sqlite3.connect(uri, uri=True, timeout=10)
        try:
            rows = connection.execute(query, (steps,)).fetchall()
        finally:
            connection.close()
        columns = np.array(rows, dtype=np.int64).reshape(-1, 5).T
        return EventLog(Events(*columns), robots, humans, steps)
    except (sqlite3.Error, ValueError, TypeError, OverflowError, ContractError) as error:
        raise RunFolderError(f"{path} is damaged: {error}") from None
