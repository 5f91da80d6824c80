"""Runs with the gates of chapters 2 and 3: by name, from the command line's configuration to the files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import assert_same, contents, points, walker

from tutelage.errors import ConfigError
from tutelage.experiments.run import Run, read_config
from tutelage.fleet.gates import GATES, GateConfig
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")


class StopAt:
    """Ends a run after a timestep, as an interruption does."""

    def __init__(self, t: int) -> None:
        self.t = t

    def on_start(self, loop: Loop) -> None:
        pass

    def on_step(self, loop: Loop, step: Step) -> None:
        loop.stop_requested = step.t + 1 >= self.t

    def on_end(self, loop: Loop) -> None:
        pass


def gated(out: Path, name: str, **changes: Any) -> Any:
    gate = (
        GateConfig(without="risk", alpha=0.3)
        if name == "ThriftyDAgger"
        else GateConfig(unsafe=0.7, noise=0.1, beta=0.5, epoch=5)
    )
    return points(out, **{"priority": name, "gate": gate, "t_teleop": 1, "offline_pairs": 200, **changes})


@pytest.mark.parametrize("name", GATES)
def test_every_gate_runs_by_name_and_continues_bit_for_bit(name: str, tmp_path: Path) -> None:
    metrics = Run.start(gated(tmp_path / "whole", name)).run()
    assert metrics["teleoperation"] > 0
    Run.start(gated(tmp_path / "parts", name)).run([StopAt(13)])
    Run.resume(tmp_path / "parts").run()
    assert_same(tmp_path / "whole", tmp_path / "parts")


def test_numbers_that_were_not_given_come_from_the_data_and_are_kept(tmp_path: Path) -> None:
    run = Run.start(gated(tmp_path / "run", "LazyDAgger", gate=GateConfig()))
    classifier = run.assembly.learner.classifier
    assert classifier is not None
    assert classifier.beta_h == run.config.gate.beta_h == read_config(run.folder).gate.beta_h
    assert (len(run.assembly.learner.dataset), len(classifier.held_out)) == (140, 60)
    parts = (run.assembly.learner.dataset, classifier.held_out)
    unsafe = [classifier.discrepancies(d.obs.rows.numpy(), d.actions.rows.numpy()) >= classifier.beta_h for d in parts]
    assert 0.15 < np.concatenate(unsafe).mean() < 0.25


def test_thrifty_begins_with_quantiles_of_the_first_steps(tmp_path: Path) -> None:
    gate = Run.start(gated(tmp_path / "run", "ThriftyDAgger")).config.gate
    assert gate.novelty is not None
    assert gate.mean_discrepancy is not None
    assert gate.novelty > 0
    assert gate.mean_discrepancy > 0


def test_thrifty_needs_a_goal_unless_it_does_without_risk(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs a task with a goal"):
        Run.start(gated(tmp_path / "run", "ThriftyDAgger", gate=GateConfig()))


def test_what_was_executed_and_what_was_wanted_are_both_recorded(tmp_path: Path) -> None:
    run = Run.start(gated(tmp_path / "run", "LazyDAgger", record="all"))
    run.run()
    frames = contents(run.folder)["frames"]
    helped = [f for f in frames if f["intervention"]]
    assert helped
    assert any(f["action"] != f["action.wanted"] for f in helped)
    assert all(f["action"] == f["action.wanted"] for f in frames if not f["intervention"])


def test_a_gate_works_on_a_real_robot_task(tmp_path: Path) -> None:
    config = walker(tmp_path / "run", priority="SafeDAgger", t_teleop=1, gate=GateConfig(unsafe=0.7))
    metrics = Run.start(dataclasses.replace(config, steps=20)).run()
    assert metrics["teleoperation"] > 0
