"""The comparison of section 5.6: every algorithm gets the same means, and a study that was cut short goes on."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import PointFleet, make_loop
from small import Here, points

from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments import jobs
from tutelage.experiments import study as studies
from tutelage.experiments.config import RunConfig
from tutelage.experiments.evaluate import evaluate_run
from tutelage.experiments.run import Run
from tutelage.experiments.study import ABLATIONS, BEHAVIOUR_CLONING, StudyConfig, configurations, random_threshold, run_study
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.priority import PriorityConfig, parse
from tutelage.fleet.tally import Counting, Tally

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")


# -- the threshold of Random ----------------------------------------------------------------------------------------


def solicited(threshold: float, steps: int, robots: int, humans: int, t_teleop: int = 5) -> float:
    """Human time of Random in the real loop, on robots that never fall."""
    tally = Tally(robots, humans)
    loop = make_loop(
        PointFleet(robots), parse("Random.", PriorityConfig(random=threshold)), humans,
        allocator=FleetDAgger(t_teleop, 5), subscribers=[Counting(tally)], seed=3,
    )  # fmt: skip
    loop.run(steps)
    return tally.summary()["human_time"]


@pytest.mark.parametrize("busy", [0.2, 0.5, 0.9])
@pytest.mark.parametrize(("robots", "humans", "t_teleop"), [(100, 10, 5), (30, 10, 1)])
def test_random_meets_its_budget(busy: float, robots: int, humans: int, t_teleop: int) -> None:
    """Within the error of a simulation of 500 timesteps: a few hundred interventions, so 5 % give or take."""
    steps, budget = 4000, busy * humans * 4000
    threshold = random_threshold(budget, steps, robots, humans, t_teleop, 5)
    assert solicited(threshold, steps, robots, humans, t_teleop) == pytest.approx(budget, rel=0.08)


def test_a_larger_budget_is_a_lower_threshold() -> None:
    thresholds = [random_threshold(busy * 10 * 200, 200, 100, 10, 5, 5) for busy in (0.05, 0.3, 0.6, 0.95)]
    assert thresholds == sorted(thresholds, reverse=True)
    assert len(set(thresholds)) == 4


def test_nothing_and_everything_are_the_ends() -> None:
    assert random_threshold(0, 200, 100, 10, 5, 5) > 0.999
    assert random_threshold(10 * 200, 200, 100, 10, 5, 5) < 0.9, "all humans are busy all the time"
    assert 0 <= random_threshold(10**9, 200, 100, 10, 5, 5) < 1e-5, "more than they can give"


def test_the_threshold_is_the_same_every_time() -> None:
    assert len({random_threshold(600, 200, 100, 10, 5, 5) for _ in range(2)}) == 1


# -- what is compared -----------------------------------------------------------------------------------------------


def gradient_steps(config: RunConfig) -> int:
    learner = config.learner
    if learner.schedule == "never":
        return learner.pretrain
    assert learner.schedule == "step"
    return learner.pretrain + config.steps // learner.every * learner.gradient_steps


@pytest.mark.parametrize("steps", [1000, 10_000])
def test_every_algorithm_gets_as_many_gradient_steps(steps: int) -> None:
    study = StudyConfig("Walker2d", steps=steps)
    configs = configurations(study, None) | configurations(study, 0.4 * steps * study.humans)
    assert list(configs) == ["C.U.R.", BEHAVIOUR_CLONING, "Random", "U.C."]
    assert {gradient_steps(config) for config in configs.values()} == {1000 + steps}


def test_only_cloning_gets_the_human_time_as_offline_pairs() -> None:
    study = StudyConfig("Walker2d", steps=1000)
    configs = configurations(study, None) | configurations(study, 2345.6)
    pairs = {name: config.offline_pairs for name, config in configs.items()}
    assert pairs == {"C.U.R.": None, BEHAVIOUR_CLONING: 5000 + 2346, "Random": None, "U.C.": None}, (
        "None is what the task says"
    )


def test_the_algorithms_differ_in_nothing_else() -> None:
    study = StudyConfig("Walker2d", steps=1000, robots=50, humans=5)
    configs = configurations(study, None) | configurations(study, 2000.0)
    own = {"priority", "label", "thresholds", "learner", "offline_pairs"}
    rest = [{k: v for k, v in vars(config).items() if k not in own} for config in configs.values()]
    assert all(other == rest[0] for other in rest)
    assert (rest[0]["robots"], rest[0]["humans"], rest[0]["steps"]) == (50, 5, 1000)


def test_no_ablation_has_an_initial_period() -> None:
    configs = configurations(StudyConfig("Walker2d", ablations=True), 1000.0)
    assert tuple(configs) == ABLATIONS
    assert {config.thresholds.initial for config in configs.values()} == {0}
    assert [config.priority for config in configs.values()] == ["C.U.R.", "C.U.", "C.R.", "U.R.", "U.", "R."]
    assert configurations(StudyConfig("Walker2d", ablations=True), None)["C.U.R."].thresholds.initial is None


# -- running it -----------------------------------------------------------------------------------------------------


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StudyConfig:
    """A study of two seeds on points."""
    make = configurations
    own = ("priority", "label", "out", "learner", "offline_pairs", "thresholds")
    settings = {name: value for name, value in vars(points(Path(), record="none")).items() if name not in own}

    def small(study: StudyConfig, human_time: float | None) -> dict[str, RunConfig]:
        return {
            name: dataclasses.replace(
                config,
                **settings,
                offline_pairs=(config.offline_pairs or 5000) - 4900,
                learner=dataclasses.replace(config.learner, pretrain=config.learner.pretrain - 980),
            )
            for name, config in make(study, human_time).items()
        }

    monkeypatch.setattr(studies, "configurations", small)
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", Here)
    return StudyConfig(
        "Walker2d",
        seeds=(0, 1),
        steps=30,
        robots=6,
        humans=2,
        evaluate=20,
        out=tmp_path / "runs",
        results=tmp_path / "results",
    )


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.json"))}


def test_a_study_leaves_a_small_file_for_each_run(tiny: StudyConfig, capsys: pytest.CaptureFixture[str]) -> None:
    results = run_study(tiny)
    stored = files(tiny.results)
    assert list(stored) == [
        f"comparison/Walker2d/{slug}-s{seed}.json" for slug in ("cbc", "cur", "random", "uc") for seed in (0, 1)
    ]
    assert len(results) == 8
    result = json.loads(stored["comparison/Walker2d/cur-s1.json"])
    assert (result["algorithm"], result["seed"]) == ("C.U.R.", 1)
    assert result["metrics"]["t"] == 30
    assert result["evaluation"]["t"] == result["expert"]["t"] == 20
    assert {len(curve) for curve in result["curves"].values()} == {6}
    assert result["curves"]["t"] == [5, 10, 15, 20, 25, 30]
    assert result["config"]["thresholds"]["uncertainty"] is not None, "as it was resolved"
    assert "out" not in result["config"], "nothing of this machine"
    assert "expert" not in json.loads(stored["comparison/Walker2d/uc-s0.json"])
    human = np.mean([r["metrics"]["human_time"] for r in results if r["algorithm"] == "C.U.R."])
    cloning = json.loads(stored["comparison/Walker2d/cbc-s0.json"])
    assert cloning["config"]["offline_pairs"] == 100 + round(human)
    assert cloning["metrics"]["teleoperation"] == 0
    assert f"C.U.R. solicited {human:,.0f} human timesteps on average" in capsys.readouterr().out


def test_a_study_goes_on_where_something_is_missing(tiny: StudyConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    run_study(tiny)
    before = files(tiny.results)
    (tiny.results / "comparison/Walker2d/cur-s1.json").unlink()
    (random,) = (tiny.out / "Walker2d-6x2-30").glob("random-*-s0")
    (random / "evaluation.json").unlink()
    evaluated: list[Path] = []

    def counted(folder: Path, *args: Any, **kwargs: Any) -> Any:
        evaluated.append(folder)
        return evaluate_run(folder, *args, **kwargs)

    monkeypatch.setattr("tutelage.experiments.evaluate.evaluate_run", counted)
    run_study(tiny)
    assert files(tiny.results) == before
    assert evaluated == [random], "nothing is computed twice"


def test_a_run_of_a_study_that_was_cut_short_is_continued(tiny: StudyConfig) -> None:
    tiny = dataclasses.replace(tiny, evaluate=0)
    run_study(tiny)
    before = files(tiny.results)
    shutil.rmtree(tiny.out / "Walker2d-6x2-30" / "cur-s0")
    config = studies.configurations(tiny, None)["C.U.R."]
    run = Run.start(dataclasses.replace(config, out=tiny.out / "Walker2d-6x2-30" / "cur-s0"))
    run.config = dataclasses.replace(run.config, steps=13)  # ends there, as if interrupted
    run.run()
    run_study(tiny)
    assert files(tiny.results) == before


def test_a_failed_reference_ends_the_study(
    tiny: StudyConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("small.point_fleet", lambda num_envs: 1 / 0)
    with pytest.raises(
        TutelageError, match="2 runs failed .see above.: Walker2d C.U.R. seed 0, Walker2d C.U.R. seed 1; mend"
    ):
        run_study(tiny)
    out = capsys.readouterr().out
    assert "Walker2d C.U.R. seed 0 FAILED" in out
    assert "ZeroDivisionError" in out
    assert not tiny.results.exists()


def test_a_failed_run_is_named_and_the_study_fails_after_the_others(
    tiny: StudyConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = studies.one

    def sometimes(config: RunConfig, *args: Any) -> Any:
        if (config.algorithm, config.seed) == ("Random", 1):
            raise ZeroDivisionError
        return one(config, *args)

    monkeypatch.setattr(studies, "one", sometimes)
    with pytest.raises(TutelageError, match="1 runs failed .*Walker2d Random seed 1"):
        run_study(tiny)
    assert "Walker2d Random seed 1 FAILED" in capsys.readouterr().out
    assert len(files(tiny.results)) == 7


def test_a_run_with_other_settings_is_refused_and_an_evaluation_of_other_length_is_made_again(tiny: StudyConfig) -> None:
    config = dataclasses.replace(studies.configurations(tiny, None)["C.U.R."], out=tiny.out / "run", seed=3)
    assert studies.one(config, 20, False)["evaluation"]["t"] == 20
    assert studies.one(config, 15, False)["evaluation"]["t"] == 15
    with pytest.raises(RunFolderError, match="was run with humans 2, not 1; delete it to run it again"):
        studies.one(dataclasses.replace(config, humans=1), 20, False)


def test_the_command_line_of_a_study(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    heard: list[StudyConfig] = []
    monkeypatch.setattr(studies, "run_study", heard.append)
    studies.main(["Walker2d", "--seeds", "3", "4", "--ablations", "--evaluate", "0"])
    assert heard == [StudyConfig("Walker2d", seeds=(3, 4), ablations=True, evaluate=0)]

    def fail(study: StudyConfig) -> None:
        raise TutelageError("what to do")

    monkeypatch.setattr(studies, "run_study", fail)
    with pytest.raises(SystemExit) as end:
        studies.main(["Walker2d"])
    assert (end.value.code, capsys.readouterr().err) == (2, "study: what to do\n")
