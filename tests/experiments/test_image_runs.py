"""Runs whose policy sees images: the same loop, gates, files and commands as any other run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interruptions import At, die_after, killed, resume
from small import PictureFleet, assert_same, pictures

from tutelage.errors import ConfigError
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.evaluate import evaluate_run
from tutelage.experiments.prepare import demonstrations
from tutelage.experiments.recording import EpisodeFrames
from tutelage.experiments.records import load_run
from tutelage.experiments.run import Run, read_config
from tutelage.fleet.gates import GateConfig
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.policies.vision import BatchedCNN

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")

GATE = GateConfig(unsafe=0.7, alpha=0.3, reaction=1)


def frames(folder: Path) -> Any:
    """The pictures in a run folder, (n, 64, 64, 3), and the columns beside them."""
    import pyarrow.parquet as parquet

    table = parquet.read_table(folder / "episodes")
    return table["observation.images.camera"].combine_chunks().to_numpy_ndarray(), table


@pytest.mark.parametrize("name", ["ThriftyDAgger", "LazyDAgger", "HG-DAgger", "C.U.R."])
def test_runs_on_images_continue_bit_for_bit_after_a_kill(name: str, tmp_path: Path) -> None:
    config = pictures(tmp_path / "whole", priority=name, gate=GATE, t_teleop=1)
    metrics = Run.start(config).run()
    assert metrics["teleoperation"] > 0
    killed(die_after, dataclasses.replace(config, out=tmp_path / "killed"), 17)
    assert resume(tmp_path / "killed") == 10
    assert_same(tmp_path / "whole", tmp_path / "killed")


def test_a_run_on_images_has_networks_for_images_and_says_so(tmp_path: Path) -> None:
    run = Run.start(pictures(tmp_path / "run", priority="U.G.C.", hidden=None))
    learner = run.assembly.learner
    assert isinstance(run.assembly.policy.net, BatchedCNN)
    assert isinstance(learner.critics["goal"].net, BatchedCNN)
    assert learner.dataset.obs.rows.numpy().dtype == learner.critics["goal"].plain.rows.numpy().dtype == np.uint8
    assert read_config(run.folder).hidden == (100, 50, 10)
    assert read_config(run.folder).critic.hidden == (8,)
    assert RunConfig("CableRouting", observation="images").folder == Path("runs/CableRouting-images-C.U.R-s0")


def test_the_human_knows_the_state_and_the_robot_the_picture(tmp_path: Path) -> None:
    config = pictures(tmp_path / "run")
    assembly = assemble(config)
    shown = demonstrations(config, assembly.actor, 25)
    assert shown.obs.dtype == shown.next_obs.dtype == np.uint8
    at = (shown.obs[:, 0, :, 0] > 128).argmax(axis=1) + 3.0
    wanted = np.clip(5 * (0.25 - (at - 32) / 30), -1, 1)
    np.testing.assert_allclose(shown.actions[:, 0], wanted, atol=0.2)  # a bar is a pixel wide, 1/30


def test_frames_are_the_pictures_that_robots_showed_and_take_little_room(tmp_path: Path) -> None:
    run = Run.start(pictures(tmp_path / "run", priority="U.C."))
    seen: list[Any] = []

    class Watch(At):
        def on_step(self, loop: Loop, step: Step) -> None:
            seen.extend(step.obs[robot] for robot in range(3) if step.mode[robot] in (0, 2))

    run.run([Watch(0, print)])
    found, table = frames(run.folder)
    np.testing.assert_array_equal(found, np.stack(seen))
    assert "observation.state" not in table.column_names
    assert sum(path.stat().st_size for path in run.folder.glob("episodes/*")) < 0.1 * found.nbytes


def test_frames_that_fill_the_memory_are_compressed_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Run.start(pictures(tmp_path / "plain", priority="U.C.")).run()
    monkeypatch.setattr(EpisodeFrames, "ROOM", 40_000)
    Run.start(pictures(tmp_path / "tight", priority="U.C.")).run()
    (plain, _), (tight, _) = (frames(tmp_path / name) for name in ("plain", "tight"))
    np.testing.assert_array_equal(plain, tight)
    assert_same(tmp_path / "plain", tmp_path / "tight")


def test_a_policy_that_sees_is_evaluated_alone_with_help_and_against_its_human(tmp_path: Path) -> None:
    run = Run.start(pictures(tmp_path / "run", priority="ThriftyDAgger", gate=GATE, t_teleop=1, steps=10))
    run.run()
    alone = evaluate_run(run.folder, 15)
    helped = evaluate_run(run.folder, 15, "ThriftyDAgger")
    human = evaluate_run(run.folder, 15, expert=True)
    assert alone["teleoperation"] == 0
    assert helped["teleoperation"] > 0
    assert human["successes"] >= 3, "from about 0 to 0.15 in at most 10 timesteps"
    assert json.loads((run.folder / "evaluation.json").read_text())["priority"] == "ThriftyDAgger"
    assert load_run(run.folder).steps == 10


def test_what_no_network_here_can_see_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="unknown observation 'sound': use state or images"):
        RunConfig("CableRouting", observation="sound")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"cannot be made with \['observation'\]"):
        assemble(pictures(tmp_path / "run", task="small:goal_fleet"))
    fleet = PictureFleet(1)
    fleet.single_observation_space = fleet.single_action_space.__class__(0, 1, (64, 64), dtype=np.float32)
    monkeypatch.setattr("small.PictureFleet", lambda num_envs: fleet)
    with pytest.raises(
        ConfigError, match=r"a policy sees vectors or RGB images of bytes \(H, W, 3\), and small:picture_fleet"
    ):
        assemble(pictures(tmp_path / "run"))


@pytest.mark.render
def test_cable_routing_from_images_with_a_gate_continues_bit_for_bit(opengl: None, tmp_path: Path) -> None:
    config = pictures(
        tmp_path / "whole", task="CableRouting", expert=None, priority="ThriftyDAgger", gate=GATE, t_teleop=1, threads=1,
        robots=2, steps=14, offline_pairs=40, record="human",
    )  # fmt: skip
    Run.start(config).run()
    killed(die_after, dataclasses.replace(config, out=tmp_path / "killed"), 13)
    assert resume(tmp_path / "killed") == 10
    assert_same(tmp_path / "whole", tmp_path / "killed")
    found, _ = frames(tmp_path / "whole")
    assert (found[..., 0].astype(int) > found[..., 2] + 60).any(axis=(1, 2)).all(), "the cable is in every picture"
