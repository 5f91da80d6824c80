"""Gates: when a robot asks, when it gives back, and that it does not chatter in between."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from fakes import FakePolicy, FakeSupervisor, PointFleet, make_view
from hypothesis import given
from hypothesis import strategies as st

from tutelage.errors import ConfigError
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.execution import NoiseInjection
from tutelage.fleet.gates import GATES, EnsembleDAgger, GateConfig, HGDAgger, LazyDAgger, SafeDAgger, ThriftyDAgger
from tutelage.fleet.loop import Loop
from tutelage.fleet.modes import Mode
from tutelage.fleet.priority import PriorityConfig, parse
from tutelage.fleet.supervisor import Team

BAND = GateConfig(beta_h=0.1, beta_r=0.25)  # asks from 0.1, gives back below 0.025


def one(gate: Any, helped: bool, *, t: int = 0, fresh: bool = False, discrepancy: float = np.nan, **signals: float) -> bool:
    """Whether a single robot has a human in the next timestep."""
    known = {name: [value] for name, value in signals.items()}
    rank = gate(make_view(t, violation=(False,), supervised=[helped], fresh=[fresh], discrepancy=[discrepancy], **known))
    return bool((rank > 0).any())


# -- SafeDAgger and LazyDAgger ------------------------------------------------------------------------------------------


@given(st.lists(st.floats(0, 1), min_size=1, max_size=30))
def test_safe_dagger_is_equation_2_5(estimates: list[float]) -> None:
    gate, helped = SafeDAgger(GateConfig()), False
    for f in estimates:
        helped = one(gate, helped, discrepancy=0.0, predicted_discrepancy=f)
        assert helped == (f >= 0.5)


@given(st.lists(st.floats(0.0251, 0.0999), min_size=1, max_size=40), st.booleans())
def test_lazy_dagger_never_switches_inside_the_band(true: list[float], helped: bool) -> None:
    gate = LazyDAgger(BAND)
    for value in true:
        now = one(gate, helped, discrepancy=value if helped else np.nan, predicted_discrepancy=float(value >= 0.1))
        assert now == helped


@given(st.lists(st.tuples(st.floats(0, 0.2), st.floats(0, 1)), min_size=1, max_size=40))
def test_lazy_dagger_is_algorithm_1(steps: list[tuple[float, float]]) -> None:
    gate, helped, mode = LazyDAgger(BAND), False, "autonomous"
    true_before = np.nan
    for true, f in steps:
        supervisor = mode == "supervisor" or f >= 0.5  # line 8
        helped = one(gate, helped, discrepancy=true_before, predicted_discrepancy=f)
        assert helped == supervisor
        true_before = true if supervisor else np.nan
        if supervisor:
            mode = "autonomous" if true < 0.1 * 0.25 else "supervisor"  # lines 12-15


def test_lazy_without_switch_to_auto_gives_back_by_the_classifier() -> None:
    gate = LazyDAgger(GateConfig(beta_h=0.1, ask_again=True))
    assert not one(gate, True, discrepancy=0.9, predicted_discrepancy=0.4)
    assert one(gate, True, discrepancy=0.0, predicted_discrepancy=0.6)


def test_ensemble_dagger_looks_at_doubt_and_discrepancy() -> None:
    gate = EnsembleDAgger(GateConfig(beta_h=0.1, doubt=0.3))
    calm, risky, unsure = {"uncertainty": 0.3}, {"uncertainty": 0.0}, {"uncertainty": 0.31}
    assert not one(gate, False, predicted_discrepancy=0.0, **calm)
    assert one(gate, False, predicted_discrepancy=0.5, **risky)
    assert one(gate, False, predicted_discrepancy=0.0, **unsure)
    assert not one(gate, True, discrepancy=0.09, predicted_discrepancy=0.0, **calm)
    assert one(gate, True, discrepancy=0.11, predicted_discrepancy=0.0, **calm)
    assert one(gate, True, discrepancy=0.0, predicted_discrepancy=0.0, **unsure)


# -- ThriftyDAgger ------------------------------------------------------------------------------------------------------

THRIFTY = GateConfig(alpha=0.1, novelty=0.5, risk_ask=0.8, risk_cede=0.4, mean_discrepancy=0.05)


@pytest.mark.parametrize(
    ("helped", "discrepancy", "novelty", "risk", "expected"),
    [
        (False, np.nan, 0.4, 0.7, False), (False, np.nan, 0.51, 0.0, True), (False, np.nan, 0.0, 0.81, True),
        (True, 0.04, 0.4, 0.3, False), (True, 0.06, 0.0, 0.0, True), (True, 0.0, 0.0, 0.5, True), (True, 0.0, 0.9, 0.0, True),
    ],
)  # fmt: skip
def test_thrifty_dagger_intervenes_and_cedes_as_in_algorithm_3(helped, discrepancy, novelty, risk, expected) -> None:
    assert one(ThriftyDAgger(THRIFTY), helped, discrepancy=discrepancy, uncertainty=novelty, goal=1 - risk) == expected


def test_thrifty_thresholds_are_quantiles_of_autonomous_states_after_each_episode() -> None:
    gate, rng = ThriftyDAgger(THRIFTY), np.random.default_rng(0)
    novelty, risk, taught = [], [], []
    for t in range(300):
        supervised, fallen = rng.random(4) < 0.3, rng.random(4) < 0.1
        u, g = rng.exponential(0.01, 4), rng.random(4)
        differs = np.where(supervised, rng.random(4), np.nan)
        over = t % 50 == 49
        before = dict(gate.thresholds)
        gate(make_view(
            t, violation=fallen, supervised=supervised, fresh=[over] * 4, discrepancy=differs, uncertainty=u, goal=g
        ))  # fmt: skip
        own = ~supervised & ~fallen
        novelty += u[own].tolist()
        risk += (1 - g[own]).tolist()
        taught += differs[supervised].tolist()
        if not over:
            assert gate.thresholds == before
            continue
        exact = {
            "delta_h": np.quantile(novelty, 0.9, method="inverted_cdf"),
            "beta_h": np.quantile(risk, 0.9, method="inverted_cdf"),
            "beta_r": np.quantile(risk, 0.5, method="inverted_cdf"),
            "delta_r": np.mean(taught),
        }
        assert gate.thresholds == pytest.approx(exact, rel=0.0011)


def test_the_budget_may_change_in_time() -> None:
    config = GateConfig(alpha=0.2, alpha_end=0.1, alpha_over=100)
    assert [config.budget(t) for t in (0, 50, 100, 900)] == pytest.approx([0.2, 0.15, 0.1, 0.1])
    gate, rng = (
        ThriftyDAgger(dataclasses.replace(THRIFTY, alpha=0.2, alpha_end=0.1, alpha_over=100)),
        np.random.default_rng(0),
    )
    thresholds = []
    for t in (0, 200):
        gate(
            make_view(t, violation=(False,) * 5000, uncertainty=rng.random(5000), goal=rng.random(5000), fresh=[True] * 5000)
        )
        thresholds.append(gate.thresholds["delta_h"])
    assert thresholds == pytest.approx([0.8, 0.9], abs=0.02)


def test_thrifty_continues_after_a_round_trip_of_its_state() -> None:
    gate, rng = ThriftyDAgger(THRIFTY), np.random.default_rng(1)
    views = [make_view(t, fresh=[t % 7 == 0] * 4, uncertainty=rng.random(4), goal=rng.random(4)) for t in range(60)]
    for view in views[:30]:
        gate(view)
    other = ThriftyDAgger(THRIFTY)
    other.load_state_dict(gate.state_dict())
    for view in views[30:]:
        np.testing.assert_array_equal(gate(view), other(view))
    assert gate.thresholds == other.thresholds


def test_the_ablations_of_thrifty_do_without_their_signal() -> None:
    no_risk = ThriftyDAgger(GateConfig(without="risk", novelty=0.5, risk_ask=0, risk_cede=0, mean_discrepancy=0.1))
    assert no_risk.needs == ("uncertainty",)
    assert one(no_risk, False, uncertainty=0.6)
    assert not one(no_risk, True, discrepancy=0.05, uncertainty=0.2)
    no_novelty = ThriftyDAgger(GateConfig(without="novelty", novelty=0, risk_ask=0.8, risk_cede=0.4, mean_discrepancy=0.1))
    assert not one(no_novelty, False, uncertainty=0.9, goal=0.9)
    assert one(no_novelty, False, uncertainty=0.0, goal=0.1)


# -- HG-DAgger ----------------------------------------------------------------------------------------------------------


def test_the_watching_human_needs_time_to_make_up_their_mind_either_way() -> None:
    gate = HGDAgger(GateConfig(beta_h=0.1, beta_r=0.25, reaction=3))
    judged = [0.2, 0.2, 0.05, 0.2, 0.2, 0.2, 0.01, 0.01, 0.05, 0.01, 0.01, 0.01]
    helped, seen = False, []
    for t, value in enumerate(judged):
        helped = one(gate, helped, t=t, judgement=value)
        seen.append(helped)
    assert seen == [False] * 5 + [True] * 6 + [False]


def test_a_human_sees_only_as_many_robots_as_they_can_watch_but_all_in_turn() -> None:
    gate = HGDAgger(GateConfig(beta_h=0.1, reaction=1, span=2, dwell=5))
    asked = [
        np.flatnonzero(gate(make_view(t, violation=(False,) * 6, judgement=[0.5] * 6))[:, 1]).tolist() for t in range(15)
    ]
    assert asked == [[0, 1]] * 5 + [[2, 3]] * 5 + [[4, 5]] * 5


# -- all of them --------------------------------------------------------------------------------------------------------

READY = GateConfig(beta_h=0.1, doubt=0.3, novelty=0.5, risk_ask=0.8, risk_cede=0.4, mean_discrepancy=0.05, reaction=1)
SIGNALS = ("uncertainty", "goal", "predicted_discrepancy", "judgement")


@pytest.mark.parametrize("name", GATES)
def test_a_gate_by_name_asks_before_it_resets_and_never_for_a_robot_that_fell(name: str) -> None:
    priority = parse(name, PriorityConfig(), READY)
    assert [type(term).__name__ for term in priority.terms] == [GATES[name].__name__, "Constraint"]
    fallen = (True, False, True, False)
    rank = priority(make_view(
        violation=fallen, supervised=[True, True, False, False], humans=4, **{s: [0.9] * 4 for s in SIGNALS}
    ))  # fmt: skip
    assert rank.shape == (4, 3)
    assert (rank[[0, 2], :2] == 0).all()
    assert rank[:, 2].tolist() == [1, 0, 1, 0]


def test_a_robot_keeps_its_human_before_any_other_gets_one() -> None:
    gate = LazyDAgger(BAND)
    view = make_view(
        supervised=[False, True, False, False], discrepancy=[np.nan, 0.05, np.nan, np.nan],
        predicted_discrepancy=[0.9, 0.1, 0.0, 0.99],
    )  # fmt: skip
    mode = np.array([Mode.AUTONOMOUS, Mode.TELEOPERATED, Mode.AUTONOMOUS, Mode.AUTONOMOUS])
    allocator = FleetDAgger(t_teleop=1)
    previous = np.array([1, NOBODY])
    robots = allocator(gate(view), previous, mode, np.array([9, 9, 9, 9]), np.random.default_rng(0))
    assert robots.tolist() == [1, 3]


@pytest.mark.parametrize("name", ["LazyDAgger", "EnsembleDAgger", "ThriftyDAgger", "HG-DAgger"])
def test_a_gate_without_its_numbers_says_so(name: str) -> None:
    signals = {s: [0.5] * 4 for s in SIGNALS}
    with pytest.raises(ConfigError, match="before it starts"):
        parse(name, PriorityConfig(), GateConfig())(make_view(supervised=[True] * 4, discrepancy=[0.1] * 4, **signals))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpha": 0.0}, "alpha must be between 0 and 1"), ({"alpha": 1.0}, "alpha"), ({"alpha_end": 0.0}, "alpha_end"), ({"beta_r": 1.0}, "below 1"),
        ({"beta_r": 0.0}, "above 0"), ({"beta_h": np.nan}, "beta_h"), ({"noise": -1.0}, "noise"), ({"span": 0}, "span"),
        ({"risk_ask": 0.2, "risk_cede": 0.3}, "must not exceed"), ({"without": "novelties"}, "novelty or risk"),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GateConfig(**settings)


# -- in the loop --------------------------------------------------------------------------------------------------------


class Notes:
    """A learner that keeps what it is shown."""

    def __init__(self) -> None:
        self.steps: list[Any] = []

    def record(self, step: Any) -> None:
        self.steps.append(step)

    def update(self, t: int) -> dict[str, float]:
        return {}

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def test_noise_is_executed_and_what_the_human_wanted_is_learned() -> None:
    fleet, notes, low, high = PointFleet(1), Notes(), -np.ones(1), np.ones(1)
    loop = Loop(
        fleet, FakePolicy(0.1), parse("DAgger"), Team([FakeSupervisor(0.5)]), FleetDAgger(1), notes,
        execution=NoiseInjection(0.04, low, high, np.random.default_rng(0)),
    )  # fmt: skip
    for _ in range(200):
        loop.step()
    wanted, done = (np.array([getattr(s, name)[0, 0] for s in notes.steps]) for name in ("wanted", "actions"))
    assert (wanted == 0.5).all()
    assert 0.15 < done.std() < 0.25
    assert abs(done.mean() - 0.5) < 0.05
    assert loop.discrepancy[0] == pytest.approx(0.4**2 / 2**2)


def test_a_new_episode_begins_without_the_human_of_the_last_one() -> None:
    fleet = PointFleet(1, horizon=5)
    signals = {"predicted_discrepancy": lambda view: (view.obs[:, 1] == 2).astype(float)}  # unsafe at the third timestep
    loop = Loop(
        fleet, FakePolicy(0.1), parse("LazyDAgger", gate=BAND), Team([FakeSupervisor(1.0)]), FleetDAgger(1), signals=signals
    )
    modes = [int(loop.step().mode[0]) for _ in range(15)]
    assert modes == [Mode.AUTONOMOUS, Mode.AUTONOMOUS, Mode.TELEOPERATED, Mode.TELEOPERATED, Mode.TELEOPERATED] * 3
