"""The files of a run: what is in them, and that a full disk or a crash leaves them whole."""

from __future__ import annotations

import errno
import json
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FakeLearner, PointFleet, make_loop, violated_first
from fakes import FakePriority as Wants
from small import contents, points

from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments.config import FORMAT
from tutelage.experiments.recording import EpisodeFrames, EventStore, MetricsFile, Recorder, lock
from tutelage.experiments.run import Run
from tutelage.fleet.events import Events
from tutelage.fleet.modes import MOVING, Event, Mode
from tutelage.fleet.step import Step
from tutelage.store import load_tree

pytest.importorskip("pyarrow")


class Steps:
    """Keeps the steps that it hears of."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def on_start(self, loop: Any) -> None:
        pass

    def on_step(self, loop: Any, step: Step) -> None:
        self.steps.append(step)

    def on_end(self, loop: Any) -> None:
        pass


def recorded(folder: Path, steps: int, every: int = 5, frames: str = "all") -> tuple[Recorder, list[Step]]:
    """A short run of points with falls, resets and a human, written to the folder."""
    fleet = PointFleet(4, horizon=9, falls={3: [1], 12: [2]}, successes={7: [0]}, noise=0.1)
    loop = make_loop(fleet, Wants(lambda view: violated_first(view) * (view.violation | (view.t % 4 == 0))), 2)
    loop.learner = FakeLearner()
    recorder, kept = Recorder(folder, 4, 2, steps, every, frames), Steps()
    loop.subscribers = [recorder, kept]
    loop.run(steps)
    recorder.commit(loop.t)
    return recorder, kept.steps


# -- what is written ------------------------------------------------------------------------------------------------


def test_every_event_is_stored_in_its_order(tmp_path: Path) -> None:
    recorder, steps = recorded(tmp_path, 20)
    recorder.close()
    with closing(sqlite3.connect(tmp_path / "events.sqlite")) as database:
        stored = database.execute("SELECT * FROM events ORDER BY rowid").fetchall()
    assert stored == [tuple(row) for step in steps for row in np.stack(step.events, axis=1).tolist()]
    assert {Event.VIOLATE, Event.HARD_RESET, Event.SUCCESS, Event.TAKE_OVER} <= {row[3] for row in stored}
    assert sorted(path.name for path in tmp_path.glob("events*")) == ["events.sqlite"], "no journal is left behind"


@pytest.mark.parametrize(("steps", "lines"), [(20, [5, 10, 15, 20]), (12, [5, 10, 12]), (3, [3])])
def test_metrics_have_a_line_every_so_often_and_one_at_the_end(tmp_path: Path, steps: int, lines: list[int]) -> None:
    recorder, _ = recorded(tmp_path, steps)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["t"] for row in rows] == lines
    assert rows[-1] == recorder.row()
    assert rows[-1]["loss/policy"] == steps - 1


@pytest.mark.parametrize("which", ["all", "human"])
def test_frames_are_what_the_robots_saw_and_did(tmp_path: Path, which: str) -> None:
    _, steps = recorded(tmp_path, 20, frames=which)
    frames = contents_frames(tmp_path)
    seen = 0
    for step in steps:
        keep = MOVING[step.mode] if which == "all" else step.mode == Mode.TELEOPERATED
        for robot in np.nonzero(keep)[0]:
            frame = frames[seen]
            assert (frame["timestep"], frame["robot"]) == (step.t, robot)
            assert frame["observation.state"] == step.obs[robot].astype(np.float32).tolist()
            assert frame["action"] == step.actions[robot].tolist()
            assert frame["action.proposed"] == step.proposed[robot].tolist()
            assert frame["intervention"] == (step.mode[robot] == Mode.TELEOPERATED)
            assert frame["operator"] == step.human[robot]
            assert (frame["operator"] >= 0) == frame["intervention"]
            assert frame["next.violation"] == step.violation[robot]
            assert frame["next.success"] == step.success[robot]
            assert frame["policy_version"] == step.t
            seen += 1
    assert seen == len(frames) > 0


def test_episodes_are_numbered_from_0_without_gaps_and_their_frames_too(tmp_path: Path) -> None:
    recorded(tmp_path, 30)
    episodes: dict[int, list[dict[str, Any]]] = {}
    for frame in contents_frames(tmp_path):
        episodes.setdefault(frame["episode_index"], []).append(frame)
    for frames in episodes.values():
        assert [frame["frame_index"] for frame in frames] == list(range(len(frames)))
        assert len({frame["robot"] for frame in frames}) == 1
        assert not any(frame["next.violation"] or frame["next.success"] for frame in frames[:-1])
    for robot in range(4):
        mine = [number for number, frames in episodes.items() if frames[0]["robot"] == robot]
        assert mine == [robot + 4 * k for k in range(len(mine))]
        assert len(mine) > 1


def test_no_frames_are_kept_when_none_are_asked_for(tmp_path: Path) -> None:
    recorded(tmp_path, 10, frames="none")
    assert sorted(path.name for path in tmp_path.iterdir() if "events" not in path.name) == ["metrics.jsonl"]


def contents_frames(folder: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    return [row for path in sorted(folder.glob("episodes/*.parquet")) for row in pq.read_table(path).to_pylist()]


# -- cutting back ---------------------------------------------------------------------------------------------------


def test_events_of_a_timestep_and_later_are_cut(tmp_path: Path) -> None:
    store = EventStore(tmp_path / "events.sqlite")
    column = np.arange(10)
    store.add(Events(column, column, column, column, column))
    store.cut(7)
    store.close()
    with closing(sqlite3.connect(tmp_path / "events.sqlite")) as database:
        assert [row[0] for row in database.execute("SELECT t FROM events")] == list(range(7))


@pytest.mark.parametrize("tail", [b"", b'{"t": 9', b"\xff\n", b"5\n", b"{}\n", b'{"t": 4, "x": 1}'])
def test_metrics_beyond_a_timestep_and_half_written_lines_are_cut(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "metrics.jsonl"
    metrics = MetricsFile(path)
    for t in (2, 4, 6):
        metrics.write({"t": t})
    metrics.commit()
    with open(path, "ab") as file:
        file.write(tail)
    metrics.cut(4)
    metrics.write({"t": 5})
    metrics.close()
    assert path.read_text() == '{"t": 2}\n{"t": 4}\n{"t": 5}\n'


def test_frames_of_later_timesteps_are_cut_with_their_files(tmp_path: Path) -> None:
    for name in ("steps-00000000-00000010", "steps-00000010-00000020", "steps-00000020-00000030"):
        (tmp_path / f"{name}.parquet").write_bytes(b"")
    EpisodeFrames(tmp_path, "all", 4).cut(10)
    assert [path.name for path in tmp_path.iterdir()] == ["steps-00000000-00000010.parquet"]


def test_files_of_other_names_are_not_cut(tmp_path: Path) -> None:
    (tmp_path / "steps-mine.parquet").write_bytes(b"")
    EpisodeFrames(tmp_path, "all", 4).cut(0)
    assert (tmp_path / "steps-mine.parquet").exists()


def test_a_commit_brings_events_into_the_file_itself(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    recorder, _ = recorded(tmp_path / "run", 20)  # SQLite syncs its log when it empties it, and not before
    (tmp_path / "alone.sqlite").write_bytes((tmp_path / "run" / "events.sqlite").read_bytes())
    with closing(sqlite3.connect(tmp_path / "alone.sqlite")) as database:
        count = database.execute("SELECT COUNT(*) FROM events").fetchone()[0]
    assert count == recorder.events.written > 0


def test_the_state_of_a_recorder_is_restored(tmp_path: Path) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
    recorder, _ = recorded(tmp_path / "one", 20)
    other = Recorder(tmp_path / "other", 4, 2, 20, 5, "all")
    other.load_state_dict(recorder.state_dict())
    assert other.row() == recorder.row()
    assert other.frames is not None
    assert recorder.frames is not None
    np.testing.assert_array_equal(other.frames.episode, recorder.frames.episode)
    np.testing.assert_array_equal(other.frames.frame, recorder.frames.frame)


# -- trouble --------------------------------------------------------------------------------------------------------


def full(*args: Any, **kwargs: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def full_after(n: int, work: Callable[..., Any]) -> Callable[..., Any]:
    calls = iter(range(n))

    def limited(*args: Any, **kwargs: Any) -> Any:
        return work(*args, **kwargs) if next(calls, None) is not None else full()

    return limited


@pytest.mark.parametrize("function", ["fsync", "replace"])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5])
def test_a_disk_that_fills_up_ends_the_run_in_one_line_and_it_continues_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str, n: int
) -> None:
    Run.start(points(tmp_path / "whole")).run()
    run = Run.start(points(tmp_path / "full"))
    with monkeypatch.context() as patch:
        patch.setattr(os, function, full_after(n, getattr(os, function)))
        with pytest.raises(TutelageError) as caught:
            run.run()
    message = str(caught.value)
    assert message.startswith("cannot write ")
    assert "No space left on device; free some space" in message
    assert "\n" not in message
    assert not list(run.folder.rglob("*.part"))
    del run, caught
    again = Run.resume(tmp_path / "full")
    assert again.loop.t % 10 == 0
    again.run()
    assert contents(tmp_path / "full") == contents(tmp_path / "whole")


@pytest.mark.parametrize("n", range(4))
def test_a_disk_that_is_full_at_the_start_leaves_no_folder_that_pretends_to_hold_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n: int
) -> None:
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full_after(n, os.replace))
        with pytest.raises(TutelageError, match="No space left on device"):
            Run.start(points(folder))
    assert not (folder / "config.json").exists()
    assert not list(folder.rglob("*.part"))
    with pytest.raises(RunFolderError, match=r"holds no run \(no config.json\)"):
        Run.resume(folder)
    Run.start(points(folder)).run()
    Run.start(points(tmp_path / "whole")).run()
    assert contents(folder) == contents(tmp_path / "whole")


def test_a_database_that_is_full_is_reported(tmp_path: Path) -> None:
    store = EventStore(tmp_path / "events.sqlite")
    store._db.execute("PRAGMA max_page_count=1")
    column = np.arange(100_000)
    with pytest.raises(TutelageError, match=r"cannot write events.sqlite: database or disk is full; free some space, then "):
        store.add(Events(column, column, column, column, column))
        store.commit()


def test_a_database_that_is_none_is_reported(tmp_path: Path) -> None:
    (tmp_path / "events.sqlite").write_bytes(b"garbage" * 100)
    with pytest.raises(
        RunFolderError, match=r"cannot open .*events.sqlite: file is not a database; restore the file or start"
    ):
        EventStore(tmp_path / "events.sqlite")


def test_a_folder_belongs_to_one_process_until_it_is_given_back(tmp_path: Path) -> None:
    claim = lock(tmp_path / "a" / "b")
    with pytest.raises(RunFolderError, match="is in use by another process; wait for it or choose another folder"):
        lock(tmp_path / "a" / "b")
    claim.close()
    lock(tmp_path / "a" / "b").close()


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot write to .*file: File exists; choose another folder"):
        lock(tmp_path / "file")


def test_the_checkpoint_holds_no_pickle(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run"))
    assert load_tree(run.checkpoints.path)["format"] == FORMAT
    assert b"pickle" not in run.checkpoints.path.read_bytes()
