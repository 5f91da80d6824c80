"""Episodes one by one, worked by hand and against a replay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import Row, logs, make_log

from tutelage.fleet.attempts import attempts, request_rate
from tutelage.fleet.metrics import EventLog, supervisor_actions
from tutelage.fleet.modes import Event, Mode

A, S, T, V, R, O = Mode  # noqa: E741 - as in the table of modes

# N = 2 robots, M = 1 human, T = 12 timesteps.
#
#   t         0  1  2  3  4  5  6  7  8  9 10 11
#   robot 0   A  A  T  T  T  A  A  T  A  A  A  A     success at the end of 3 (teleoperated, goes on) and of 8
#   robot 1   A  V  V  V  V  V  V  V  R  R  A  A     violation at the end of 0, reset over at the end of 9, timeout at 11
HAND: list[Row] = [
    (0, 1, -1, Event.VIOLATE, V),
    (2, 0, 0, Event.ASSIGN, S),
    (2, 0, 0, Event.TAKE_OVER, T),
    (3, 0, 0, Event.SUCCESS, T),
    (5, 0, 0, Event.RELEASE, A),
    (7, 0, 0, Event.ASSIGN, S),
    (7, 0, 0, Event.TAKE_OVER, T),
    (8, 0, 0, Event.RELEASE, A),
    (8, 1, 0, Event.ASSIGN, S),
    (8, 1, 0, Event.START_RESET, R),
    (8, 0, -1, Event.SUCCESS, A),
    (9, 1, 0, Event.HARD_RESET, A),
    (11, 1, -1, Event.TIMEOUT, A),
]


def test_the_episodes_of_the_worked_log() -> None:
    rows = list(zip(*(column.tolist() for column in attempts(make_log(HAND, 2, 1, 12))), strict=True))
    assert rows == [
        # robot, start, end, outcome, interventions, human actions, robot actions
        (1, 0, 1, Event.VIOLATE, 0, 0, 1),
        (0, 0, 4, Event.SUCCESS, 1, 2, 2),
        (0, 4, 9, Event.SUCCESS, 2, 2, 3),
        (1, 10, 12, Event.TIMEOUT, 0, 0, 2),
    ]


def test_the_request_rate_is_per_timestep_in_which_a_robot_acts_by_itself() -> None:
    assert request_rate(make_log(HAND, 2, 1, 12)) == pytest.approx(2 / (8 + 3))
    assert request_rate(make_log([(0, 0, 0, Event.ASSIGN, S), (0, 0, 0, Event.TAKE_OVER, T)], 1, 1, 5)) == 0.0


@settings(deadline=None)
@given(log=logs(), data=st.data())
def test_episodes_never_overlap_and_hold_all_that_happened_before_the_last_end(log: EventLog, data: st.DataObject) -> None:
    found = attempts(log)
    assert len(found.robot) == np.isin(log.events.event, (Event.SUCCESS, Event.TIMEOUT, Event.VIOLATE)).sum()
    assert (np.diff(found.end) >= 0).all()
    for robot in set(found.robot.tolist()):
        mine = found.where(found.robot == robot)
        assert (mine.start[1:] >= mine.end[:-1]).all()
    assert ((found.human_actions + found.robot_actions) <= found.end - found.start).all()
    assert found.human_actions.sum() <= supervisor_actions(log)
    assert (found.interventions <= found.human_actions).all()
    assert ((found.interventions > 0) == (found.human_actions > 0)).all()
