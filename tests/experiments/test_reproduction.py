"""`tutelage reproduce`: figure 2.3 from runs to table and picture."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small import Here, walker

from tutelage.errors import ConfigError
from tutelage.experiments import figure_2_3, gates_table, jobs, reproduction, study, sweeps, table_3
from tutelage.experiments.config import to_json
from tutelage.experiments.figure_2_3 import ALGORITHMS, BC, LAZY, SAFE, Figure23Config, configuration
from tutelage.learning.critic import CriticConfig

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Epochs of 20 timesteps, in this process."""
    make = configuration

    def small(*args: Any) -> Any:
        config = make(*args)
        learner = dataclasses.replace(config.learner, every=20, gradient_steps=5, pretrain=20, batch=16)
        gate = dataclasses.replace(config.gate, beta_h=None, unsafe=0.7)
        return dataclasses.replace(
            config, steps=40, checkpoint_every=20, metrics_every=20, learner=learner, gate=gate, hidden=(16,),
            offline_pairs=(config.offline_pairs or 0) - 3900, critic=CriticConfig(pretrain=5),
        )  # fmt: skip

    monkeypatch.setattr(figure_2_3, "configuration", small)
    monkeypatch.setattr(figure_2_3.TestRollouts.__init__, "__defaults__", (1,))
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", Here)


def test_figure_2_3_from_runs_to_table_and_picture(tiny: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = reproduction.reproduce("figure-2.3", ("Walker2d",), (0, 1), False, 1, tmp_path / "runs", tmp_path / "results")
    place = tmp_path / "results" / "single" / "figure-2.3"
    results = [json.loads(path.read_text()) for path in sorted((place / "Walker2d").glob("*.json"))]
    assert sorted({r["algorithm"] for r in results}) == sorted(ALGORITHMS)
    assert len(results) == 12
    for r in results:
        assert [e["epoch"] for e in r["epochs"]] == [0, 1, 2]
        actions = [e["supervisor_actions"] for e in r["epochs"]]
        assert actions == sorted(actions)
        assert (actions[-1] > 0) == (r["algorithm"] != BC)
    dagger = next(r for r in results if r["algorithm"] == "DAgger")
    assert dagger["epochs"][-1]["supervisor_actions"] == 40 - dagger["metrics"]["resetting"]
    lazy = np.mean([r["epochs"][-1]["supervisor_actions"] for r in results if r["algorithm"] == LAZY])
    cloning = next(r for r in results if r["algorithm"] == BC)
    assert cloning["config"]["offline_pairs"] == 100 + round(lazy)
    assert figure_2_3.table(jobs.read_results(place)) == text
    assert "| Walker2d | -56% |" in text
    assert (place / "figure.png").stat().st_size > 20_000
    assert f"Walker2d {LAZY} seed 1: return" in capsys.readouterr().out

    files = {path: path.read_bytes() for path in place.rglob("*.json")}
    assert (
        reproduction.reproduce("figure-2.3", ("Walker2d",), (0, 1), False, 1, tmp_path / "runs", tmp_path / "results")
        == text
    )
    assert {path: path.read_bytes() for path in place.rglob("*.json")} == files, "complete runs are kept"


def test_the_settings_are_those_of_table_a_1() -> None:
    lazy, safe = configuration("Ant", LAZY, True), configuration("Ant", SAFE, True)
    assert (lazy.steps, lazy.learner.every, lazy.learner.gradient_steps, lazy.offline_pairs) == (75_000, 5000, 2000, 4000)
    assert (lazy.gate.beta_h, lazy.gate.beta_r, lazy.gate.noise) == (5e-3, 0.5, 0.05)
    assert safe.gate.beta_h is None
    assert configuration("Ant", "LazyDAgger (-Noise)", True).gate.noise == 0
    assert configuration("Ant", "LazyDAgger (-Switch to Auto)", True).gate.ask_again
    assert configuration("Walker2d", BC, False, 70).offline_pairs == 4070


def test_the_cutoff_latency_and_the_change_are_those_of_the_means() -> None:
    def result(algorithm: str, actions: int, switches: int, seed: int) -> dict[str, Any]:
        last = {"epoch": 1, "return_mean": 900.0, "supervisor_actions": actions, "context_switches": switches}
        return {"task": "Walker2d", "algorithm": algorithm, "seed": seed, "epochs": [last], "expert_return": 1000.0,
                "config": {"learner": {"every": 5000}}}  # fmt: skip

    runs = [result(LAZY, 500, 40, 0), result(LAZY, 700, 60, 1), result(SAFE, 300, 90, 0), result(SAFE, 300, 110, 1)]
    text = figure_2_3.table(runs)
    assert "| Walker2d | -56% | -50% | 4.3 | 6.0 |" in text  # (600 - 300) / (100 - 50)
    assert f"| Walker2d | {LAZY} | 0.90 ± 0.00 | 600 ± 1,271 | 50 ± 127 |" in text


def test_what_figure_2_3_does_not_have_is_refused() -> None:
    with pytest.raises(ConfigError, match="figure 2.3 has the tasks HalfCheetah, Walker2d, Ant; got Humanoid"):
        Figure23Config(tasks=("Humanoid",))


# -- table 3.1, figure A.1, all gates ------------------------------------------------------------------------------------


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peg insertion for 30 timesteps, in this process: 8 timesteps make an episode."""
    make = table_3.configuration

    def small(*args: Any) -> Any:
        config = make(*args)
        steps = (
            {"gradient_steps": 1, "pretrain": 1} if config.observation == "images" else {"gradient_steps": 5, "pretrain": 20}
        )
        learner = dataclasses.replace(config.learner, every=20, batch=16, **steps)
        pairs = 120 if config.algorithm != BC else 180
        return dataclasses.replace(
            config, steps=30, checkpoint_every=20, metrics_every=10, learner=learner, hidden=(16,), calibration_steps=10,
            offline_pairs=pairs, members=2, critic=dataclasses.replace(config.critic, pretrain=5, hidden=(16,)),
        )  # fmt: skip

    monkeypatch.setattr(table_3, "configuration", small)
    settings = {name: dataclasses.replace(setting, tests=2, aided=1) for name, setting in table_3.SETTINGS.items()}
    monkeypatch.setattr(table_3, "SETTINGS", settings)
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", Here)


def test_table_3_1_from_runs_to_published_and_ours(short: None, tmp_path: Path) -> None:
    where = (tmp_path / "runs", tmp_path / "results")
    text = reproduction.reproduce("table-3.1", (), (0,), False, 1, *where)
    place = tmp_path / "results" / "single" / "table-3.1"
    results = [json.loads(path.read_text()) for path in sorted(place.glob("*.json"))]
    assert {r["algorithm"] for r in results} == set(table_3.SETTINGS["table-3.1"].published)
    assert all(r["metrics"]["t"] == 30 for r in results)
    assert "| ThriftyDAgger | published | 0.88 ± 1.01 | 43.6 ± 24.5 | 60.0 ± 32.8 | 73/100 |" in text
    assert all(("aided" in r) == (r["algorithm"] != table_3.BC) for r in results)
    assert reproduction.reproduce("table-3.1", (), (0,), False, 1, *where) == text, "what is complete is kept"
    with pytest.raises(ConfigError, match=r"table-3\.1 is about PegInsertion; leave out --tasks"):
        reproduction.reproduce("table-3.1", ("Walker2d",), (0,), False, 1, *where)


@pytest.mark.render
def test_table_3_3_is_made_from_images(opengl: None, short: None, tmp_path: Path) -> None:
    text = reproduction.reproduce("table-3.3", (), (0,), False, 1, tmp_path / "runs", tmp_path / "results")
    place = tmp_path / "results" / "single" / "table-3.3"
    results = [json.loads(path.read_text()) for path in sorted(place.glob("*.json"))]
    assert {r["algorithm"] for r in results} == {table_3.BC, table_3.HG, table_3.THRIFTY}
    assert {r["config"]["observation"] for r in results} == {"images"}
    assert "| ThriftyDAgger | published | 1.42 ± 1.14 | 15.2 ± 12.4 | 45.5 ± 18.3 | 12/15 |" in text
    assert "| Behaviour cloning | published | – | – | – | 0/15 |" in text


def test_the_settings_are_those_of_appendix_b_2() -> None:
    setting = table_3.SETTINGS["table-3.1"]
    lazy, thrifty = (table_3.configuration(setting, name) for name in (table_3.LAZY, table_3.THRIFTY))
    assert (lazy.steps, lazy.offline_pairs, lazy.learner.batch, lazy.learner.learning_rate) == (10_000, 2687, 100, 1e-3)
    assert lazy.gate.beta_h == pytest.approx(7.5e-4)
    assert (thrifty.gate.alpha, thrifty.critic.gamma, thrifty.critic.positives) == (0.01, 0.9999, 0.1)
    assert table_3.configuration(setting, table_3.BC).offline_pairs == 4004
    assert table_3.configuration(setting, table_3.NO_RISK).gate.without == "risk"
    seen = table_3.configuration(table_3.SETTINGS["table-3.3"], table_3.THRIFTY)
    assert (seen.task, seen.observation, seen.steps, seen.offline_pairs) == ("CableRouting", "images", 1500, 1381)
    assert (seen.learner.batch, seen.learner.learning_rate, seen.learner.pretrain) == (64, 2.5e-4, 5 * 300)
    assert (seen.learner.every, seen.calibration_steps, seen.members) == (500, 5 * 100, 5)
    assert (seen.critic.batch, seen.critic.learning_rate, seen.critic.gamma) == (64, 2.5e-4, 0.9999)
    assert table_3.configuration(table_3.SETTINGS["table-3.3"], table_3.BC).offline_pairs == 1381


def test_counts_are_pooled_over_the_episodes_of_all_seeds() -> None:
    one, two = np.array([1.0, 3.0, 8.0]), np.array([2.0])
    parts = [{"episodes": len(v), "interventions": [v.mean(), v.std()], "human": None, "robot": None} for v in (one, two)]
    both = np.concatenate([one, two])
    cells = table_3._pooled([{"training": part} for part in parts], "training")
    assert cells == [f"{both.mean():.2f} ± {both.std():.2f}", "–", "–"]


def test_figure_a_1_has_nine_settings_a_task(tiny: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = reproduction.reproduce("figure-A.1", ("Walker2d",), (), False, 1, tmp_path / "runs", tmp_path / "results")
    place = tmp_path / "results" / "single" / "figure-A.1"
    gates = [json.loads(path.read_text())["config"]["gate"] for path in (place / "Walker2d").glob("*.json")]
    assert len({(g["beta_h"], g["beta_r"]) for g in gates}) == 9
    assert sum(line.startswith("| Walker2d |") for line in text.splitlines()) == 9
    assert (place / "figure.png").stat().st_size > 10_000


def test_every_gate_is_in_the_table_of_the_fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = gates_table.configurations

    def small(config: Any) -> Any:
        return {
            name: walker(
                tmp_path,
                priority=run.priority,
                gate=run.gate,
                label=name,
                record="none",
                steps=12,
                learner={"schedule": run.learner.schedule},
            )
            for name, run in make(config).items()
        }

    monkeypatch.setattr(gates_table, "configurations", small)
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", Here)
    text = reproduction.reproduce("gates", (), (0,), False, 1, tmp_path / "runs", tmp_path / "results")
    rows = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines()[4:]]
    assert rows == ["Behaviour cloning (C.)", "DAgger", "SafeDAgger", "EnsembleDAgger", "LazyDAgger",
                    "ThriftyDAgger (-Risk)", "HG-DAgger", "C.U.R."]  # fmt: skip


# -- figures 5.3 and C.1 to C.4 -----------------------------------------------------------------------------------------------


def test_figures_c_2_to_c_4_are_runs_that_differ_in_one_parameter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    small = walker(tmp_path / "unused")
    ran: list[Any] = []

    def one(config: Any, evaluate: int, expert: bool) -> dict[str, Any]:
        ran.append(config)
        m, fast = config.humans, 1 / (config.t_teleop + config.t_reset)
        metrics = {
            "successes": 100 * m * fast,
            "hard_resets": 90.0 - m,
            "idle_time": 90.0 / m,
            "human_time": 1.0 * m,
            "rohe": fast,
        }
        return {"algorithm": "C.U.R.", "seed": config.seed, "metrics": metrics, "config": to_json(config)}

    monkeypatch.setattr(sweeps, "one", one)
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", Here)
    where = (tmp_path / "runs", tmp_path / "results")
    text = {what: reproduction.reproduce(what, (), (0, 1), False, 1, *where) for what in sweeps.SWEEPS}
    assert {c.priority for c in ran} == {small.priority}
    assert [c.humans for c in ran[:5]] == [1, 5, 10, 25, 50]
    assert {(c.task, c.steps, c.robots) for c in ran} == {("Walker2d", 2000, 100)}
    defaults = {c.folder for c in ran if (c.humans, c.t_teleop, c.t_reset) == (10, 5, 5)}
    assert len(defaults) == 2, "one run for each seed serves all three figures"
    assert "| 50 | 500.0 ± 0.0 | 40.0 ± 0.0 |" in text["figure-C.2"]
    assert "cumulative successes increase with the number of humans: **HOLDS** (1: 10, 5: 50," in text["figure-C.2"]
    assert "10 humans achieve the highest ROHE: **DOES NOT HOLD**" in text["figure-C.2"]
    assert "a longer t_T than 5 has a lower ROHE: **HOLDS**" in text["figure-C.3"]
    assert "hard resets decrease: **DOES NOT HOLD**" in text["figure-C.4"]
    place = tmp_path / "results" / "single" / "figure-C.3"
    assert sweeps.table("figure-C.3", jobs.read_results(place)) == text["figure-C.3"]


def test_a_part_of_a_sweep_is_a_table_without_verdicts() -> None:
    result = {
        "seed": 0,
        "metrics": {"successes": 3.0, "hard_resets": 2, "idle_time": 10, "human_time": 20, "rohe": 0.1},
        "config": {"task": "Ant", "robots": 4, "steps": 50, "humans": 5},
    }
    text = sweeps.table("figure-C.2", [result])
    assert "| 5 | 3.0 | 2.0 | 10.0 | 20.0 | 0.100 |" in text
    assert "HOLD" not in text


def test_a_sweep_asks_for_what_exists() -> None:
    with pytest.raises(ConfigError, match="unknown task Walker; known tasks: HalfCheetah"):
        sweeps.SweepConfig(tasks=("Walker",))


def test_figure_5_3_is_long_enough_for_two_episodes_and_initial_periods(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    studies: list[Any] = []
    monkeypatch.setattr(reproduction, "run_study", studies.append)
    for full in (False, True):
        reproduction.reproduce("figure-5.3", ("Walker2d", "Anymal", "AllegroHand"), (), full, 1, tmp_path, tmp_path)
    assert [(s.task, s.steps, s.evaluate) for s in studies] == [
        ("Walker2d", 2000, 1000), ("Anymal", 5000, 2500), ("AllegroHand", 5000, 1000),
        ("Walker2d", 10_000, 10_000), ("Anymal", 10_000, 10_000), ("AllegroHand", 10_000, 10_000),
    ]  # fmt: skip


def test_figure_5_5_is_four_robots_that_push_blocks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    studies: list[Any] = []
    monkeypatch.setattr(reproduction, "run_study", studies.append)
    for full in (False, True):
        reproduction.reproduce("figure-5.5", (), (), full, 1, tmp_path, tmp_path)
    assert [(s.task, s.robots, s.humans, s.steps, s.t_teleop, s.seeds) for s in studies] == [
        ("BlockPushing", 4, 2, 250, 3, (0, 1, 2))
    ] * 2
    assert [s.observation for s in studies] == ["state", "images"]
    runs = study.configurations(studies[1], 100.0)
    assert {"C. (BC)", "Random", "U.C."} < set(runs)
    assert {(run.t_teleop, run.observation, run.learner.batch) for run in runs.values()} == {(3, "images", 64)}
    with pytest.raises(ConfigError, match=r"figure-5\.5 is about BlockPushing; leave out --tasks"):
        reproduction.reproduce("figure-5.5", ("Ant",), (), False, 1, tmp_path, tmp_path)
