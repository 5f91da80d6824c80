"""Reports on run folders: what they say, and what they say when a folder is damaged."""

from __future__ import annotations

import builtins
import json
import math
import os
import re
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FakeLearner, PointFleet, make_loop

from tutelage.errors import MissingExtraError, RunFolderError
from tutelage.experiments import plots
from tutelage.experiments.recording import Recorder
from tutelage.experiments.records import load_run, load_runs, run_folders
from tutelage.experiments.report import differences, summary_table, write_report
from tutelage.fleet.attempts import attempts, request_rate
from tutelage.fleet.events import Events
from tutelage.fleet.metrics import EventLog, summary
from tutelage.fleet.modes import Event, Mode
from tutelage.fleet.priority import parse

Row = tuple[int, int, int, Event, Mode]


def rows_of(seed: int, steps: int, robots: int = 4, humans: int = 2) -> list[Row]:
    """Each robot is teleoperated for `seed + 3` timesteps, succeeds, falls and is reset, again and again."""
    rows: list[Row] = []
    for robot in range(robots):
        human, start = robot % humans, 3 * robot
        while start + 20 < steps:
            end = start + 3 + seed
            rows += [
                (start, robot, human, Event.ASSIGN, Mode.SWITCHING),
                (start, robot, human, Event.TAKE_OVER, Mode.TELEOPERATED),
                (end, robot, human, Event.RELEASE, Mode.AUTONOMOUS),
                (end, robot, -1, Event.SUCCESS, Mode.AUTONOMOUS),
                (end + 1, robot, -1, Event.VIOLATE, Mode.VIOLATED),
                (end + 3, robot, human, Event.ASSIGN, Mode.SWITCHING),
                (end + 3, robot, human, Event.START_RESET, Mode.RESETTING),
                (end + 7, robot, human, Event.HARD_RESET, Mode.AUTONOMOUS),
            ]
            start += 20
    return sorted(rows, key=lambda row: row[0])


def write_run(path: Path, seed: int = 0, steps: int = 100, **config: Any) -> Path:
    """A run folder as a run leaves it behind."""
    path.mkdir(parents=True)
    rows = rows_of(seed, steps)
    config = {
        "task": "humanoid", "algorithm": "C.U.R.", "priority": "C.U.R.", "seed": seed, "robots": 4, "humans": 2,
        "steps": steps, "version": "0.1.0", "allocation": {"t_teleop": 5, "t_reset": 5}, **config,
    }  # fmt: skip
    (path / "config.json").write_text(json.dumps(config))
    with sqlite3.connect(path / "events.sqlite") as database:
        database.execute("CREATE TABLE events(t INTEGER, robot INTEGER, human INTEGER, event INTEGER, mode INTEGER)")
        database.executemany("INSERT INTO events VALUES (?, ?, ?, ?, ?)", [tuple(map(int, row)) for row in rows])
    database.close()
    log = EventLog(Events(*np.array(rows, dtype=np.int64).T), 4, 2, steps)
    with open(path / "metrics.jsonl", "w") as file:
        for t in range(10, steps + 1, 10):
            line = {**summary(log.until(t)), "reward": float(t)}
            if t > 20:
                line["loss/policy"] = math.exp(-t / 10)
            file.write(json.dumps(line) + "\n")
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run")


def test_what_the_recorder_writes_can_be_read(tmp_path: Path) -> None:
    fleet = PointFleet(5, noise=0.3, goal=0.4, bound=0.6, horizon=6)
    loop = make_loop(fleet, parse("C.Random."), humans=2, learner=FakeLearner())
    recorder = Recorder(tmp_path, robots=5, humans=2, steps=60, every=10, frames="none")
    loop.subscribers.append(recorder)
    (tmp_path / "config.json").write_text('{"robots": 5, "humans": 2}')
    loop.run(60)
    run = load_run(tmp_path)
    assert run.disagreement == ""
    assert {**run.final, **recorder.tally.summary()} == run.final
    assert run.metrics["loss/policy"].tolist() == [9, 19, 29, 39, 49, 59]


@pytest.fixture
def many(tmp_path: Path) -> list[Path]:
    """Two algorithms, three seeds each."""
    return [
        write_run(tmp_path / f"{label}{seed}", seed=seed, algorithm=label, learner={"batch": batch})
        for label, batch in (("BC", 64), ("C.U.R.", 256))
        for seed in range(3)
    ]


# -- loading ------------------------------------------------------------------------------------------------------------


def test_a_run_folder_is_loaded(run: Path) -> None:
    loaded = load_run(run)
    assert (loaded.label, loaded.name, loaded.steps) == ("C.U.R.", "run", 100)
    assert loaded.metrics["t"].tolist() == list(range(10, 101, 10))
    assert np.isnan(loaded.metrics["loss/policy"][:2]).all()
    assert loaded.final["successes"] == summary(loaded.log)["successes"] > 0
    assert loaded.final["intervention_length"] == 3
    assert loaded.final["request_rate"] == request_rate(loaded.log) > 0
    assert loaded.final["episode/human_actions"] == attempts(loaded.log).human_actions.mean()
    assert loaded.evaluation == {}
    assert loaded.disagreement == ""


def test_the_evaluation_is_part_of_the_results(run: Path) -> None:
    (run / "evaluation.json").write_text(
        json.dumps({"successes": 771, "hard_resets": 289, "idle_time": 1446, "steps": 10000})
    )
    assert load_run(run).final["evaluation/successes"] == 771
    assert re.search(r"Evaluation: successes +tasks +771\n", summary_table([load_run(run)]))


def test_a_line_that_a_crash_cut_off_is_ignored(run: Path) -> None:
    with open(run / "metrics.jsonl", "a") as file:
        file.write('{"t": 110, "succ')
    assert load_run(run).steps == 100


def test_events_after_the_last_metrics_are_ignored(run: Path) -> None:
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:4]))
    loaded = load_run(run)
    assert loaded.log.steps == 40
    assert loaded.log.events.t.max() < 40
    assert loaded.disagreement == ""


def test_lines_that_a_resumed_run_repeated_replace_the_first_ones(run: Path) -> None:
    text = (run / "metrics.jsonl").read_text()
    first = text.splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(first[:7]) + "".join(first[4:]))
    assert load_run(run).metrics["t"].tolist() == list(range(10, 101, 10))


def test_files_that_disagree_are_reported(run: Path) -> None:
    with sqlite3.connect(run / "events.sqlite") as database:
        database.execute("DELETE FROM events WHERE t > 50")
    database.close()
    assert "successes" in load_run(run).disagreement
    page = write_report([run], run).read_text()
    assert "run is going on, or was interrupted; its files disagree: successes" in page


def test_a_run_that_is_being_written_can_be_read(run: Path) -> None:
    writer = sqlite3.connect(run / "events.sqlite")
    try:
        writer.execute("PRAGMA journal_mode=WAL")
        writer.execute("INSERT INTO events VALUES (99, 0, -1, ?, ?)", (Event.SUCCESS, Mode.AUTONOMOUS))
        writer.commit()
        before = len(rows_of(0, 100))
        assert len(load_run(run).log.events.t) == before + 1
    finally:
        writer.close()


def damage(name: str, content: str | bytes | None) -> Any:
    def apply(run: Path) -> None:
        if content is None:
            (run / name).unlink()
        elif isinstance(content, bytes):
            (run / name).write_bytes(content)
        else:
            (run / name).write_text(content)

    return apply


def sql(statement: str) -> Any:
    def apply(run: Path) -> None:
        with sqlite3.connect(run / "events.sqlite") as database:
            database.execute(statement)
        database.close()

    return apply


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (damage("config.json", None), "is not a run folder: it has no config.json"),
        (damage("config.json", "{"), "config.json is damaged: Expecting property name"),
        (damage("config.json", b"\xff\xfe\x00"), "config.json is damaged: not text"),
        (damage("config.json", "[" * 100_000), "config.json is damaged: "),
        (damage("config.json", "[1]"), "config.json is damaged: expected an object, got list"),
        (damage("config.json", "{}"), "'robots' must be a positive number, got None"),
        (damage("config.json", '{"robots": 1e30, "humans": 1}'), "'robots' must be a positive number, got 1e+30"),
        (damage("config.json", '{"robots": 999999999999, "humans": 1}'), "'robots' must be a positive number"),
        (damage("config.json", '{"robots": 4, "humans": true}'), "'humans' must be a positive number, got True"),
        (damage("config.json", '{"robots": 1, "humans": 1}'), "events.sqlite is damaged: event "),
        (damage("metrics.jsonl", None), "metrics.jsonl is missing"),
        (damage("metrics.jsonl", ""), "metrics.jsonl is empty: the run has not completed a step yet"),
        (damage("metrics.jsonl", "garbage\n"), "metrics.jsonl, line 1, is damaged: Expecting value"),
        (damage("metrics.jsonl", '{"t": 1}\n3\n'), "metrics.jsonl, line 2, is damaged: expected an object, got int"),
        (damage("metrics.jsonl", '{"t": 1, "rohe": "x"}\n'), "line 1, is damaged: 'rohe' is not a number"),
        (damage("metrics.jsonl", '{"rohe": 1}\n'), "'t' must be a number of timesteps, got None"),
        (damage("metrics.jsonl", '{"t": NaN}\n'), "'t' must be a number of timesteps, got nan"),
        (damage("metrics.jsonl", '{"t": -1}\n'), "'t' must be a number of timesteps, got -1"),
        (damage("events.sqlite", None), "events.sqlite is missing"),
        (damage("events.sqlite", b"garbage" * 1000), "events.sqlite is damaged: file is not a database"),
        (damage("events.sqlite", b""), "events.sqlite is damaged: no such table: events"),
        (sql("DROP TABLE events"), "events.sqlite is damaged: no such table: events"),
        (sql("ALTER TABLE events RENAME COLUMN mode TO state"), "events.sqlite is damaged: no such column: mode"),
        (sql("UPDATE events SET mode = 'x' WHERE rowid = 3"), "events.sqlite is damaged: invalid literal"),
        (sql("UPDATE events SET human = NULL WHERE rowid = 3"), "events.sqlite is damaged: "),
        (sql("UPDATE events SET robot = 77 WHERE rowid = 3"), "events.sqlite is damaged: event 2: robot is 77"),
        (sql("UPDATE events SET event = 7 WHERE rowid = 1"), "event 0: HARD_RESET cannot take robot 0 from AUTONOMOUS"),
        (damage("evaluation.json", "{"), "evaluation.json is damaged: "),
    ],
)  # fmt: skip
def test_damaged_folders_are_refused_in_one_line(run: Path, harm: Any, message: str) -> None:
    harm(run)
    with pytest.raises(RunFolderError, match=re.escape(message)) as caught:
        load_run(run)
    assert "\n" not in str(caught.value)
    assert str(run) in str(caught.value)


def test_paths_that_are_not_run_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="no such folder"):
        load_run(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    with pytest.raises(RunFolderError, match="is not a run folder"):
        load_run(tmp_path / "file")
    with pytest.raises(RunFolderError, match="no run folder given"):
        write_report([], tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def test_of_several_folders_those_without_a_run_are_passed_over(run: Path, tmp_path: Path) -> None:
    for name in ("expert", "young"):
        (tmp_path / name).mkdir()
    (tmp_path / "young" / "config.json").write_text("{}")
    (tmp_path / "young" / "metrics.jsonl").write_text("")
    told: list[str] = []
    assert run_folders([tmp_path / "expert", run, tmp_path / "young"], told.append) == [run]
    assert told == [
        f"passed over {tmp_path / 'expert'}: it holds no run",
        f"passed over {tmp_path / 'young'}: it has not completed a step yet",
    ]
    assert run_folders([tmp_path / "expert"]) == [tmp_path / "expert"], "alone it is refused, when it is read"
    with pytest.raises(RunFolderError, match="no such folder"):
        load_runs(run_folders([run, tmp_path / "lost"]))


@pytest.mark.parametrize("others", [(), ("other",)])
def test_a_folder_that_may_not_be_read_is_refused(run: Path, tmp_path: Path, others: tuple[str, ...]) -> None:
    beside = [write_run(tmp_path / name) for name in others]
    run.chmod(0)
    if os.access(run, os.X_OK):
        pytest.skip("an administrator may read everything")
    with pytest.raises(RunFolderError, match="cannot read .*run: Permission denied"):
        load_runs(run_folders([*beside, run]))


# -- statistics -----------------------------------------------------------------------------------------------------------


def test_quantiles_of_students_t() -> None:
    assert plots.t95(1) == 12.706
    assert plots.t95(2) == 4.303
    assert plots.t95(31) == pytest.approx(2.0395, abs=5e-4)
    assert plots.t95(10**6) == pytest.approx(1.95996, abs=1e-4)


def test_mean_and_confidence_interval() -> None:
    # values 1, 2, 6: mean 3, sample variance (4 + 1 + 9) / 2 = 7, half width 4.303 * sqrt(7 / 3)
    mean, half = plots.mean_ci(np.array([1.0, 2.0, 6.0]))
    assert mean == 3
    assert half == pytest.approx(4.303 * math.sqrt(7 / 3))
    assert np.isnan(plots.mean_ci(np.array([[1.0, 2.0]]))[1]).all()


def test_smoothing_keeps_constants_and_averages_neighbours() -> None:
    assert plots.smooth(np.array([2.0, 2.0, 2.0]), 5).tolist() == [2, 2, 2]
    assert plots.smooth(np.array([0.0, 3.0, 6.0, 0.0]), 1).tolist() == [1.5, 3, 3, 3]


def test_a_band_ends_with_its_shortest_run(tmp_path: Path) -> None:
    runs = [load_run(write_run(tmp_path / "a", steps=60)), load_run(write_run(tmp_path / "b", seed=1, steps=100))]
    t, mean, half = plots.band(runs, "reward")  # reward = t in every run
    assert (t[0], t[-1]) == (0, 60)
    np.testing.assert_allclose(mean, t, atol=1e-9)
    np.testing.assert_allclose(half, 0, atol=1e-9)
    assert [len(column) for column in plots.band(runs, "unknown")] == [0, 0, 0]


# -- tables -----------------------------------------------------------------------------------------------------------------


def test_the_summary_table_has_a_column_for_each_algorithm(many: list[Path]) -> None:
    runs = load_runs(many)
    lines = summary_table(runs).splitlines()
    assert re.fullmatch(r" +BC +C\.U\.R\.", lines[0])
    assert re.fullmatch(r"Runs +3 +3", lines[2])
    # median lengths 3, 4, 5: mean 4, half width 4.303 * 1 / sqrt(3) = 2.484
    (length,) = [line for line in lines if line.startswith("Intervention length")]
    assert re.fullmatch(r"Intervention length +median timesteps +4\.0 ± 2\.5 +4\.0 ± 2\.5", length)
    assert "Evaluation" not in "".join(lines)
    assert "switching" not in "".join(lines)
    assert "[" not in "".join(lines)  # would be markup


def test_a_single_run_has_no_interval(run: Path) -> None:
    text = summary_table([load_run(run)])
    assert "±" not in text
    assert re.search(r"Operation time +timesteps +100\n", text)


def test_differences_of_configurations(many: list[Path]) -> None:
    assert differences(load_runs(many)) == {"seed": ["0, 1, 2", "0, 1, 2"], "learner.batch": ["64", "256"]}
    assert differences(load_runs(many[:1])) == {}


def test_thresholds_that_differ_are_short_unless_they_look_alike(tmp_path: Path) -> None:
    numbers = {"a": (0.004543168004602194, 0.05), "b": (0.005646437406539917, 0.050001)}
    runs = [write_run(tmp_path / name, u=u, r=r) for name, (u, r) in numbers.items()]
    assert differences(load_runs(runs)) == {"u": ["0.004543, 0.005646"], "r": ["0.05, 0.050001"]}


# -- pages ------------------------------------------------------------------------------------------------------------------


def test_the_report_is_one_file_that_needs_nothing_else(many: list[Path], tmp_path: Path) -> None:
    out = write_report(many, tmp_path / "out" / "comparison.html")
    assert out == tmp_path / "out" / "comparison.html"
    page = out.read_text()
    assert (out.parent / "plots" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert not re.findall(r"""(?:src|href|srcset)\s*=\s*["'](?!data:)""", page)
    assert "<script" not in page
    assert "url(" not in page
    assert page.count("<details>") == 6
    assert "BC (3), C.U.R. (3): 6 runs of 100 timesteps" in page
    assert "learner.batch" in page
    assert "class=note" not in page


def test_a_report_goes_into_a_folder_and_repeats_itself(run: Path) -> None:
    out = write_report([run], run)
    assert out == run / "report.html"
    first = out.read_bytes()
    assert write_report([run], run).read_bytes() == first
    assert b"<details open>" in first


def test_what_a_run_says_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert('&')</script> $x_1"
    path = write_run(tmp_path / "<b>", algorithm=evil, task=evil, note=evil, version=evil, **{evil: evil})
    other = write_run(tmp_path / "other", algorithm="A", task=evil, seed=1)
    for paths in ([path], [path, other]):
        page = write_report(paths, tmp_path / "report.html").read_text()
        assert "<script" not in page
        assert "&lt;script&gt;alert(&#x27;&amp;&#x27;)&lt;/script&gt; $x_1" in page


def test_runs_that_cannot_be_compared_directly_carry_a_note(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", steps=60)
    b = write_run(tmp_path / "b", steps=100, task="ant")
    (a / "config.json").write_text((a / "config.json").read_text().replace('"steps": 60', '"steps": 500'))
    page = write_report([a, b], tmp_path).read_text()
    assert "The runs have different lengths." in page
    assert "The runs differ in “task”" in page
    assert "a stands at timestep 60 of 500." in page


def test_a_run_of_a_single_line_without_losses_or_events_can_be_drawn(tmp_path: Path) -> None:
    path = write_run(tmp_path / "short")
    (path / "metrics.jsonl").write_text('{"t": 0, "successes": 0, "rohe": 0.0}\n')
    assert "C.U.R.: 1 run of 0 timesteps" in write_report([path], tmp_path).read_text()


def test_without_matplotlib_the_extra_is_named(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert summary_table([load_run(run)])
    with pytest.raises(MissingExtraError, match=re.escape("pip install 'tutelage[report]'")):
        write_report([run], run)
