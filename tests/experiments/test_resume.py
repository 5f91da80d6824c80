"""A run that was killed, at whatever moment, continues as if nothing had happened."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interruptions import At, die, die_after, killed, resume, stop
from small import FLAGS, assert_same, contents, edit_config, points, walker

from tutelage.errors import RunFolderError
from tutelage.experiments.config import RunConfig
from tutelage.experiments.live import LivePlots
from tutelage.experiments.recording import lock
from tutelage.experiments.run import Checkpoints, Run
from tutelage.fleet.loop import Loop
from tutelage.store import load_tree

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


# -- killed at a known point, with every feature that has a state ---------------------------------------------------


VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "overlap": {"overlap": True, "learner": {"schedule": "episode"}, "robots": 8},
    "threads": {"threads": 3},
    "latency": {"latency": 2, "supervisor_noise": 0.3},
    "scratch": {"learner": {"schedule": "scratch", "every": 7, "gradient_steps": 3}, "overlap": True},
    "everything": {
        "overlap": True, "latency": 1, "supervisor_noise": 0.2, "learner": {"schedule": "episode"}, "priority": "U.R.C.",
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "variant"),
    [
        (walker, "plain"),
        (walker, "threads"),
        (walker, "everything"),
        *((points, name) for name in VARIANTS if name != "threads"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_run_killed_at_a_seeded_timestep_continues_bit_for_bit(
    make: Callable[..., RunConfig], variant: str, tmp_path: Path
) -> None:
    Run.start(make(tmp_path / "whole", **VARIANTS[variant])).run()
    t = int(np.random.default_rng([len(variant), make is walker]).integers(11, 30))
    killed(die_after, make(tmp_path / "killed", **VARIANTS[variant]), t)
    assert resume(tmp_path / "killed") == t // 10 * 10 - 10 * (t % 10 == 0)
    assert_same(tmp_path / "whole", tmp_path / "killed")


def test_a_run_of_thrifty_dagger_keeps_its_running_moments(tmp_path: Path) -> None:
    goal = {"task": "small:goal_fleet", "expert": "small:Reaching", "priority": "U.G.C."}
    Run.start(points(tmp_path / "whole", **goal)).run()
    killed(die_after, points(tmp_path / "killed", **goal), 17)
    assert resume(tmp_path / "killed") == 10
    assert_same(tmp_path / "whole", tmp_path / "killed")


def test_a_run_with_a_priority_of_ones_own_keeps_what_that_remembers(tmp_path: Path) -> None:
    whole = Run.start(points(tmp_path / "whole", priority="small:Worry"))
    assert list(whole.assembly.learner.critics) == ["risk"], "it needs this one"
    assert whole.run()["teleoperation"] > 0
    killed(die_after, points(tmp_path / "killed", priority="small:Worry"), 17)
    assert json.loads((tmp_path / "killed" / "config.json").read_text())["priority"] == "small:Worry"
    assert resume(tmp_path / "killed") == 10
    assert_same(tmp_path / "whole", tmp_path / "killed")


# -- killed at the worst moments of a save --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    Run.start(walker(folder)).run()
    return folder


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, prepared and not yet begun."""
    folder = tmp_path_factory.mktemp("begun") / "run"
    Run.start(walker(folder)).recorder.close()
    return folder


def die_at_file(folder: Path, name: str, nth: int, when: str) -> None:
    """Continue until the nth replacement of a file of that name, and die before, during or after it."""
    replace, seen = os.replace, 0

    def deadly(source: Any, target: Any) -> None:
        nonlocal seen
        seen += Path(target).name.startswith(name)
        now = seen == nth and Path(target).name.startswith(name)
        if now and when == "during":
            Path(source).write_bytes(Path(source).read_bytes()[:100])
        if now and when != "after":
            die()
        replace(source, target)
        if now:
            die()

    run = Run.resume(folder)
    os.replace = deadly  # type: ignore[assignment]
    run.run()


@pytest.mark.parametrize(
    ("name", "nth", "when", "continues_at"),
    [
        ("steps-", 1, "before", 0),  # the first checkpoint has no data yet
        ("steps-", 2, "after", 10),  # data beyond the checkpoint
        ("policy", 2, "after", 10),  # a policy that is newer than the checkpoint
        ("state", 1, "before", 0),
        ("state", 2, "during", 10),  # a checkpoint half written
        ("state", 2, "after", 20),
        ("state", 3, "before", 20),  # all steps done, the last checkpoint missing
    ],
)
def test_a_run_killed_while_it_saves_continues_bit_for_bit(
    whole: Path, begun: Path, tmp_path: Path, name: str, nth: int, when: str, continues_at: int
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    killed(die_at_file, folder, name, nth, when)
    assert resume(folder) == continues_at
    assert_same(whole, folder)
    assert not list(folder.rglob("*.part")), "what the crash left half written has been replaced"


def test_a_run_killed_twice_and_again_while_resuming_continues_bit_for_bit(whole: Path, begun: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    killed(die_at_file, folder, "state", 2, "before")
    killed(die_cutting, folder)
    killed(die_at_file, folder, "state", 1, "after")
    assert resume(folder) == 20
    assert_same(whole, folder)


def die_cutting(folder: Path) -> None:
    """Die while the metrics are cut back to the checkpoint."""

    def deadly(source: Any, target: Any) -> None:
        assert Path(target).name == "metrics.jsonl"
        die()

    os.replace = deadly  # type: ignore[assignment]
    Run.resume(folder)


def test_a_half_written_line_of_metrics_is_dropped(whole: Path, begun: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    killed(die_at_file, folder, "state", 3, "before")
    with open(folder / "metrics.jsonl", "ab") as file:
        file.write(b'{"t": 30, "succ\xff')
    resume(folder)
    assert_same(whole, folder)


# -- the command line, killed from outside --------------------------------------------------------------------------


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []

    def start(*args: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", "from tutelage.cli import main; main()", *args]
        processes.append(
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
        )
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_for_lines(process: subprocess.Popen[str], folder: Path, lines: int) -> None:
    path, deadline = folder / "metrics.jsonl", time.monotonic() + 120
    while not path.exists() or path.read_bytes().count(b"\n") < lines:
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.002)


def finish_both(config: RunConfig, folder: Path, t: int) -> None:
    """Compare with a run that was never interrupted, over the first t timesteps."""
    edit_config(folder, steps=t)
    Run.start(RunConfig(**{**vars(config), "steps": t, "out": folder.with_name("whole")})).run()
    resume(folder)
    assert_same(folder.with_name("whole"), folder)


@pytest.mark.parametrize(("lines", "every"), [(3, 1000), (12, 10), (10, 10)], ids=["no checkpoint", "mid-run", "just saved"])
def test_kill_9_of_the_command_line(
    lines: int, every: int, tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    folder = tmp_path / "run"
    args = [*FLAGS, "--steps", "100000", "--metrics-every", "1", "--checkpoint-every", str(every), "--out", str(folder)]
    process = started("run", "Walker2d", *args)
    wait_for_lines(process, folder, lines)
    process.kill()
    process.wait()
    written = len((folder / "metrics.jsonl").read_bytes().splitlines())
    saved = load_tree(folder / "checkpoint" / "state.safetensors")["loop"]["t"]
    assert saved % every == 0
    assert saved <= written < saved + every + 1
    finish_both(walker(folder, metrics_every=1, checkpoint_every=every), folder, written // 10 * 10 + 20)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_ends_after_the_present_timestep_and_loses_nothing(
    number: signal.Signals, tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    folder = tmp_path / "run"
    args = [*FLAGS, "--steps", "100000", "--metrics-every", "1", "--checkpoint-every", "100000", "--out", str(folder)]
    process = started("run", "Walker2d", *args)
    wait_for_lines(process, folder, 7)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    t = load_tree(folder / "checkpoint" / "state.safetensors")["loop"]["t"]
    assert f"stopped at timestep {t}; continue with: tutelage resume {folder}\n" in out
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["t"] for line in lines] == list(range(1, t + 1))
    assert max(frame["timestep"] for frame in contents(folder)["frames"]) == t - 1
    finish_both(walker(folder, metrics_every=1, checkpoint_every=100000), folder, t + 10)


def test_resume_on_the_command_line_goes_on_and_a_second_one_has_nothing_to_do(
    whole: Path, begun: Path, tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    killed(die_at_file, folder, "state", 2, "after")
    out, err = started("resume", str(folder)).communicate(timeout=60)
    assert err == ""
    assert out.startswith("continuing at timestep 20 of 30\n")
    assert_same(whole, folder)
    out, err = started("resume", str(folder)).communicate(timeout=60)
    assert (out, err) == (f"{folder} is complete at timestep 30; nothing to do\n", "")
    assert_same(whole, folder)


# -- interruptions within one process -------------------------------------------------------------------------------


def test_a_run_stopped_between_checkpoints_keeps_its_last_timestep(whole: Path, begun: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    for t in (3, 17, 18):
        run = Run.resume(folder)
        run.run([At(t, stop)])
        assert run.loop.t == t
    assert resume(folder) == 18
    assert_same(whole, folder)


@pytest.mark.parametrize(("steps", "saves"), [(30, [0, 10, 20, 30]), (25, [0, 10, 20, 25])])
def test_a_state_is_saved_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int, saves: list[int]) -> None:
    saved, save = [], Checkpoints.save

    def count(self: Checkpoints, loop: Loop) -> None:
        saved.append(loop.t)
        save(self, loop)

    monkeypatch.setattr(Checkpoints, "save", count)
    Run.start(points(tmp_path / "run", steps=steps)).run()
    assert saved == saves


def test_pictures_that_cannot_be_drawn_do_not_end_a_run_or_lose_its_end(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run = Run.start(points(tmp_path / "run", metrics_every=1000))
    run.run([LivePlots(run.folder, seconds=0.0), At(7, stop)])  # no line of metrics yet: there is nothing to draw
    assert Run.resume(run.folder).loop.t == 7


def test_an_error_within_a_timestep_leaves_the_last_checkpoint(tmp_path: Path) -> None:
    Run.start(points(tmp_path / "whole")).run()
    run = Run.start(points(tmp_path / "broken"))
    act = run.loop.policy.act

    def fail(obs: Any) -> Any:
        if run.loop.t == 13:
            raise RuntimeError("the policy broke")
        return act(obs)

    run.loop.policy.act = fail  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="the policy broke"):
        run.run()
    assert resume(run.folder) == 10
    assert_same(tmp_path / "whole", run.folder)


def test_a_run_that_ended_gives_its_folder_back(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run"))
    with pytest.raises(RunFolderError, match="in use by another process"):
        Run.resume(run.folder)
    run.run()
    assert Run.resume(run.folder).loop.t == 30


def test_a_folder_can_be_moved(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "here"))
    run.run([At(12, stop)])
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert resume(tmp_path / "there") == 12
    assert not (tmp_path / "here").exists()


def test_a_claim_ends_with_its_process(tmp_path: Path) -> None:
    killed(die_holding, tmp_path)
    lock(tmp_path).close()


def die_holding(folder: Path) -> None:
    claim = lock(folder)
    assert not claim.closed
    die()
