"""People, desk and loop together, with a clock of the test's: whatever happens, no transition is impossible."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from fakes import FakePolicy, PointFleet
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tutelage.console.controls import Driver, controls_of
from tutelage.console.offers import Offers, Terms
from tutelage.console.people import Desk, People, ended_by
from tutelage.console.reasons import Reasons
from tutelage.console.states import Denied, LeaseEnded, LeaseGranted
from tutelage.console.stoppable import StoppableFleet
from tutelage.fleet.loop import Loop
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import Mode
from tutelage.fleet.priority import PriorityConfig, parse
from tutelage.fleet.step import Step

N, M = 4, 3
NAMES = st.sampled_from(["ann", "bob", "eve", "kim"])
ROBOTS = st.integers(0, N - 1)


class Floor(RuleBasedStateMachine):
    """A small fleet whose robots fall, arrive, vanish and are stopped, and people who do what they like."""

    @initialize(gated=st.booleans(), wait=st.booleans(), fifo=st.booleans())
    def begin(self, gated: bool, wait: bool, fifo: bool) -> None:
        self.now = 0.0
        self.points = PointFleet(N, bound=0.5, goal=0.4, horizon=12)
        self.fleet = StoppableFleet(self.points)
        self.uncertain = np.zeros(N)
        self.lock = threading.Condition()
        self.offers = Offers(N, M, Terms())
        driver = Driver(controls_of("points", self.fleet, assist=False), self.fleet)
        self.people = People(self.offers, driver, self.lock, self.clock)
        self.reasons = Reasons(parse("C.U.", PriorityConfig(uncertainty=0.5, initial=0)), self.offers, fifo)
        desk = Desk(self.people, self.reasons, self.clock, t_reset=2, gated=gated)
        policy = FakePolicy(0.0, lambda obs: self.uncertain)
        self.loop = Loop(self.fleet, policy, self.reasons, self.people, desk, wait=wait)
        self.steps: list[Step] = []
        self.granted: set[str] = set()
        self.ended: set[str] = set()
        self.seq = 0
        self.meanwhile: list[tuple[str, tuple[Any, ...]]] = []
        start = self.points.step_async

        def step_async(actions: Any, active: Any = None) -> None:
            start(actions, active)
            for what, arguments in self.meanwhile:
                self.ask_for(what, *arguments)
            self.meanwhile = []

        self.points.step_async = step_async  # type: ignore[method-assign]

    def clock(self) -> float:
        return self.now

    def ask_for(self, what: str, *arguments: Any) -> None:
        try:
            getattr(self.offers, what)(*arguments, self.now)
        except Denied as denied:
            assert denied.code != "unknown_robot"

    @rule(name=NAMES, what=st.sampled_from(["join", "join", "leave"]))
    def come_and_go(self, name: str, what: str) -> None:
        self.ask_for(what, name)

    @rule(name=NAMES, robot=ROBOTS, what=st.sampled_from(["accept", "decline", "take", "take", "give_back", "reset"]))
    def act(self, name: str, robot: int, what: str) -> None:
        self.ask_for(what, name, robot)

    @rule(name=NAMES, robot=ROBOTS, to=NAMES)
    def hand_over(self, name: str, robot: int, to: str) -> None:
        self.ask_for("hand_over", name, robot, to)

    @rule(name=NAMES, other=NAMES, robot=ROBOTS, what=st.sampled_from(["give_back", "take", "accept", "reset", "leave"]))
    def in_the_middle_of_a_timestep(self, name: str, other: str, robot: int, what: str) -> None:
        """Somebody does something while robots move, and then somebody else wants the robot."""
        self.meanwhile.append((what, (name,) if what == "leave" else (name, robot)))
        self.meanwhile.append(("take", (other, robot)))

    @rule(to=NAMES)
    def robots_that_change_hands_as_their_reset_begins(self, to: str) -> None:
        for robot, hold in list(self.offers.holds.items()):
            self.ask_for("hand_over", hold.lease.operator, robot, to)
            self.ask_for("reset", hold.lease.operator, robot)
            self.meanwhile.append(("accept", (to, robot)))

    @rule(robot=ROBOTS)
    def everybody_wants_it(self, robot: int) -> None:
        for name in ("ann", "bob", "eve"):
            self.ask_for("join", name)
            self.ask_for("take", name, robot)

    @rule(what=st.sampled_from(["give_back", "leave", "reset"]))
    def resets_that_people_do_not_wait_for(self, what: str) -> None:
        for robot, hold in self.offers.holds.items():
            self.meanwhile.append((what, (hold.lease.operator,) if what == "leave" else (hold.lease.operator, robot)))
            self.meanwhile += [("take", (name, robot)) for name in ("kim", "eve", "bob", "ann")]
        for robot, hold in list(self.offers.holds.items()):
            self.ask_for("reset", hold.lease.operator, robot)

    @rule()
    def everybody_accepts(self) -> None:
        for pending in (self.offers.offers, self.offers.passing):
            for robot, offer in list(pending.items()):
                seat = self.offers.seats[offer.human]
                assert seat is not None
                self.ask_for("accept", seat.operator, robot)

    @rule(robot=ROBOTS, action=st.sampled_from([-1.0, -0.2, 0.2, 1.0, None]))
    def command(self, robot: int, action: float | None) -> None:
        hold = self.offers.holds.get(robot)
        if hold is not None:
            self.seq += 1
            given = None if action is None else [action]
            self.people.give(hold.lease.operator, robot, hold.lease.id, self.seq, given, False, None)

    @rule(robot=ROBOTS, stop=st.booleans())
    def emergency(self, robot: int, stop: bool) -> None:
        if stop:
            self.fleet.stop([robot])
            self.offers.stop([robot], self.now)
        else:
            self.offers.clear([robot])
            self.fleet.clear([robot])

    @rule(robots=st.lists(ROBOTS, unique=True), what=st.sampled_from(["falls", "successes", "doubts"]))
    def robots_need(self, robots: list[int], what: str) -> None:
        if what == "doubts":
            self.uncertain = np.isin(np.arange(N), robots).astype(float)
        else:
            getattr(self.points, what)[self.points.t] = robots

    @rule(n=st.integers(1, 4), seconds=st.sampled_from([0.1, 0.1, 0.1, 4.0, 20.0]))
    def go_on(self, n: int, seconds: float) -> None:
        for _ in range(n):
            self.now += seconds
            stopped = self.fleet.stopped.copy()
            before = self.loop.obs[:, 0].copy()
            step = self.loop.step()
            self.steps.append(step)
            for robot, why in ended_by(step.events):
                self.offers.end(robot, why, self.now)
            self.people.violation = self.loop.violation
            self.check(step, stopped, before)

    def check(self, step: Step, stopped: Any, before: Any) -> None:
        silent = (step.mode == Mode.TELEOPERATED) & ~step.taught
        still = stopped | silent | (step.mode == Mode.SWITCHING)
        moved = step.next_obs[:, 0] != before
        assert not (moved & still).any(), "who is stopped, held or waited for stands still"

    @invariant()
    def one_to_one(self) -> None:
        if not hasattr(self, "loop"):
            return
        robots = self.loop.robot_of[self.loop.robot_of >= 0].tolist()
        assert len(set(robots)) == len(robots)

    @invariant()
    def leases_begin_and_end_once(self) -> None:
        if not hasattr(self, "loop"):
            return
        for event in self.offers.take_events():
            if isinstance(event, LeaseGranted):
                self.granted.add(event.lease.id)
            elif isinstance(event, LeaseEnded):
                assert event.lease in self.granted - self.ended
                self.ended.add(event.lease)
        assert {hold.lease.id for hold in self.offers.holds.values()} == self.granted - self.ended

    def teardown(self) -> None:
        """The log of events is one that metrics accept."""
        if not hasattr(self, "loop") or not self.steps:
            return
        from tutelage.fleet.events import Events

        EventLog(Events.concatenate([step.events for step in self.steps]), N, M, self.loop.t)


Floor.TestCase.settings = settings(max_examples=500, stateful_step_count=40, deadline=None)
TestFloor = Floor.TestCase
