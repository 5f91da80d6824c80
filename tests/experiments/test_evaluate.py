"""Evaluation of frozen policies: nothing learns, nothing of the run changes, and the expert is the reference."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import contents, points, walker

from tutelage.errors import ConfigError, RunFolderError, TutelageError
from tutelage.experiments.evaluate import evaluate_policy, evaluate_run
from tutelage.experiments.run import Run, loop_state, read_config
from tutelage.fleet.gates import GateConfig
from tutelage.fleet.priority import PriorityConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.expert import GaussianActor

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = Run.start(walker(tmp_path_factory.mktemp("run") / "run"))
    run.run()
    return run.folder


def test_the_result_is_written_beside_the_run_and_nothing_else_changes(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    result = evaluate_run(folder, 20)
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert json.loads(after.pop(folder / "evaluation.json")) == result
    assert after == before
    assert (result["steps"], result["t"], result["priority"], result["policy"]) == (20, 20, "C.", "run")
    assert result["teleoperation"] == 0, "hard resets only"


def test_the_same_evaluation_gives_the_same_numbers(folder: Path) -> None:
    assert evaluate_run(folder, 20) == evaluate_run(folder, 20)


def test_the_expert_is_better_and_has_its_own_file(folder: Path) -> None:
    run, expert = evaluate_run(folder, 40), evaluate_run(folder, 40, expert=True)
    assert expert["policy"] == "expert"
    assert json.loads((folder / "evaluation-expert.json").read_text()) == expert
    assert expert["reward"] > run["reward"]


def test_who_falls_is_reset_from_the_start_though_the_run_had_an_initial_period(tmp_path: Path) -> None:
    config = walker(tmp_path / "run", thresholds=PriorityConfig(uncertainty=0.1, risk=0.5, initial=1000))
    tired = GaussianActor(17, -np.ones(6), np.ones(6), (8,))  # it does nothing, and falls
    result = evaluate_policy(dataclasses.replace(config, steps=120), tired)
    assert result["hard_resets"] > 0


def test_help_is_given_when_the_priority_asks_for_it(folder: Path) -> None:
    assert evaluate_run(folder, 40, "U.C.")["teleoperation"] > 0


def test_help_by_what_the_run_has_learned(folder: Path) -> None:
    assert evaluate_run(folder, 40, "C.U.R.")["teleoperation"] > 0


def test_help_by_a_priority_of_ones_own(folder: Path, tmp_path: Path) -> None:
    config = read_config(folder)
    curious = dataclasses.replace(config, steps=40, thresholds=dataclasses.replace(config.thresholds, risk=-1.0))
    policy, learned = EnsemblePolicy.load(folder / "policy.safetensors")[0], loop_state(folder)
    result = evaluate_policy(curious, policy, "small:Worry", learned=learned)
    assert result["teleoperation"] > 0, "with the critic of C.U.R., and a low threshold"
    run = Run.start(points(tmp_path / "run", priority="C."))
    run.run()
    with pytest.raises(ConfigError, match=r"not learn risk, which small:Worry looks at; evaluate it with C\. or U\.C\.$"):
        evaluate_run(run.folder, 40, "small:Worry")


def test_execution_mode_is_a_gate_without_learning_and_without_noise(tmp_path: Path) -> None:
    gate = GateConfig(unsafe=0.7, noise=0.5)
    run = Run.start(points(tmp_path / "run", priority="LazyDAgger", gate=gate, offline_pairs=200, t_teleop=1))
    run.run()
    before = contents(run.folder)["weights"]
    assert evaluate_run(run.folder, 40, "LazyDAgger")["teleoperation"] > 0
    assert contents(run.folder)["weights"] == before


def test_a_policy_that_is_evaluated_does_not_learn(folder: Path) -> None:
    weights = contents(folder)["weights"]
    evaluate_run(folder, 20, "U.C.")
    assert contents(folder)["weights"] == weights


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"priority": "SafeDAgger"}, "this run did not learn predicted_discrepancy, which SafeDAgger looks at"),
        ({"priority": "U.C.", "expert": True}, "this run has no signal 'uncertainty'"),
        ({"priority": "X"}, "cannot read the priority 'X'"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_evaluated_is_said(folder: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TutelageError, match=message):
        evaluate_run(folder, **{"steps": 20, **arguments})


def test_a_run_without_a_threshold_of_uncertainty_cannot_be_helped_by_it(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run", priority="C."))
    with pytest.raises(
        ConfigError, match="this run has no threshold of uncertainty, which U.C. needs; choose C. or Random."
    ):
        evaluate_run(run.folder, 20, "U.C.")


def test_a_folder_without_a_run_or_without_a_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="holds no run"):
        evaluate_run(tmp_path, 20)
    run = Run.start(points(tmp_path / "run"))
    (run.folder / "policy.safetensors").write_bytes(b"garbage")
    with pytest.raises(TutelageError, match="policy.safetensors is damaged or not a Tutelage file"):
        evaluate_run(run.folder, 20)
    (run.folder / "policy.safetensors").unlink()
    with pytest.raises(TutelageError, match="no such file: .*policy.safetensors"):
        evaluate_run(run.folder, 20)
    assert not (run.folder / "evaluation.json").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_the_evaluation(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(RunFolderError, match="cannot write to .*, where the result goes; evaluate a copy of it"):
        evaluate_run(folder, 20, subscribers=[object()])  # type: ignore[list-item]


def test_any_policy_can_be_evaluated_from_python(tmp_path: Path) -> None:
    class Still:
        def act(self, obs: Any) -> Any:
            return np.zeros((len(obs), 1), dtype=np.float32)

    config = dataclasses.replace(points(tmp_path / "unused"), steps=60)
    still, home = evaluate_policy(config, Still()), evaluate_policy(config, None)
    assert home["violations"] < still["violations"]
    assert not config.folder.exists()
