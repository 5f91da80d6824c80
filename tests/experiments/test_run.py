"""Runs from Python: the same seed gives the same run, a few lines suffice, and what cannot work is refused early."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import assert_same, contents, edit_config, points, walker

from tutelage.envs import experts
from tutelage.errors import ConfigError, ContractError, RunFolderError, TutelageError
from tutelage.experiments import assemble as assembling
from tutelage.experiments import prepare as preparing
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import FORMAT, RunConfig, from_json, to_json
from tutelage.experiments.prepare import demonstrations, prepare
from tutelage.experiments.run import Run, read_config
from tutelage.fleet.priority import PriorityConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.expert import GaussianActor
from tutelage.store import load_tree, save_tree

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")


# -- a few lines ----------------------------------------------------------------------------------------------------


def test_ten_lines_of_python_are_a_run(tmp_path: Path) -> None:
    from tutelage.experiments.config import RunConfig
    from tutelage.experiments.run import Run
    from tutelage.learning.critic import CriticConfig
    from tutelage.learning.imitation import LearnerConfig

    config = RunConfig(
        "Walker2d", priority="C.U.R.", robots=6, humans=2, steps=30, seed=1, out=tmp_path / "run",
        learner=LearnerConfig(pretrain=20), critic=CriticConfig(pretrain=20), calibration_steps=10, offline_pairs=1000,
    )  # fmt: skip
    metrics = Run.start(config).run()

    assert metrics["t"] == 30
    assert metrics["human_time"] == metrics["teleoperation"] + metrics["resetting"] + metrics["waiting"]
    files = {str(path.relative_to(config.folder)) for path in config.folder.rglob("*") if path.is_file()}
    assert files - {"episodes/steps-00000000-00000030.parquet"} == {
        ".lock", "checkpoint/state.safetensors", "config.json", "environment.txt", "events.sqlite", "metrics.jsonl",
        "policy.safetensors",
    }  # fmt: skip
    policy, card = EnsemblePolicy.load(config.folder / "policy.safetensors")
    assert policy.act(np.zeros((3, 17))).shape == (3, 6)
    assert {"task": "Walker2d", "t": 30, "algorithm": "C.U.R."}.items() <= card.items()


def test_the_stored_configuration_is_the_resolved_one(tmp_path: Path) -> None:
    run = Run.start(walker(tmp_path / "run", label="ours"))
    stored = json.loads((run.folder / "config.json").read_text())
    assert stored["format"] == FORMAT
    assert stored["algorithm"] == "ours"
    assert stored["disturbance"] == "moderate"
    assert stored["thresholds"]["initial"] == 250
    assert stored["thresholds"]["uncertainty"] > 0
    assert stored["thresholds"]["risk"] > 0
    assert read_config(run.folder) == run.config


def test_a_threshold_that_is_given_is_kept(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run", thresholds=PriorityConfig(risk=0.125, initial=3)))
    thresholds = run.config.thresholds
    assert (thresholds.risk, thresholds.initial) == (0.125, 3)
    assert thresholds.uncertainty is not None


def test_missed_falls_can_be_bounded_instead(tmp_path: Path) -> None:
    thresholds = [
        Run.start(
            walker(tmp_path / str(missed), calibration_steps=60, thresholds=PriorityConfig(missed=missed))
        ).config.thresholds
        for missed in (0.2, 0.6)
    ]
    assert all(t.risk is not None for t in thresholds)
    assert 0 <= (thresholds[0].risk or 0) <= (thresholds[1].risk or 0)
    assert thresholds[1].risk


def test_preparation_is_reported(tmp_path: Path) -> None:
    heard: list[tuple[str, float]] = []
    Run.start(points(tmp_path / "run"), lambda what, done: heard.append((what, done)))
    assert list(dict.fromkeys(what for what, _ in heard)) == [
        "recording demonstrations", "behaviour cloning", "the cloned policy alone", "risk critic",
    ]  # fmt: skip
    assert all(0 <= done <= 1 for _, done in heard)


# -- the same again -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reference") / "run"
    Run.start(walker(folder)).run()
    return folder


@pytest.mark.parametrize("changes", [{}, {"threads": 3}, {"torch_threads": 2}, {"checkpoint_every": 7}], ids=str)
def test_seed_decides_everything_and_threads_nothing(reference: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    Run.start(walker(tmp_path / "again", **changes)).run()
    assert_same(reference, tmp_path / "again")


def test_another_seed_is_another_run(reference: Path, tmp_path: Path) -> None:
    Run.start(walker(tmp_path / "other", seed=1)).run()
    one, other = contents(reference), contents(tmp_path / "other")
    assert all(one[name] != other[name] for name in one)


def test_drawing_from_the_streams_of_others_changes_nothing(tmp_path: Path) -> None:
    import torch

    Run.start(points(tmp_path / "one")).run()
    np.random.seed(5)  # noqa: NPY002 - on purpose
    torch.manual_seed(5)
    torch.rand(3)
    Run.start(points(tmp_path / "other")).run()
    assert_same(tmp_path / "one", tmp_path / "other")


def test_what_is_recorded_changes_nothing_else(tmp_path: Path) -> None:
    for record in ("all", "human", "none"):
        Run.start(points(tmp_path / record, record=record)).run()
    everything, human, none = (contents(tmp_path / record) for record in ("all", "human", "none"))
    assert human.pop("frames") == [frame for frame in everything.pop("frames") if frame["intervention"]]
    assert none.pop("frames") == []
    assert everything == human == none


# -- demonstrations and calibration ---------------------------------------------------------------------------------


def test_demonstrations_are_as_many_pairs_as_asked_for_of_the_expert_in_calm() -> None:
    config = dataclasses.replace(walker(Path("unused")), offline_pairs=1500)
    actor, _ = experts.load("Walker2d")
    obs, actions = demonstrations(config, actor, 1000)[:2]
    assert obs.shape == (1500, 17)
    np.testing.assert_allclose(actions, actor.act(obs), atol=1e-5)
    assert (obs[0] != obs[750]).any(), "two episodes of 750 pairs"


@pytest.mark.parametrize(
    ("level", "mend"), [("none", "name a better one: --expert"), ("strong", "choose a calmer level: --offline-disturbance")]
)
def test_an_expert_that_falls_cannot_demonstrate(tmp_path: Path, level: str, mend: str) -> None:
    GaussianActor(17, np.full(6, -1.0), np.full(6, 1.0), (4,)).save(tmp_path / "clumsy", {"task": "Walker2d"})
    with pytest.raises(ConfigError, match=f"the expert fell in 3 of 3 demonstrations; {mend}"):
        Run.start(walker(tmp_path / "run", expert=str(tmp_path / "clumsy"), offline_disturbance=level))
    with pytest.raises(RunFolderError, match="holds no run"):
        read_config(tmp_path / "run")


def test_thresholds_are_quantiles_of_what_the_cloned_policy_felt() -> None:
    low = prepare(assemble(points(Path("unused"), thresholds=PriorityConfig(uncertainty_quantile=0.1))))
    high = prepare(assemble(points(Path("unused"), thresholds=PriorityConfig(uncertainty_quantile=0.99))))
    assert low.config.thresholds.uncertainty < high.config.thresholds.uncertainty  # type: ignore[operator]
    for name, a in low.policy.state_dict().items():
        assert (a == high.policy.state_dict()[name]).all(), "the policy is the same"


def test_without_human_data_to_come_the_cloned_policy_is_kept(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run", priority="C."))
    before = {name: value.clone() for name, value in run.assembly.policy.state_dict().items()}
    metrics = run.run()
    assert run.config.learner.schedule == "never"
    assert metrics["teleoperation"] == 0
    assert all((value == before[name]).all() for name, value in run.assembly.policy.state_dict().items())


# -- fleets and experts of the user's own ---------------------------------------------------------------------------


@pytest.mark.parametrize("priority", ["C.", "Random.", "U.C.", "C.U.R."])
def test_a_fleet_of_ones_own_runs_with_every_priority(tmp_path: Path, priority: str) -> None:
    metrics = Run.start(points(tmp_path / "run", priority=priority)).run()
    assert metrics["t"] == 30


def test_a_fleet_with_a_goal_runs_with_thrifty_dagger(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run", task="small:goal_fleet", expert="small:Reaching", priority="U.G.C."))
    assert list(run.assembly.learner.critics) == ["goal"]
    assert run.run()["successes"] > 0


def test_a_task_without_a_shipped_expert_takes_its_success_from_the_given_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor, card = experts.load("Walker2d")
    card["scores"]["moderate"]["mean"] = 1000.0
    actor.save(tmp_path / "own", card)
    shipped = assemble(walker(tmp_path / "run", expert=str(tmp_path / "own"))).fleet
    assert shipped.success_return == pytest.approx(0.95 * 4600.7, abs=1)  # type: ignore[attr-defined]
    monkeypatch.setattr(experts, "path_of", lambda task: tmp_path / "nothing")
    own = assemble(walker(tmp_path / "run", expert=str(tmp_path / "own"))).fleet
    assert own.success_return == pytest.approx(950.0)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="nothing says what a success is"):
        assemble(walker(tmp_path / "run", expert="small:Homing"))


@pytest.mark.parametrize(
    ("features", "actions", "message"),
    [(40, 6, "sees 40 numbers and gives 6 actions, but Walker2d shows 17 and takes 6"), (17, 3, "gives 3 actions")],
)
def test_an_expert_of_the_wrong_shape_is_refused(tmp_path: Path, features: int, actions: int, message: str) -> None:
    actor = GaussianActor(features, np.full(actions, -1.0), np.full(actions, 1.0), (4,))
    actor.save(tmp_path / "wrong", {"task": "Walker2d"})
    with pytest.raises(ContractError, match=message):
        assemble(walker(tmp_path / "run", expert=str(tmp_path / "wrong")))


# -- what cannot work is refused before anything is prepared --------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"priority": "U.G.C."}, "U.G.C. needs a task with a goal, and Walker2d has none; use C.U.R. or U.C."),
        ({"priority": "X."}, "cannot read the priority 'X.'"),
        ({"task": "Walkr2d"}, r"unknown task 'Walkr2d' \(did you mean Walker2d\?\)"),
        ({"disturbance": "awful"}, "unknown disturbance 'awful'"),
        ({"expert": "nowhere"}, "no expert at nowhere; train one with: tutelage train-expert Walker2d"),
        ({"expert": "small:nothing"}, "module 'small' has no callable 'nothing'"),
    ],
)
def test_refusals_come_first_and_leave_no_folder(
    tmp_path: Path, changes: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparing, "demonstrations", lambda *args: pytest.fail("minutes are spent"))
    with pytest.raises(TutelageError, match=message):
        Run.start(walker(tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists()


def test_latency_needs_a_fleet_that_can_pause_and_that_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fakes import PointFleet

    monkeypatch.setattr("small.point_fleet", lambda num_envs: PointFleet(num_envs, can_pause=False))
    monkeypatch.setattr(preparing, "demonstrations", lambda *args: pytest.fail("minutes are spent"))
    with pytest.raises(ConfigError, match="switching latency needs a fleet that can pause robots"):
        Run.start(points(tmp_path / "run", latency=1))


def test_a_fleet_that_cannot_be_saved_is_refused_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fakes import PointFleet

    monkeypatch.setattr(PointFleet, "can_checkpoint", False)
    monkeypatch.setattr(preparing, "demonstrations", lambda *args: pytest.fail("minutes are spent"))
    with pytest.raises(ConfigError, match="small:point_fleet cannot be checkpointed, and a run must be"):
        Run.start(points(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_a_run_is_never_overwritten(tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run"))
    run.run()
    before = contents(run.folder)
    with pytest.raises(RunFolderError) as caught:
        Run.start(points(tmp_path / "run", seed=5))
    assert str(caught.value) == (
        f"{run.folder} already holds a run; continue it with: tutelage resume {run.folder}, or choose --out"
    )
    assert contents(run.folder) == before


def test_two_that_start_in_the_same_folder_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make, runs = assembling.assemble, []

    def slow(config: RunConfig) -> Any:
        if not runs:  # while this one assembles, another one starts and ends there
            monkeypatch.setattr("tutelage.experiments.run.assemble", make)
            runs.append(Run.start(points(tmp_path / "run", seed=7)).run())
        return make(config)

    monkeypatch.setattr("tutelage.experiments.run.assemble", slow)
    with pytest.raises(RunFolderError, match="already holds a run"):
        Run.start(points(tmp_path / "run"))
    assert read_config(tmp_path / "run").seed == 7


# -- damaged folders ------------------------------------------------------------------------------------------------


@pytest.fixture
def ended(tmp_path: Path) -> Path:
    Run.start(points(tmp_path / "run")).run()
    return tmp_path / "run"


def damage(folder: Path, what: str) -> None:
    state, config = folder / "checkpoint" / "state.safetensors", folder / "config.json"
    if what == "cut":
        state.write_bytes(state.read_bytes()[:1000])
    elif what == "empty":
        state.write_bytes(b"")
    elif what == "gone":
        state.unlink()
    elif what == "other":
        state.write_bytes((folder / "policy.safetensors").read_bytes())
    elif what == "format":
        save_tree(state, {**load_tree(state), "format": 9})
    elif what == "lacking":
        tree = load_tree(state)
        del tree["loop"]["fleet"]
        save_tree(state, tree)
    elif what == "no json":
        config.write_text("{")
    elif what == "binary":
        config.write_bytes(b"\xff\xfe\x00")
    elif what == "list":
        config.write_text("[]")
    elif what == "deep":
        config.write_text("[" * 100_000)
    elif what == "no format":
        config.write_text("{}")
    elif what == "old":
        edit_config(folder, format=0)
    elif what == "events":
        (folder / "events.sqlite").write_bytes(b"garbage" * 100)
    elif what == "no events":
        (folder / "events.sqlite").unlink()
    elif what == "page of events":
        content = bytearray((folder / "events.sqlite").read_bytes())
        content[4096:] = b"\xff" * len(content[4096:])
        (folder / "events.sqlite").write_bytes(content)
    elif what == "no metrics":
        (folder / "metrics.jsonl").unlink()
    elif what == "line of metrics":
        lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
        (folder / "metrics.jsonl").write_text("".join([*lines[:2], "}{", *lines[2:]]))
    elif what == "metrics are a folder":
        (folder / "metrics.jsonl").unlink()
        (folder / "metrics.jsonl").mkdir()
    elif what == "episodes are a file":
        shutil.rmtree(folder / "episodes")
        (folder / "episodes").write_text("")
    else:
        edit_config(folder, **json.loads(what))


STATE, CONFIG = "{folder}/checkpoint/state.safetensors", "{folder}/config.json"
FITS_NOT = f"{STATE} does not fit {CONFIG}: one of them is damaged or was changed; restore it"


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("cut", f"{STATE} is damaged or not a Tutelage file: "),
        ("empty", f"{STATE} is damaged or not a Tutelage file: "),
        ("gone", f"no such file: {STATE}"),
        ("other", f"{STATE} has format None, this version reads 3; use the version that wrote it"),
        ("format", f"{STATE} has format 9, this version reads 3; use the version that wrote it"),
        ("lacking", FITS_NOT),
        ('{"robots": 7}', FITS_NOT),
        ('{"humans": 3}', FITS_NOT),
        ('{"hidden": [8]}', FITS_NOT),
        ('{"priority": "C.U.R.G."}', "C.U.R.G. needs a task with a goal"),
        ("no json", f"{CONFIG} is damaged; restore it, or start a new run in another folder"),
        ("binary", f"{CONFIG} is damaged"),
        ("list", f"{CONFIG} is damaged"),
        ("deep", f"{CONFIG} is damaged"),
        ("no format", f"{CONFIG} is damaged"),
        ("old", "{folder} has format 0, this version reads 3; use the version that wrote it"),
        ('{"robots": "six"}', "a setting has the wrong kind: robots cannot be 'six'"),
        ('{"humans": 9}', "9 humans for 6 robots: use at most one human a robot (M <= N)"),
        ("events", "cannot open {folder}/events.sqlite: file is not a database; restore the file or start a new run"),
        ("no events", "{folder}/events.sqlite is damaged: 0 readable entries before timestep 30, and "),
        ("page of events", "events.sqlite is damaged: "),
        (
            "no metrics",
            "{folder}/metrics.jsonl is damaged: 0 readable entries before timestep 30, and 6 were written; restore",
        ),
        ("line of metrics", "{folder}/metrics.jsonl is damaged: 2 readable entries before timestep 30, and 6 were written"),
        ("metrics are a folder", "cannot open {folder}/metrics.jsonl: Is a directory; restore it or start a new run"),
        ("episodes are a file", "cannot write to {folder}/episodes: File exists; restore it or start a new run"),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(ended: Path, what: str, message: str) -> None:
    damage(ended, what)
    with pytest.raises(TutelageError) as caught:
        Run.resume(ended)
    assert str(caught.value).startswith(message.format(folder=ended))
    assert "\n" not in str(caught.value)


def test_a_refusal_to_resume_changes_no_recording(ended: Path) -> None:
    damage(ended, "line of metrics")
    before = contents(ended)
    with pytest.raises(RunFolderError):
        Run.resume(ended)
    assert contents(ended) == before


def test_a_checkpoint_that_does_not_say_how_much_was_written_is_continued(ended: Path) -> None:
    state, before = ended / "checkpoint" / "state.safetensors", contents(ended)
    tree = load_tree(state)
    del tree["recorder"]["written"]
    save_tree(state, tree)
    Run.resume(ended).run()
    assert contents(ended) == before


def test_a_run_that_starts_among_recordings_of_another_one_is_refused_and_changes_none(ended: Path) -> None:
    (ended / "config.json").unlink()
    before = contents(ended)
    with pytest.raises(
        RunFolderError, match="holds the recordings of a run without its config.json; restore that, or choose"
    ):
        Run.start(walker(ended))
    assert contents(ended) == before


def test_a_refused_folder_can_be_mended_and_continued(ended: Path) -> None:
    state = ended / "checkpoint" / "state.safetensors"
    good, before = state.read_bytes(), contents(ended)
    damage(ended, "cut")
    with pytest.raises(TutelageError):
        Run.resume(ended)
    state.write_bytes(good)
    Run.resume(ended).run()
    assert contents(ended) == before


def test_a_longer_run_begins_like_the_shorter_one(ended: Path, tmp_path: Path) -> None:
    edit_config(ended, steps=50)
    assert from_json(RunConfig, to_json(read_config(ended))).steps == 50
    Run.resume(ended).run()
    Run.start(points(tmp_path / "longer", steps=50)).run()
    assert_same(ended, tmp_path / "longer")
