"""The table of modes, and the loop's obedience to it under arbitrary demands and accidents."""

from __future__ import annotations

import numpy as np
import pytest
from fakes import FakePriority, PointFleet, make_loop
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tutelage.errors import ContractError
from tutelage.fleet import metrics
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import HELPED, IDLE, INVALID, MOVING, TABLE, Event, Mode, transition
from tutelage.fleet.tally import Tally

EXPECTED = {
    ("AUTONOMOUS", "ASSIGN"): "SWITCHING",
    ("AUTONOMOUS", "VIOLATE"): "VIOLATED",
    ("AUTONOMOUS", "SUCCESS"): "AUTONOMOUS",
    ("AUTONOMOUS", "TIMEOUT"): "AUTONOMOUS",
    ("AUTONOMOUS", "DISCONNECT"): "OFFLINE",
    ("SWITCHING", "TAKE_OVER"): "TELEOPERATED",
    ("SWITCHING", "START_RESET"): "RESETTING",
    ("SWITCHING", "RELEASE"): "AUTONOMOUS",
    ("SWITCHING", "ABANDON"): "VIOLATED",
    ("SWITCHING", "VIOLATE"): "VIOLATED",
    ("SWITCHING", "DISCONNECT"): "OFFLINE",
    ("TELEOPERATED", "RELEASE"): "AUTONOMOUS",
    ("TELEOPERATED", "START_RESET"): "RESETTING",
    ("TELEOPERATED", "VIOLATE"): "VIOLATED",
    ("TELEOPERATED", "SUCCESS"): "TELEOPERATED",
    ("TELEOPERATED", "TIMEOUT"): "TELEOPERATED",
    ("TELEOPERATED", "DISCONNECT"): "OFFLINE",
    ("VIOLATED", "ASSIGN"): "SWITCHING",
    ("VIOLATED", "DISCONNECT"): "OFFLINE",
    ("RESETTING", "HARD_RESET"): "AUTONOMOUS",
    ("RESETTING", "ABANDON"): "VIOLATED",
    ("RESETTING", "DISCONNECT"): "OFFLINE",
    ("OFFLINE", "CONNECT"): "AUTONOMOUS",
    ("OFFLINE", "CONNECT_VIOLATED"): "VIOLATED",
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

    Allocator: type[FleetDAgger] = FleetDAgger

    @initialize(
        n=st.integers(1, 5), m=st.integers(1, 5), latency=st.integers(0, 3), t_teleop=st.integers(1, 4),
        t_reset=st.integers(1, 4), horizon=st.integers(1, 9),
    )  # fmt: skip
    def begin(self, n, m, latency, t_teleop, t_reset, horizon) -> None:
        self.ranks = np.zeros((n, 2))
        self.fleet = PointFleet(n, horizon=horizon)
        self.allocator = self.Allocator(t_teleop, t_reset)
        priority = FakePriority(lambda view: self.ranks)
        self.loop = make_loop(self.fleet, priority, min(m, n), latency=latency, allocator=self.allocator)
        self.mirror = np.full(n, Mode.AUTONOMOUS)
        self.since = np.zeros(n, dtype=int)
        self.down = np.zeros(n, dtype=bool)
        self.latency = latency

    def decide(self, data) -> None:
        """Nothing: algorithm 4 looks at the ranks."""

    def may_leave(self, robot) -> bool:
        """Whether a human may be taken away from the robot: algorithm 4 has minimum times."""
        return self.mirror[robot] == Mode.TELEOPERATED and self.since[robot] >= self.allocator.t_teleop

    @rule(data=st.data())
    def step(self, data) -> None:
        n = self.fleet.num_envs
        few = st.lists(st.integers(0, n - 1), max_size=n)
        self.ranks = np.array(data.draw(st.lists(st.tuples(st.integers(-1, 2), st.integers(0, 2)), min_size=n, max_size=n)))
        self.fleet.falls[self.fleet.t], self.fleet.successes[self.fleet.t] = data.draw(few), data.draw(few)
        self.decide(data)
        step = self.loop.step()

        ended = np.zeros(n, dtype=bool)
        for _, robot, human, event, mode in zip(*step.events, strict=True):
            before = Mode(self.mirror[robot])
            assert EXPECTED[before.name, Event(event).name] == Mode(mode).name
            if event == Event.HARD_RESET:
                assert self.since[robot] + 1 == self.allocator.t_reset
            if event in (Event.RELEASE, Event.ABANDON):
                assert self.may_leave(robot)
            if event in (Event.TAKE_OVER, Event.START_RESET):
                assert self.since[robot] == self.latency
            if event in (
                Event.ASSIGN, Event.RELEASE, Event.ABANDON, Event.TAKE_OVER, Event.START_RESET, Event.HARD_RESET
            ):  # fmt: skip
                assert human != NOBODY
            if event in (Event.VIOLATE, Event.HARD_RESET):
                self.down[robot] = event == Event.VIOLATE
            assert not (self.down[robot] and MOVING[mode]), "who has fallen acts again only after a hard reset"
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
        np.testing.assert_array_equal(self.fleet.violation, self.down)
        np.testing.assert_array_equal(
            self.fleet.violation, np.isin(self.mirror, [Mode.VIOLATED, Mode.RESETTING]) | self._fetched()
        )

    def _fetched(self):
        """Robots in violation whose human is on the way."""
        return (self.mirror == Mode.SWITCHING) & self.fleet.violation


class Whims(FleetDAgger):
    """Sends the humans where it is told, whatever they are doing."""

    def __init__(self, t_teleop: int, t_reset: int) -> None:
        super().__init__(t_teleop, t_reset)
        self.wanted = np.empty(0, dtype=int)

    def __call__(self, ranks, previous, mode, age, rng):
        return self.wanted


class AnyAllocation(AnyFleet):
    """Humans come and go as they like, too: on the way to a robot, in the middle of a hard reset."""

    Allocator = Whims

    def decide(self, data) -> None:
        n, m = self.fleet.num_envs, len(self.loop.team)
        there = data.draw(st.permutations(range(n)))
        here = data.draw(st.lists(st.booleans(), min_size=m, max_size=m))
        stay = data.draw(st.booleans())
        if not stay:
            self.allocator.wanted = np.where(here, there[:m], NOBODY)
        elif not len(self.allocator.wanted):
            self.allocator.wanted = np.full(m, NOBODY)

    def may_leave(self, robot) -> bool:
        return True


for machine in (AnyFleet, AnyAllocation):
    machine.TestCase.settings = settings(max_examples=60, stateful_step_count=40)
TestTheLoopStaysWithinTheTable = AnyFleet.TestCase
TestTheLoopStaysWithinTheTableWhateverTheAllocation = AnyAllocation.TestCase


@pytest.mark.parametrize(("latency", "before"), [(3, Mode.SWITCHING), (0, Mode.RESETTING)])
def test_a_fallen_robot_whose_human_is_called_away_waits_for_the_next_one(latency: int, before: Mode) -> None:
    allocator, fleet = Whims(1, 2), PointFleet(2, falls={0: [0]})
    loop = make_loop(fleet, FakePriority(lambda view: np.zeros((2, 1))), latency=latency, allocator=allocator)
    tally, parts = Tally(2, 1), []
    for robot in (NOBODY, 0, NOBODY, NOBODY, 0, 0, 0, 0, 0, NOBODY):
        allocator.wanted = np.array([robot])
        step = loop.step()
        tally.update(step)
        parts.append(step.events)
    log = EventLog(Events.concatenate(parts), 2, 1, loop.t)
    modes = np.concatenate([np.repeat(m, k) for m, k in spans_of(log, robot=0)])
    assert modes.tolist()[:4] == [Mode.AUTONOMOUS, before, Mode.VIOLATED, Mode.VIOLATED]
    assert metrics.hard_resets(log) == 1
    assert metrics.violations(log) == 1
    assert metrics.idle_time(log) == 5 + latency
    assert tally.summary() == {**metrics.summary(log), "reward": tally.reward}


def spans_of(log: EventLog, robot: int) -> list[tuple[int, int]]:
    """The modes of a robot in their order, and how many timesteps each lasted."""
    spans = metrics.intervals(log)
    mine = spans.where(spans.robot == robot)
    return list(zip(mine.mode.tolist(), mine.length.tolist(), strict=True))
