"""Priority strings, their terms, and the view they look at."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes import make_view as view
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.priority import Priority, PriorityConfig, own_priority, parse

FALLEN = (True, False, False, False)
CONFIG = PriorityConfig(uncertainty=0.3, risk=0.5, initial=10, random=0.5)


def test_c_u_r_is_constraint_then_uncertainty_then_risk() -> None:
    ranks = parse("C.U.R.", CONFIG)(view(
        10, violation=FALLEN, uncertainty=[0.9, 0.9, 0.3, 0.31], risk=[0.9, 0.5, 0.51, 0.0],
    ))  # fmt: skip
    np.testing.assert_array_equal(ranks, [[1, 0, 0], [0, 0.9, 0], [0, 0, 0.51], [0, 0.31, 0]])
    assert ranks.dtype == np.float64


def test_any_order_of_terms_is_the_order_of_columns() -> None:
    signals = {"uncertainty": [0.9] * 4, "risk": [0.8] * 4, "goal": [0.25] * 4}
    columns = {"C": [1, 0, 0, 0], "U": [0, 0.9, 0.9, 0.9], "R": [0, 0.8, 0.8, 0.8], "G": [0, 0.75, 0.75, 0.75]}
    for text in ("C.", "R.", "U.C.", "R.U.C.", "C.R.", "G.U.R.C.", "U.R.G."):
        ranks = parse(text, CONFIG)(view(10, violation=FALLEN, **signals))
        np.testing.assert_array_equal(ranks.T, [columns[name] for name in text.split(".")[:-1]], err_msg=text)


@pytest.mark.parametrize(("t", "expected"), [(0, 0), (9, 0), (10, 1), (11, 1)])
def test_the_constraint_has_no_priority_before_t_i(t, expected) -> None:
    assert parse("C.", CONFIG)(view(t, violation=FALLEN)).tolist() == [[expected], [0], [0], [0]]


@given(
    violation=st.lists(st.booleans(), min_size=1, max_size=6),
    text=st.permutations(["U", "R", "G", "C"]),
    value=st.floats(0, 1),
)
def test_violated_robots_have_neither_uncertainty_nor_risk(violation, text, value) -> None:
    same = [value] * len(violation)
    ranks = parse(".".join(text))(view(violation=violation, uncertainty=same, risk=same, goal=same))
    own = [c for c, name in enumerate(parse(".".join(text)).terms) if type(name).__name__ != "Constraint"]
    assert (ranks[np.ix_(violation, own)] == 0).all()


def test_random_scores_are_uniform_above_the_threshold_and_zero_below() -> None:
    scores = parse("Random.", CONFIG)(view(violation=(False,) * 20_000))[:, 0]
    assert abs((scores > 0).mean() - 0.5) < 0.02
    assert scores[scores > 0].min() > 0.5
    assert abs(scores[scores > 0].mean() - 0.75) < 0.01


def test_random_scores_are_new_for_each_robot_and_each_timestep_and_follow_the_seed() -> None:
    priority, one = parse("Random.", PriorityConfig(random=0.0)), view(seed=1)
    first, second = priority(one), priority(one)
    assert len(set(np.concatenate([first, second])[:, 0].tolist())) == 8
    np.testing.assert_array_equal(priority(view(seed=1)), first)


def test_random_c_asks_for_resets_too() -> None:
    ranks = parse("Random.C.", PriorityConfig(random=1.0))(view(violation=FALLEN))
    np.testing.assert_array_equal(ranks, [[0, 1], [0, 0], [0, 0], [0, 0]])


@pytest.mark.parametrize("text", ["", ".", "X.", "c.", "CUR", "C.U.R.X.", "C.C.", "U.G.U.", "Random.Random.", "C. U."])
def test_an_unknown_or_repeated_term_is_refused_and_the_known_ones_named(text) -> None:
    with pytest.raises(ConfigError, match=r"cannot read the priority .* use different terms of C, U, R, G, Random"):
        parse(text)


@pytest.mark.parametrize(
    ("text", "needs"),
    [("C.", set()), ("Random.", set()), ("C.U.R.", {"uncertainty", "risk"}), ("U.G.C.", {"uncertainty", "goal"}),
     ("R.", {"risk"}), ("G.", {"goal"})],
)  # fmt: skip
def test_a_priority_knows_which_signals_it_needs_and_asks_for_no_other(text, needs) -> None:
    priority = parse(text)
    assert priority.needs == needs
    assert isinstance(priority, Priority)
    seen = view(**{name: [0.1] * 4 for name in ("uncertainty", "risk", "goal")})
    priority(seen)
    assert seen.computed.keys() == needs


@pytest.mark.parametrize(
    "wrong",
    [{"uncertainty": float("nan")}, {"risk": float("inf")}, {"combined": float("nan")}, {"uncertainty_quantile": 1.5},
     {"risk_quantile": -0.1}, {"initial": -1}],
)  # fmt: skip
def test_impossible_numbers_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        PriorityConfig(**wrong)


@pytest.mark.parametrize("threshold", [-0.1, 1.1])
def test_the_threshold_of_random_is_a_probability(threshold) -> None:
    with pytest.raises(ConfigError, match="between 0 and 1"):
        parse("Random.", PriorityConfig(random=threshold))


# -- of the user's own ----------------------------------------------------------------------------------------------


class Recent:
    """Whoever a human has been with for the fewest timesteps, and robots in violation before them."""

    def __init__(self, thresholds: PriorityConfig | None = None, *, scale: float = 1.0) -> None:
        self.thresholds, self.scale, self.calls = thresholds, scale, 0

    def __call__(self, view):
        self.calls += 1
        return np.stack([view.violation, self.scale / (1.0 + view.duration)], axis=1)

    def state_dict(self):
        return {"calls": self.calls}

    def load_state_dict(self, state):
        self.calls = state["calls"]


class Mute(Recent):
    def __call__(self, view):
        return [0.0] * view.num_robots


class Flat(Recent):
    def __call__(self, view):
        return view.violation


def recent() -> Recent:
    return Recent(scale=2.0)


def demanding(scale: float) -> Recent:
    return Recent(scale=scale)


def just_a_class() -> type:
    return Recent


def nothing() -> None:
    return None


def test_a_priority_of_ones_own_gives_the_ranks_and_keeps_its_state() -> None:
    priority = parse(f"{__name__}:recent")
    assert isinstance(priority, Priority)
    assert priority.needs == set()
    seen = view(violation=FALLEN)
    np.testing.assert_array_equal(priority(seen), recent()(seen))
    again = parse(f"{__name__}:recent")
    again.load_state_dict(priority.state_dict())
    assert again.state_dict() == priority.state_dict() == {"0": {"calls": 1}}


def test_a_priority_of_ones_own_gets_the_thresholds_if_it_takes_them() -> None:
    assert own_priority(f"{__name__}:Recent", CONFIG).thresholds is CONFIG  # type: ignore[attr-defined]
    assert own_priority(f"{__name__}:Recent").thresholds == PriorityConfig()  # type: ignore[attr-defined]
    assert own_priority(f"{__name__}:recent", CONFIG).thresholds is None  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("no_such_module:P", ConfigError, "priority 'no_such_module:P': no module 'no_such_module'"),
        ("math:P", ConfigError, "module 'math' has no callable 'P'"),
        ("math:pi", ConfigError, "module 'math' has no callable 'pi'"),
        (":P", ConfigError, "write module:callable"),
        ("{here}:demanding", ConfigError, "cannot be made: missing a required argument: 'scale'"),
        ("{here}:nothing", ContractError, "must return a priority, .* got NoneType"),
        ("{here}:just_a_class", ContractError, "must return a priority, .* got type"),
    ],
)
def test_a_priority_of_ones_own_that_cannot_be_made_is_named(name, error, message) -> None:
    with pytest.raises(error, match=message):
        parse(name.replace("{here}", __name__))


@pytest.mark.parametrize(("name", "found"), [("Mute", "list"), ("Flat", r"\(4,\)")])
def test_a_priority_of_ones_own_must_return_a_row_for_each_robot(name, found) -> None:
    with pytest.raises(ContractError, match=rf"priority '.*:{name}' must return an array \(4, K\), got {found}"):
        parse(f"{__name__}:{name}")(view(violation=FALLEN))


# -- U.G. -----------------------------------------------------------------------------------------------------------


def history(seed: int, steps: int = 12, n: int = 4):
    """(violation, supervised, uncertainty, goal) of each step."""
    rng = default_rng(seed)
    return [(rng.random(n) < 0.3, rng.random(n) < 0.3, rng.gamma(2.0, 0.1, n), rng.random(n)) for _ in range(steps)]


@given(st.integers(0, 1000), st.floats(-1, 2), st.floats(0, 2))
def test_u_g_is_the_sum_of_z_scores_over_the_whole_history(seed, threshold, weight) -> None:
    priority = parse("U.G.C.", PriorityConfig(combined=threshold, goal_weight=weight))
    own: list[np.ndarray] = []
    for t, (violation, supervised, uncertainty, goal) in enumerate(history(seed)):
        ranks = priority(view(t, violation=violation, supervised=supervised, uncertainty=uncertainty, goal=goal))
        raw = np.stack([uncertainty, 1 - goal], axis=1)
        own.append(raw[~violation & ~supervised])
        past = np.concatenate(own)
        if len(past) < 2:
            continue
        z = (raw - past.mean(axis=0)) / past.std(axis=0)
        score = z @ [1.0, weight]
        clear = np.abs(score - threshold) > 1e-6
        np.testing.assert_allclose(
            ranks[clear, 0], np.where((score > threshold) & ~violation, score, 0.0)[clear], rtol=1e-6, atol=1e-9
        )
        np.testing.assert_array_equal(ranks[:, 1], violation)


def test_u_g_stays_quiet_while_nothing_varies_or_nobody_is_on_their_own() -> None:
    priority = parse("U.G.", PriorityConfig(combined=0.0))
    np.testing.assert_array_equal(priority(view(uncertainty=[0.5] * 4, goal=[0.5] * 4)), np.zeros((4, 1)))
    fresh = parse("U.G.", PriorityConfig(combined=0.0))
    everybody = (True,) * 4
    np.testing.assert_array_equal(fresh(view(supervised=everybody, uncertainty=[0.1, 0.2, 0.3, 0.4], goal=[0.5] * 4)), 0)


def test_u_g_moments_stay_exact_far_from_zero() -> None:
    """A running sum of squares would lose all digits here."""
    priority = parse("U.G.", PriorityConfig(combined=-100.0, goal_weight=0.0))
    values = 1e8 + default_rng(0).random((50, 4))
    ranks = [priority(view(uncertainty=row, goal=[0.5] * 4))[:, 0] for row in values]
    np.testing.assert_allclose(ranks[-1], (values[-1] - values.mean()) / values.std(), rtol=1e-4)


def test_u_g_continues_after_a_round_trip_of_its_state() -> None:
    priority = parse("C.U.G.", PriorityConfig(combined=0.5))
    steps = [view(violation=v, supervised=s, uncertainty=u, goal=g) for v, s, u, g in history(0, 20)]
    for step in steps[:10]:
        priority(step)
    state = priority.state_dict()
    again = parse("C.U.G.", PriorityConfig(combined=0.5))
    json.dumps({k: v for k, v in state["1"].items() if not isinstance(v, np.ndarray)})
    again.load_state_dict(state)
    for step in steps[10:]:
        np.testing.assert_array_equal(priority(step), again(step))


# -- the view -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [[0.1, 0.2], [[0.1]] * 4, 0.5])
def test_a_signal_of_the_wrong_shape_is_refused(wrong) -> None:
    with pytest.raises(ContractError, match=r"signal 'risk' must have shape \(4,\)"):
        parse("R.")(view(risk=wrong))


def test_a_signal_that_is_not_finite_is_refused_with_the_robot() -> None:
    with pytest.raises(ContractError, match="signal 'risk' is not finite for robot 2"):
        parse("R.")(view(risk=[0.1, 0.2, np.nan, np.inf]))
