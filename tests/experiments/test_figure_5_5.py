"""Figure 5.5 with operators at consoles: which trials, which table. What a trial does is tested with the console."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments import figure_5_5
from tutelage.experiments.figure_5_5 import ALGORITHMS, Figure55Config, reproduce, table
from tutelage.experiments.reproduction import reproduce as by_name


def result(algorithm: str, seed: int, value: float) -> dict[str, Any]:
    metrics = {
        "successes": value,
        "hard_resets": 10 - value,
        "idle_time": 100 - value,
        "rohe": value / 100,
        "human_time": 50,
    }
    config = {"task": "BlockPushing", "robots": 4, "humans": 2, "steps": 250}
    return {"algorithm": algorithm, "seed": seed, "metrics": metrics, "config": config}


def test_the_table_says_which_statements_hold() -> None:
    results = [result(a, s, 9 - 2 * k) for k, a in enumerate(ALGORITHMS) for s in (0, 1)]
    assert table(results).count("| yes |") == 4
    results[2]["metrics"]["successes"] = results[3]["metrics"]["successes"] = 30
    assert "| the most successes | no: U.C. |" in table(results)


def test_trials_are_processes_that_are_not_repeated_and_random_gets_the_human_time_of_cur(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[dict[str, Any]] = []

    def run(command: list[str], **rest: Any) -> subprocess.CompletedProcess[str]:
        settings = json.loads(command[-1])
        asked.append(settings)
        said = "a warning\n" + json.dumps(result(settings["priority"], settings["seed"], 1.0))
        return subprocess.CompletedProcess(command, 0, said, "")

    monkeypatch.setattr(figure_5_5.subprocess, "run", run)
    reproduce(Figure55Config(seeds=(0, 1), results=tmp_path))
    assert [(s["priority"], s["seed"]) for s in asked] == [(a, s) for s in (0, 1) for a in ALGORITHMS]
    assert [s["learner"] for s in asked[:4]] == [True, True, True, False]
    assert ["random" in s for s in asked[:4]] == [False, False, True, False]
    reproduce(Figure55Config(seeds=(0, 1), results=tmp_path))
    assert len(asked) == 8, "what is there is not run again"


def test_what_a_trial_says_on_failing_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    failed = subprocess.CompletedProcess([], 1, "", "noise\ntutelage: it needs the extra console\n")
    monkeypatch.setattr(figure_5_5.subprocess, "run", lambda *a, **k: failed)
    with pytest.raises(TutelageError, match="it needs the extra console"):
        reproduce(Figure55Config(results=tmp_path))


def test_impossible_ones_are_refused(tmp_path: Path) -> None:
    for bad in ({"seeds": ()}, {"steps": 0}, {"humans": 9}):
        with pytest.raises(ConfigError, match="figure-5.5-remote needs"):
            Figure55Config(**bad)
    with pytest.raises(ConfigError, match="leave out --tasks"):
        by_name("figure-5.5-remote", ("Ant",), (), False, 1, tmp_path, tmp_path)
