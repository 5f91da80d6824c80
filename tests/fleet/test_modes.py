"""The table of modes, and the loop's obedience to it under arbitrary demands and accidents."""

from __future__ import annotations

import numpy as np
import pytest
from fakes import FakePriority, PointFleet, make_loop
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tutelage.errors import ContractError
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.modes import HELPED, IDLE, INVALID, MOVING, TABLE, Event, Mode, transition

EXPECTED = {
    ("AUTONOMOUS", "ASSIGN"): "SWITCHING",
    ("AUTONOMOUS", "VIOLATE"): "VIOLATED",
    ("AUTONOMOUS", "SUCCESS"): "AUTONOMOUS",
    ("AUTONOMOUS", "TIMEOUT"): "AUTONOMOUS",
    ("AUTONOMOUS", "DISCONNECT"): "OFFLINE",
    ("SWITCHING", "TAKE_OVER"): "TELEOPERATED",
    ("SWITCHING", "START_RESET"): "RESETTING",
    ("SWITCHING", "RELEASE"): "AUTONOMOUS",
    ("SWITCHING", "VIOLATE"): "VIOLATED",
    ("SWITCHING", "DISCONNECT"): "OFFLINE",
    ("TELEOPERATED", "RELEASE"): "AUTONOMOUS",
    ("TELEOPERATED", "VIOLATE"): "VIOLATED",
    ("TELEOPERATED", "SUCCESS"): "TELEOPERATED",
    ("TELEOPERATED", "TIMEOUT"): "TELEOPERATED",
    ("TELEOPERATED", "DISCONNECT"): "OFFLINE",
    ("VIOLATED", "ASSIGN"): "SWITCHING",
    ("VIOLATED", "DISCONNECT"): "OFFLINE",
    ("RESETTING", "HARD_RESET"): "AUTONOMOUS",
    ("RESETTING", "RELEASE"): "VIOLATED",
    ("RESETTING", "DISCONNECT"): "OFFLINE",
    ("OFFLINE", "CONNECT"): "AUTONOMOUS",
}


def test_the_table_is_what_is_written_here() -> None:
    found = {(m.name, e.name): Mode(TABLE[m, e]).name for m in Mode for e in Event if TABLE[m, e] != INVALID}
    assert found == EXPECTED


@pytest.mark.parametrize(("mode", "event"), [(m, e) for m in Mode for e in Event if (m.name, e.name) not in EXPECTED])
def test_an_impossible_event_is_refused_with_the_robot_and_its_mode(mode, event) -> None:
    modes = np.full(3, mode, dtype=np.int8)
    with pytest.raises(ContractError, match=f"^robot 2 is {mode.name}: {event.name} cannot happen to it$"):
        transition(modes, np.array([2]), event)


def test_a_transition_concerns_the_given_robots_and_changes_nothing_in_place() -> None:
    modes = np.array([Mode.AUTONOMOUS, Mode.VIOLATED, Mode.TELEOPERATED], dtype=np.int8)
    after = transition(modes, np.array([2, 0]), Event.VIOLATE)
    assert after.tolist() == [Mode.VIOLATED, Mode.VIOLATED]
    assert modes.tolist() == [Mode.AUTONOMOUS, Mode.VIOLATED, Mode.TELEOPERATED]


def test_what_the_modes_mean() -> None:
    assert [m.name for m in Mode if HELPED[m]] == ["SWITCHING", "TELEOPERATED", "RESETTING"]
    assert [m.name for m in Mode if MOVING[m]] == ["AUTONOMOUS", "TELEOPERATED"]
    assert [m.name for m in Mode if IDLE[m]] == ["VIOLATED", "RESETTING"]


class AnyFleet(RuleBasedStateMachine):
    """Priorities, falls and successes come as they like; the loop must stay within the table, step for step."""

    @initialize(
        n=st.integers(1, 5), m=st.integers(1, 5), latency=st.integers(0, 3), t_teleop=st.integers(1, 4),
        t_reset=st.integers(1, 4), horizon=st.integers(1, 9),
    )  # fmt: skip
    def begin(self, n, m, latency, t_teleop, t_reset, horizon) -> None:
        self.ranks = np.zeros((n, 2))
        self.fleet = PointFleet(n, horizon=horizon)
        self.allocator = FleetDAgger(t_teleop, t_reset)
        priority = FakePriority(lambda view: self.ranks)
        self.loop = make_loop(self.fleet, priority, min(m, n), latency=latency, allocator=self.allocator)
        self.mirror = np.full(n, Mode.AUTONOMOUS)
        self.since = np.zeros(n, dtype=int)
        self.latency = latency

    @rule(data=st.data())
    def step(self, data) -> None:
        n = self.fleet.num_envs
        few = st.lists(st.integers(0, n - 1), max_size=n)
        self.ranks = np.array(data.draw(st.lists(st.tuples(st.integers(-1, 2), st.integers(0, 2)), min_size=n, max_size=n)))
        self.fleet.falls[self.fleet.t], self.fleet.successes[self.fleet.t] = data.draw(few), data.draw(few)
        step = self.loop.step()

        ended = np.zeros(n, dtype=bool)
        for _, robot, human, event, mode in zip(*step.events, strict=True):
            before = Mode(self.mirror[robot])
            assert EXPECTED[before.name, Event(event).name] == Mode(mode).name
            if event == Event.HARD_RESET:
                assert self.since[robot] + 1 == self.allocator.t_reset
            if event == Event.RELEASE:
                assert self.since[robot] >= self.allocator.t_teleop
            if event in (Event.TAKE_OVER, Event.START_RESET):
                assert self.since[robot] == self.latency
            if event in (Event.ASSIGN, Event.RELEASE, Event.TAKE_OVER, Event.START_RESET, Event.HARD_RESET):
                assert human != NOBODY
            if before != mode:
                self.since[robot] = 0
                ended[robot] = event in (Event.VIOLATE, Event.HARD_RESET)
            self.mirror[robot] = mode
        self.since += ~ended
        np.testing.assert_array_equal(HELPED[step.mode], step.human != NOBODY)
        np.testing.assert_array_equal(self.fleet.moved[-1], MOVING[step.mode])

    @invariant()
    def the_loop_and_its_events_agree(self) -> None:
        np.testing.assert_array_equal(self.loop.mode, self.mirror)
        np.testing.assert_array_equal(self.loop.age, self.since)
        np.testing.assert_array_equal(
            self.fleet.violation, np.isin(self.mirror, [Mode.VIOLATED, Mode.RESETTING]) | self._fetched()
        )

    def _fetched(self):
        """Robots in violation whose human is on the way."""
        return (self.mirror == Mode.SWITCHING) & self.fleet.violation


AnyFleet.TestCase.settings = settings(max_examples=60, stateful_step_count=40)
TestTheLoopStaysWithinTheTable = AnyFleet.TestCase
