"""Algorithm 4: who helps whom."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import Generator, default_rng

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.allocation import NOBODY, FleetDAgger, highest
from tutelage.fleet.modes import Mode

T_TELEOP, T_RESET = 3, 4


@st.composite
def situations(draw):
    """A moment of a fleet: (ranks, previous, mode, age). Ranks are small integers, so that ties are common."""
    n = draw(st.integers(1, 12))
    m = draw(st.integers(1, n))
    k = draw(st.integers(1, 3))
    rng = default_rng(draw(st.integers(0, 2**32 - 1)))
    ranks = rng.integers(-1, draw(st.integers(1, 4)), (n, k)).astype(float)
    previous = np.where(rng.random(m) < 0.7, rng.permutation(n)[:m], NOBODY)
    mode = rng.choice([Mode.AUTONOMOUS, Mode.VIOLATED], n)
    helped = previous[previous != NOBODY]
    # A human's robot may have fallen, or been set upright, in the last step.
    mode[helped] = rng.choice([m for m in Mode if m != Mode.OFFLINE], len(helped))
    return ranks, previous, mode, rng.integers(0, 6, n)


def algorithm_4(ranks, previous, mode, age):
    """The pseudo-code, line by line: {human: robot} of those who continue, and the others' candidates in order."""
    locked = {}
    for human, robot in enumerate(previous.tolist()):
        if robot != NOBODY and (
            mode[robot] == Mode.SWITCHING
            or (mode[robot] == Mode.RESETTING and age[robot] < T_RESET)
            or (mode[robot] == Mode.TELEOPERATED and age[robot] < T_TELEOP)
        ):
            locked[human] = robot
    positive = [i for i in range(len(ranks)) if i not in locked.values() and any(rank > 0 for rank in ranks[i])]
    return locked, sorted(positive, key=lambda i: tuple(ranks[i]), reverse=True)


def allocate(ranks, previous, mode, age, rng: Generator | None = None):
    return FleetDAgger(T_TELEOP, T_RESET)(ranks, previous, mode, age, rng or default_rng(0))


@given(situations())
def test_it_is_algorithm_4_up_to_ties(situation) -> None:
    ranks, previous, _, _ = situation
    locked, candidates = algorithm_4(*situation)
    robots = allocate(*situation)

    assert {h: robots[h] for h in locked} == locked
    free = [h for h in range(len(previous)) if h not in locked]
    chosen = [int(robots[h]) for h in free if robots[h] != NOBODY]
    best = candidates[: len(free)]
    assert sorted(tuple(ranks[i]) for i in chosen) == sorted(tuple(ranks[i]) for i in best)
    assert set(chosen) <= set(candidates)


@given(situations())
def test_it_is_a_one_to_one_partial_matching(situation) -> None:
    robots = allocate(*situation)
    busy = robots[robots != NOBODY]
    assert len(set(busy.tolist())) == len(busy)
    assert robots.shape == situation[1].shape
    assert ((busy >= 0) & (busy < len(situation[0]))).all()


@given(situations())
def test_a_robot_without_priority_gets_nobody_unless_its_human_must_stay(situation) -> None:
    ranks = situation[0]
    locked, _ = algorithm_4(*situation)
    robots = allocate(*situation)
    for human, robot in enumerate(robots.tolist()):
        assert robot == NOBODY or human in locked or (ranks[robot] > 0).any()


@given(situations())
def test_a_human_whose_robot_is_still_among_the_best_stays_with_it(situation) -> None:
    _, previous, _, _ = situation
    robots = allocate(*situation)
    for human, robot in enumerate(previous.tolist()):
        if robot != NOBODY and robot in robots:
            assert robots[human] == robot


@given(situations())
def test_free_humans_go_to_the_best_robots_first(situation) -> None:
    ranks, previous, _, _ = situation
    robots = allocate(*situation)
    came = [tuple(ranks[robot]) for human, robot in enumerate(robots.tolist()) if robot not in (NOBODY, previous[human])]
    assert came == sorted(came, reverse=True)


@given(situations())
def test_the_arguments_stay_as_they_are(situation) -> None:
    before = [array.copy() for array in situation]
    allocate(*situation)
    for array, copy in zip(situation, before, strict=True):
        np.testing.assert_array_equal(array, copy)


@given(situations(), st.integers(0, 2**32 - 1))
def test_the_same_random_stream_gives_the_same_allocation(situation, seed) -> None:
    np.testing.assert_array_equal(allocate(*situation, default_rng(seed)), allocate(*situation, default_rng(seed)))


@given(situations(), st.integers(0, 14))
def test_the_highest_are_ordered_by_rank(situation, k) -> None:
    ranks, previous = situation[:2]
    exclude = previous[previous != NOBODY]
    best = highest(ranks, k, exclude, default_rng(0))
    candidates = [i for i in range(len(ranks)) if i not in exclude and any(rank > 0 for rank in ranks[i])]
    expected = sorted((tuple(ranks[i]) for i in candidates), reverse=True)[:k]
    assert [tuple(ranks[i]) for i in best] == expected
    assert not set(best.tolist()) & set(exclude.tolist())


def idle(n: int, m: int):
    """Nobody is helped yet: previous, mode, age."""
    return np.full(m, NOBODY), np.full(n, Mode.AUTONOMOUS), np.zeros(n, dtype=int)


def test_lexicographic_order_looks_at_the_second_column_only_between_equals() -> None:
    ranks = np.array([[0.0, 9.0], [1.0, 0.0], [1.0, 0.5], [0.0, 3.0]])
    np.testing.assert_array_equal(allocate(ranks, *idle(4, 3)), [2, 1, 0])


def test_as_many_humans_as_robots_help_all_that_ask() -> None:
    ranks = np.array([[0.2], [0.0], [0.9], [0.5]])
    np.testing.assert_array_equal(allocate(ranks, *idle(4, 4)), [2, 3, 0, NOBODY])


def test_one_human_helps_the_neediest_robot() -> None:
    np.testing.assert_array_equal(allocate(np.array([[0.2], [0.7], [0.1]]), *idle(3, 1)), [1])


def test_infinite_priorities_are_compared_like_others() -> None:
    np.testing.assert_array_equal(allocate(np.array([[1.0], [np.inf], [-np.inf]]), *idle(3, 2)), [1, 0])


@pytest.mark.parametrize(
    ("mode", "minimum"), [(Mode.TELEOPERATED, T_TELEOP), (Mode.RESETTING, T_RESET)], ids=["teleoperation", "reset"]
)
def test_a_human_is_locked_until_the_minimum_time_is_over(mode, minimum) -> None:
    ranks, previous = np.array([[0.0], [5.0]]), np.array([0])
    stayed = [allocate(ranks, previous, np.array([mode, Mode.AUTONOMOUS]), np.array([age, 0]))[0] == 0 for age in range(8)]
    assert stayed == [age < minimum for age in range(8)]


def test_a_human_on_the_way_is_not_called_back() -> None:
    mode, age = np.array([Mode.SWITCHING, Mode.AUTONOMOUS]), np.array([100, 0])
    np.testing.assert_array_equal(allocate(np.array([[0.0], [5.0]]), np.array([0]), mode, age), [0])


def test_ties_prefer_no_robot() -> None:
    n, draws, rng = 20, 4000, default_rng(7)
    counts = np.zeros(n)
    for _ in range(draws):
        counts[allocate(np.ones((n, 2)), *idle(n, 2), rng)] += 1
    mean = 2 * draws / n
    assert np.abs(counts - mean).max() < 5 * np.sqrt(mean)


def test_tied_robots_are_assigned_in_random_order_too() -> None:
    """Humans may differ, so the first human must not always get the robot of the smallest index."""
    rng = default_rng(3)
    first = [allocate(np.ones((2, 1)), *idle(2, 2), rng)[0] for _ in range(400)]
    assert 140 < sum(first) < 260


@pytest.mark.parametrize("column", [0, 1])
def test_a_nan_priority_is_refused_by_name(column) -> None:
    ranks = np.ones((4, 2))
    ranks[2, column] = np.nan
    with pytest.raises(ContractError, match=r"^the priority of robot 2 is NaN$"):
        allocate(ranks, *idle(4, 1))


@pytest.mark.parametrize("times", [{"t_teleop": 0}, {"t_reset": 0}, {"t_teleop": -3}])
def test_a_minimum_time_below_one_step_is_refused(times) -> None:
    with pytest.raises(ConfigError, match="at least 1 timestep"):
        FleetDAgger(**times)


def test_a_hundred_thousand_robots_take_a_moment() -> None:
    n, m, rng = 100_000, 10_000, default_rng(0)
    ranks = np.stack([(rng.random(n) < 0.3).astype(float), rng.random(n)]).T
    start = time.process_time()
    robots = allocate(ranks, *idle(n, m), rng)
    assert time.process_time() - start < 1.0
    expected = np.lexsort([ranks[:, 1], ranks[:, 0]])[::-1][:m]
    np.testing.assert_array_equal(robots, expected)
