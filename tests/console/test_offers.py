"""Offers and leases: whatever people, robots and time do, a robot has one holder, and everybody gets their turn."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tutelage.console.offers import NOBODY, Offers, Terms
from tutelage.console.states import Denied, LeaseEnded, LeaseGranted, Offer
from tutelage.errors import TutelageError

TERMS = Terms(offer=15.0, declined=30.0, ignored=5.0, fresh=0.5, grace=5.0, idle=120.0)


def desk(robots: int = 3, seats: int = 2, **rest: object) -> Offers:
    return Offers(robots, seats, TERMS, new_id=iter(map(str, range(10**6))).__next__, **rest)  # type: ignore[arg-type]


def ask(offers: Offers, *robots: int, now: float = 0.0, reason: str = "uncertain") -> list[tuple[str | None, int]]:
    """Robots ask; who is offered which."""
    offers.ask(robots, [reason] * len(robots), now)
    offers.tick(now)
    return [(e.operator, e.robot) for e in offers.take_events() if isinstance(e, Offer)]


class TestOffers:
    def test_the_neediest_robot_is_offered_first_to_whoever_is_free_longest(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 1.0)
        assert ask(offers, 2, 0, now=2.0) == [("ann", 2), ("bob", 0)]
        assert ask(offers, 2, 0, 1, now=3.0) == []

    def test_who_accepts_has_the_lease_and_is_offered_nothing_else(self) -> None:
        offers = desk()
        j = offers.join("ann", 0.0)
        ask(offers, 1)
        lease = offers.accept("ann", 1, 0.5)
        assert (lease.robot, lease.operator, lease.reason) == (1, "ann", "uncertain")
        assert offers.robot_of()[j] == 1
        assert ask(offers, 0, now=1.0) == []
        offers.give_back("ann", 1, 2.0)
        assert ask(offers, 0, now=3.0) == [("ann", 0)]

    def test_a_declined_robot_goes_to_the_next_person_and_comes_back_after_half_a_minute(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        ask(offers, 1)
        offers.decline("ann", 1, 1.0)
        assert ask(offers, 1, now=2.0) == []
        offers.join("bob", 3.0)
        assert ask(offers, 1, now=4.0) == [("bob", 1)]
        offers.decline("bob", 1, 5.0)
        assert ask(offers, 1, now=30.9) == []
        assert ask(offers, 1, now=31.1) == [("ann", 1)]

    def test_an_offer_that_nobody_answers_goes_on(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.5)
        ask(offers, 0)
        assert ask(offers, 0, now=14.9) == []
        assert ask(offers, 0, now=15.0) == [("bob", 0)]
        with pytest.raises(Denied, match="not offered") as denied:
            offers.accept("ann", 0, 15.1)
        assert denied.value.code == "not_offered"

    def test_who_takes_a_break_gets_no_offers(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        ask(offers, 0)
        offers.available("ann", False, 1.0)
        assert offers.robot_of() == [NOBODY, NOBODY]
        assert ask(offers, 0, now=2.0) == []
        offers.available("ann", True, 3.0)
        assert ask(offers, 0, now=4.0) == [("ann", 0)]

    def test_an_offered_robot_waits_although_it_does_not_ask_any_more(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        ask(offers, 0)
        assert ask(offers, now=1.0) == []
        waiting = {"robot": 0, "reason": "uncertain", "since": 0.0, "offered_to": "ann", "expires_in": 14.0}
        assert offers.queue(1.0) == [waiting]
        assert offers.accept("ann", 0, 2.0).reason == "uncertain"


class TestTwoGrabOneRobot:
    def test_the_first_has_it_and_the_other_is_told(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.0)
        offers.take("ann", 1, 1.0)
        with pytest.raises(Denied, match="ann has this robot") as denied:
            offers.take("bob", 1, 1.0)
        assert denied.value.code == "taken"

    def test_a_robot_offered_to_one_may_be_taken_by_another(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 1.0)
        assert ask(offers, 1, now=2.0) == [("ann", 1)]
        offers.take("bob", 1, 3.0)
        with pytest.raises(Denied) as denied:
            offers.accept("ann", 1, 3.1)
        assert denied.value.code == "taken"

    def test_nobody_has_two(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.take("ann", 1, 1.0)
        with pytest.raises(Denied) as denied:
            offers.take("ann", 2, 1.0)
        assert denied.value.code == "too_many"


class TestLeasesEnd:
    def test_a_silent_person_loses_the_robot_after_the_grace_period(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        lease = offers.take("ann", 1, 0.0)
        offers.heard("ann", lease.id, 3.0)
        offers.tick(7.9)
        assert 1 in offers.holds
        offers.tick(8.0)
        assert ended(offers) == [(1, "expired")]
        assert 1 in offers.left_behind, "somebody should look after it"

    def test_a_person_who_is_gone_loses_it_although_messages_of_theirs_still_arrive(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        lease = offers.take("ann", 1, 0.0)
        offers.leave("ann", 1.0)
        offers.heard("ann", lease.id, 5.9)
        offers.tick(6.0)
        assert ended(offers) == [(1, "lost")]

    def test_who_comes_back_in_time_keeps_seat_and_robot(self) -> None:
        offers = desk()
        j = offers.join("ann", 0.0)
        lease = offers.take("ann", 1, 0.0)
        offers.leave("ann", 1.0)
        assert offers.join("ann", 3.0) == j
        offers.heard("ann", lease.id, 3.0, command=True)
        offers.tick(7.0)
        assert 1 in offers.holds

    def test_an_open_tab_without_commands_does_not_keep_a_robot_for_ever(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        lease = offers.take("ann", 1, 0.0)
        for second in range(0, 120, 2):
            offers.heard("ann", lease.id, float(second))
            offers.tick(float(second))
        assert 1 in offers.holds
        offers.heard("ann", lease.id, 120.0)
        offers.tick(120.0)
        assert ended(offers) == [(1, "expired")]

    def test_an_emergency_stop_ends_it_and_nobody_can_take_the_robot(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.take("ann", 1, 0.0)
        offers.stop([1], 1.0)
        assert ended(offers) == [(1, "stopped")]
        with pytest.raises(Denied) as denied:
            offers.take("ann", 1, 2.0)
        assert denied.value.code == "stopped"
        offers.clear([1])
        offers.take("ann", 1, 3.0)

    def test_an_old_lease_is_worth_nothing(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        first = offers.take("ann", 1, 0.0)
        offers.give_back("ann", 1, 1.0)
        offers.take("ann", 1, 2.0)
        with pytest.raises(Denied) as denied:
            offers.heard("ann", first.id, 3.0)
        assert denied.value.code == "stale_lease"

    def test_somebody_elses_lease_is_worth_nothing(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.0)
        lease = offers.take("ann", 1, 0.0)
        with pytest.raises(Denied):
            offers.heard("bob", lease.id, 1.0)


class TestHandOver:
    def test_the_giver_keeps_the_robot_until_the_other_accepts(self) -> None:
        offers = desk()
        a, b = offers.join("ann", 0.0), offers.join("bob", 0.0)
        offers.take("ann", 1, 0.0)
        offers.hand_over("ann", 1, "bob", 1.0)
        assert offers.robot_of()[a] == 1
        offers.accept("bob", 1, 2.0)
        assert offers.robot_of()[b] == 1
        assert ended(offers) == [(1, "handed_over")]

    def test_a_robot_in_its_hard_reset_does_not_change_hands(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.0)
        offers.take("ann", 1, 0.0)
        offers.hand_over("ann", 1, "bob", 1.0)
        offers.reset("ann", 1, 2.0)
        for refused in (lambda: offers.accept("bob", 1, 3.0), lambda: offers.hand_over("ann", 1, "bob", 3.0)):
            with pytest.raises(Denied) as denied:
                refused()
            assert denied.value.code == "taken"

    def test_a_declined_one_stays(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.0)
        offers.take("ann", 1, 0.0)
        offers.hand_over("ann", 1, "bob", 1.0)
        offers.decline("bob", 1, 2.0)
        with pytest.raises(Denied):
            offers.accept("bob", 1, 3.0)
        assert offers.holds[1].lease.operator == "ann"

    @pytest.mark.parametrize(("to", "code"), [("zoe", "unknown_person"), ("ann", "too_many")])
    def test_only_to_somebody_else_who_is_there(self, to: str, code: str) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.take("ann", 1, 0.0)
        with pytest.raises(Denied) as denied:
            offers.hand_over("ann", 1, to, 1.0)
        assert denied.value.code == code


class TestComingBack:
    def test_one_is_told_again_what_one_has_and_is_offered(self) -> None:
        offers = desk()
        offers.join("ann", 0.0)
        offers.join("bob", 0.0)
        assert offers.standing("ann", 0.0) == offers.standing("zoe", 0.0) == []
        lease = offers.take("ann", 1, 1.0)
        ask(offers, 2, now=1.0)
        assert offers.standing("ann", 2.0) == [LeaseGranted("ann", lease)]
        assert offers.standing("bob", 3.0) == [Offer("bob", 2, "uncertain", 13.0)]


class TestSeats:
    def test_when_all_are_taken_nobody_else_gets_one(self) -> None:
        offers = desk(seats=1)
        offers.join("ann", 0.0)
        with pytest.raises(Denied) as denied:
            offers.join("bob", 1.0)
        assert denied.value.code == "no_seat"

    def test_the_seat_of_somebody_who_left_is_free_when_their_lease_is_over(self) -> None:
        offers = desk(seats=1)
        offers.join("ann", 0.0)
        offers.take("ann", 1, 0.0)
        offers.leave("ann", 1.0)
        with pytest.raises(Denied):
            offers.join("bob", 2.0)
        offers.tick(6.0)
        assert offers.join("bob", 7.0) == 0


class TestRecord:
    def test_nothing_is_granted_that_cannot_be_written_down(self) -> None:
        def full(kind: str, who: str, robot: int | None, **fields: object) -> None:
            raise TutelageError("disk full")

        offers = desk(log=full)
        offers.join("ann", 0.0)
        ask(offers, 1)
        with pytest.raises(TutelageError, match="disk full"):
            offers.accept("ann", 1, 1.0)
        assert not offers.holds

    def test_what_is_written_down(self) -> None:
        rows: list[tuple[str, str, int | None]] = []
        offers = desk(log=lambda kind, who, robot, **fields: rows.append((kind, who, robot)))
        offers.join("ann", 0.0)
        ask(offers, 1)
        offers.accept("ann", 1, 1.0)
        offers.reset("ann", 1, 2.0)
        offers.end(1, "reset_done", 3.0)
        assert rows == [("offer", "ann", 1), ("lease", "ann", 1), ("reset", "ann", 1), ("lease_end", "ann", 1)]


def ended(offers: Offers) -> list[tuple[int, str]]:
    return [(e.robot, e.why) for e in offers.take_events() if isinstance(e, LeaseEnded)]


NAMES = st.sampled_from(["ann", "bob", "eve", "kim"])
ROBOTS = st.integers(-1, 5)


class Shift(RuleBasedStateMachine):
    """People, robots and the clock do what they like."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.offers = desk(robots=5, seats=3)
        self.granted: dict[str, int] = {}
        self.ended: set[str] = set()
        self.wanting: list[int] = []

    def try_to(self, what: str, *arguments: object) -> None:
        try:
            getattr(self.offers, what)(*arguments, self.now)
        except Denied as denied:
            assert denied.code
            assert denied.text

    @rule(name=NAMES)
    def join(self, name: str) -> None:
        self.try_to("join", name)

    @rule(name=NAMES)
    def leave(self, name: str) -> None:
        self.try_to("leave", name)

    @rule(name=NAMES, yes=st.booleans())
    def available(self, name: str, yes: bool) -> None:
        self.try_to("available", name, yes)

    @rule(name=NAMES, robot=ROBOTS, what=st.sampled_from(["accept", "decline", "take", "give_back", "reset"]))
    def do(self, name: str, robot: int, what: str) -> None:
        self.try_to(what, name, robot)

    @rule(name=NAMES, robot=ROBOTS, to=NAMES)
    def hand_over(self, name: str, robot: int, to: str) -> None:
        self.try_to("hand_over", name, robot, to)

    @precondition(lambda self: self.offers.offers)
    @rule(data=st.data())
    def accept_an_offer(self, data: st.DataObject) -> None:
        robot = data.draw(st.sampled_from(sorted(self.offers.offers)))
        seat = self.offers.seats[self.offers.offers[robot].human]
        assert seat is not None
        self.offers.accept(seat.operator, robot, self.now)

    @precondition(lambda self: self.offers.passing)
    @rule(data=st.data())
    def accept_a_robot_handed_over(self, data: st.DataObject) -> None:
        robot = data.draw(st.sampled_from(sorted(self.offers.passing)))
        seat = self.offers.seats[self.offers.passing[robot].human]
        assert seat is not None
        self.try_to("accept", seat.operator, robot)

    @precondition(lambda self: self.offers.holds)
    @rule(data=st.data(), command=st.booleans())
    def speak(self, data: st.DataObject, command: bool) -> None:
        hold = self.offers.holds[data.draw(st.sampled_from(sorted(self.offers.holds)))]
        self.offers.heard(hold.lease.operator, hold.lease.id, self.now, command)

    @rule(robot=st.integers(0, 4), what=st.sampled_from(["stop", "clear"]))
    def emergency(self, robot: int, what: str) -> None:
        if what == "stop":
            self.offers.stop([robot], self.now)
        else:
            self.offers.clear([robot])

    @rule(robot=st.integers(0, 4), why=st.sampled_from(["violated", "completed", "offline"]))
    def robot_ends(self, robot: int, why: str) -> None:
        self.offers.end(robot, why, self.now)

    @rule(robots=st.lists(st.integers(0, 4), unique=True), seconds=st.sampled_from([0.1, 1.0, 6.0, 40.0]))
    def time_passes(self, robots: list[int], seconds: float) -> None:
        self.now += seconds
        self.wanting = robots
        known = set(self.offers.offers)
        self.offers.ask(robots, ["uncertain"] * len(robots), self.now)
        self.offers.tick(self.now)
        self.hear()
        self.check_order(known)

    def check_order(self, known: set[int]) -> None:
        """After an allocation nobody who is free is left without a robot that they would be asked about, and no robot was
        offered before one that needs somebody more and that the same person would have been asked about."""
        offers = self.offers
        for j, seat in enumerate(offers.seats):
            if seat is None or not seat.present or not seat.available:
                continue
            mine = next((r for r, o in offers.offers.items() if o.human == j), None)
            busy = any(h.human == j for h in offers.holds.values()) or any(o.human == j for o in offers.passing.values())
            for robot in offers.order:
                if robot == mine or busy:
                    break
                if robot in offers.offers or seat.not_before.get(robot, 0.0) > self.now:
                    continue
                assert mine in known, f"{seat.operator} could have been asked about robot {robot}"

    def hear(self) -> None:
        for event in self.offers.take_events():
            if isinstance(event, LeaseGranted):
                assert event.lease.id not in self.granted
                self.granted[event.lease.id] = event.lease.robot
            elif isinstance(event, LeaseEnded):
                assert event.lease in self.granted
                assert event.lease not in self.ended, "a lease ended twice"
                self.ended.add(event.lease)

    @invariant()
    def one_to_one(self) -> None:
        robots = [r for r in self.offers.robot_of() if r != NOBODY]
        assert len(set(robots)) == len(robots)
        holders = [hold.human for hold in self.offers.holds.values()]
        assert len(set(holders)) == len(holders)
        engaged = holders + [o.human for o in self.offers.offers.values()]
        assert len(set(engaged)) == len(engaged), "somebody has a robot and an offer, or two offers"
        assert not set(self.offers.holds) & set(self.offers.offers)

    @invariant()
    def one_seat_each(self) -> None:
        names = [seat.operator for seat in self.offers.seats if seat]
        assert len(set(names)) == len(names)

    @invariant()
    def the_absent_are_offered_nothing_and_keep_nothing(self) -> None:
        for offer in [*self.offers.offers.values(), *self.offers.passing.values()]:
            seat = self.offers.seats[offer.human]
            assert seat is not None
            assert seat.present
        for hold in self.offers.holds.values():
            seat = self.offers.seats[hold.human]
            assert seat is not None
            assert seat.operator == hold.lease.operator
            if not seat.present:
                assert self.now - seat.left <= TERMS.grace + 40.0, "beyond one look at the clock"

    @invariant()
    def stopped_robots_are_nobodys(self) -> None:
        assert not self.offers.stopped & (set(self.offers.holds) | set(self.offers.offers))

    @invariant()
    def every_lease_is_held_or_ended(self) -> None:
        self.hear()
        held = {hold.lease.id for hold in self.offers.holds.values()}
        assert held == set(self.granted) - self.ended

    def teardown(self) -> None:
        """Whoever falls silent now loses everything."""
        self.offers.tick(self.now + TERMS.idle + TERMS.grace)
        assert not self.offers.holds


Shift.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestShift = Shift.TestCase


def test_nobody_starves() -> None:
    """Robots that need somebody equally are served in the order in which they began to."""
    offers = desk(robots=4, seats=1)
    offers.join("ann", 0.0)
    waiting, served, now = [0, 1, 2, 3], [], 0.0
    while len(served) < 8:
        now += 1.0
        order = sorted(waiting, key=lambda r: offers.asking[r].since if r in offers.asking else now)
        for operator, robot in ask(offers, *order, now=now):
            offers.accept(str(operator), robot, now)
            offers.give_back(str(operator), robot, now + 0.5)
            served.append(robot)
    assert served == [0, 1, 2, 3, 0, 1, 2, 3]
