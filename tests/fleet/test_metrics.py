"""The metrics: worked by hand on a small log, and against a brute-force replay."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import Row, logs, make_log, replay

from tutelage.errors import ContractError
from tutelage.fleet import metrics
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import HELPED, Event, Mode

A, S, T, V, R, O = Mode  # noqa: E741 - as in the table of modes


# N = 3 robots, M = 2 humans, T = 12 timesteps; switching latency 1 for the reset of robot 1, none elsewhere.
#
#   t         0  1  2  3  4  5  6  7  8  9 10 11
#   robot 0   A  A  T  T  T  A  A  A  A  T  T  T     success at the end of 3 (teleoperated) and of 8 (alone)
#   robot 1   A  V  V  S  R  R  A  A  A  A  A  A     violation at the end of 0, human from 3, reset over at the end of 5
#   robot 2   A  A  A  A  A  T  V  V  V  V  V  V     violation at the end of 5 while teleoperated, nobody comes; timeout at 2
HAND: list[Row] = [
    (0, 1, -1, Event.VIOLATE, V),
    (2, 0, 0, Event.ASSIGN, S),
    (2, 0, 0, Event.TAKE_OVER, T),
    (2, 2, -1, Event.TIMEOUT, A),
    (3, 1, 1, Event.ASSIGN, S),
    (3, 0, 0, Event.SUCCESS, T),
    (4, 1, 1, Event.START_RESET, R),
    (5, 0, 0, Event.RELEASE, A),
    (5, 2, 0, Event.ASSIGN, S),
    (5, 2, 0, Event.TAKE_OVER, T),
    (5, 2, 0, Event.VIOLATE, V),
    (5, 1, 1, Event.HARD_RESET, A),
    (8, 0, -1, Event.SUCCESS, A),
    (9, 0, 1, Event.ASSIGN, S),
    (9, 0, 1, Event.TAKE_OVER, T),
]


@pytest.fixture
def hand() -> EventLog:
    return make_log(HAND, 3, 2, 12)


def test_intervals_of_the_worked_log(hand: EventLog) -> None:
    spans = metrics.intervals(hand)
    rows = list(zip(*(column.tolist() for column in spans), strict=True))
    assert rows == [
        # robot, human, mode, violated, start, end
        (0, -1, A, False, 0, 2),
        (0, 0, T, False, 2, 5),
        (0, -1, A, False, 5, 9),
        (0, 1, T, False, 9, 12),
        (1, -1, A, False, 0, 1),
        (1, -1, V, True, 1, 3),
        (1, 1, S, True, 3, 4),
        (1, 1, R, True, 4, 6),
        (1, -1, A, False, 6, 12),
        (2, -1, A, False, 0, 5),
        (2, 0, T, False, 5, 6),
        (2, -1, V, True, 6, 12),
    ]


def test_counts_of_the_worked_log(hand: EventLog) -> None:
    assert metrics.successes(hand) == 2
    assert metrics.violations(hand) == 2
    assert metrics.hard_resets(hand) == 1
    assert metrics.timeouts(hand) == 1
    assert metrics.successes_curve(hand).tolist() == [0, 0, 0, 1, 1, 1, 1, 1, 2, 2, 2, 2]
    assert metrics.violations_curve(hand).tolist() == [1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2]
    assert metrics.hard_resets_curve(hand).tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]


def test_times_of_the_worked_log(hand: EventLog) -> None:
    # robot 1: V V S R R = 5; robot 2: V at 6..11 = 6
    assert metrics.idle_time(hand) == 5 + 6
    assert metrics.idle_time_curve(hand).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
    # teleoperation: robot 0 at 2..4 and 9..11, robot 2 at 5; reset: robot 1 at 4, 5; waiting: robot 1 at 3
    assert metrics.human_time(hand) == (3 + 3 + 1, 2, 1)
    assert metrics.human_time(hand).total == 10
    assert metrics.human_time_curve(hand).tolist() == [0, 0, 1, 3, 5, 7, 7, 7, 7, 8, 9, 10]
    # A: 2 + 4 + 1 + 6 + 5 = 18; S: 1; T: 7; V: 2 + 6; R: 2; together N T = 36
    assert metrics.time_in_modes(hand).tolist() == [18, 1, 7, 8, 2, 0]


def test_interventions_of_the_worked_log(hand: EventLog) -> None:
    assert metrics.switches_to_human(hand) == 3
    assert metrics.switches_to_robot(hand) == 2  # released at 5, fell at 5; the last one is still going on at T
    assert metrics.context_switches(hand) == 5
    assert metrics.supervisor_actions(hand) == 7
    assert metrics.intervention_lengths(hand).tolist() == [3, 3, 1]


def test_rohe_of_the_worked_log(hand: EventLog) -> None:
    # eq. 5.2: 2/3 * 2 / (1 + 10/100) = 4/3.3, and 2/3 * 2 / (1 + 10) for human time in single timesteps
    assert metrics.HUMAN_TIME_UNIT == 100
    assert metrics.rohe(hand) == pytest.approx(4 / 3.3)
    assert metrics.rohe(hand, unit=1) == pytest.approx(4 / 33)
    # after timestep 3: one success, 3 human timesteps
    assert metrics.rohe_curve(hand)[3] == pytest.approx(2 / 3 * 1 / 1.03)
    assert metrics.rohe_curve(hand)[-1] == pytest.approx(metrics.rohe(hand))


def test_burdens_of_the_worked_log(hand: EventLog) -> None:
    assert metrics.burden(hand, latency=4) == 4 * 5 + 7  # eq. 2.2
    assert metrics.burden_per_intervention(hand, latency=4) == pytest.approx(3 * (4 + 7 / 3))  # eq. 3.2


def test_an_empty_log_has_no_effort_and_no_return() -> None:
    log = make_log([], 2, 1, 0)
    assert metrics.rohe(log) == 0
    assert metrics.rohe_curve(log).shape == (0,)
    assert metrics.burden_per_intervention(log, 5) == 0
    assert len(metrics.intervals(log).robot) == 0


def interventions(*spans: tuple[int, int]) -> EventLog:
    """A robot that is teleoperated from start to before end, for each span."""
    rows: list[Row] = []
    for start, end in spans:
        rows += [(start, 0, 0, Event.ASSIGN, S), (start, 0, 0, Event.TAKE_OVER, T), (end, 0, 0, Event.RELEASE, A)]
    return make_log(rows, 1, 1, 100)


@pytest.mark.parametrize(
    ("mine", "baseline", "expected"),
    [
        # C = 2, D = 10 against C = 6, D = 6: L* = (10 - 6) / (6 - 2)
        (((0, 10),), ((0, 2), (10, 12), (20, 22)), 1.0),
        # fewer switches and fewer actions: always lower
        (((0, 5),), ((0, 5), (10, 15)), 0.0),
        # as many switches, fewer actions: always lower; as many actions: never strictly lower
        (((0, 4),), ((0, 5),), 0.0),
        (((0, 5),), ((0, 5),), math.inf),
        # more switches: for large L never lower
        (((0, 1), (5, 6)), ((0, 50),), math.inf),
    ],
)
def test_cutoff_latency(mine: Any, baseline: Any, expected: float) -> None:
    mine, baseline = interventions(*mine), interventions(*baseline)
    cutoff = metrics.cutoff_latency(mine, baseline)
    assert cutoff == expected
    if math.isfinite(cutoff):  # lower above L*, not lower below
        assert metrics.burden(mine, cutoff + 0.01) < metrics.burden(baseline, cutoff + 0.01)
        if cutoff > 0:
            assert metrics.burden(mine, cutoff - 0.01) >= metrics.burden(baseline, cutoff - 0.01)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 5, -1, Event.VIOLATE, V)], "event 0: robot is 5, outside 0..2"),
        ([(12, 0, -1, Event.VIOLATE, V)], "event 0: t is 12, outside 0..11"),
        ([(0, 0, 2, Event.ASSIGN, S)], "event 0: human is 2, outside -1..1"),
        ([(0, 0, -1, Event.HARD_RESET, A)], "event 0: HARD_RESET cannot take robot 0 from AUTONOMOUS to AUTONOMOUS"),
        ([(0, 0, -1, Event.VIOLATE, R)], "event 0: VIOLATE cannot take robot 0 from AUTONOMOUS to RESETTING"),
        ([(3, 0, -1, Event.VIOLATE, V), (2, 1, -1, Event.VIOLATE, V)], "event 1 is earlier than the one before it"),
    ],
)
def test_impossible_logs_are_refused(rows: list[Row], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        make_log(rows, 3, 2, 12)


# -- against a replay of single steps -----------------------------------------------------------------------------------


@given(logs())
@settings(max_examples=150, deadline=None)
def test_metrics_agree_with_a_replay(log: EventLog) -> None:
    modes, broken = replay(log)
    spans = metrics.intervals(log)
    painted, touched = np.full_like(modes, -1), np.zeros_like(modes)
    for robot, _, mode, violated, start, end in zip(*spans, strict=True):
        painted[start:end, robot] = mode
        touched[start:end, robot] += 1
        assert (broken[start:end, robot] == violated).all()
    np.testing.assert_array_equal(painted, modes)
    assert (touched == 1).all()

    np.testing.assert_array_equal(metrics.idle_time_curve(log), broken.sum(axis=1).cumsum())
    np.testing.assert_array_equal(metrics.human_time_curve(log), HELPED[modes].sum(axis=1).cumsum())
    assert metrics.human_time(log) == tuple(int((modes == mode).sum()) for mode in (T, R, S))
    np.testing.assert_array_equal(metrics.time_in_modes(log), np.bincount(modes.ravel(), minlength=len(Mode)))
    assert metrics.intervention_lengths(log).sum() == metrics.supervisor_actions(log)
    interventions_left = metrics.switches_to_human(log) - metrics.switches_to_robot(log)
    assert 0 <= interventions_left <= log.num_robots


@given(logs(), st.integers(0, 12))
@settings(max_examples=50, deadline=None)
def test_curves_are_the_metrics_of_the_log_until_then(log: EventLog, steps: int) -> None:
    steps = min(steps, log.steps)
    early = log.until(steps)
    for total, curve in (
        (metrics.successes, metrics.successes_curve),
        (metrics.violations, metrics.violations_curve),
        (metrics.hard_resets, metrics.hard_resets_curve),
        (metrics.idle_time, metrics.idle_time_curve),
        (lambda log: metrics.human_time(log).total, metrics.human_time_curve),
        (metrics.rohe, metrics.rohe_curve),
    ):
        assert curve(log).shape == (log.steps,)
        assert total(early) == pytest.approx(curve(log)[steps - 1] if steps else 0)
