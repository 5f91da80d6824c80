"""Why robots ask, who comes first, and when the algorithm lets them go on: what people and the loop say to each other."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import make_view, wants
from floor import LeaseEnded, LeaseGranted, Serving, Stepped, config

from tutelage.console.offers import Offers
from tutelage.console.reasons import Reasons
from tutelage.console.states import Denied, Offer
from tutelage.fleet.gates import GATES, GateConfig
from tutelage.fleet.modes import Mode
from tutelage.fleet.priority import PriorityConfig, parse

THRESHOLDS = PriorityConfig(uncertainty=0.5, risk=0.5, initial=0)
GATE = GateConfig(novelty=0.5, risk_ask=0.5, risk_cede=0.1, mean_discrepancy=0.1, beta_h=0.1, doubt=0.5)
CALM = (0.0, 0.0, 0.0, 0.0)


def reasons(priority: str, violation: Any = (False,) * 4, fifo: bool = False, **signals: Any) -> dict[int, str]:
    """The robots that ask, in their order, and why."""
    given = {"uncertainty": CALM, "risk": CALM, "goal": (1.0,) * 4, "predicted_discrepancy": CALM, **signals}
    watch = Reasons(parse(priority, THRESHOLDS, GATE), Offers(4, 2), fifo)
    watch(make_view(5, violation=violation, **given))
    return dict(zip(watch.order, watch.reason, strict=True))


class TestReasons:
    def test_each_has_its_own(self) -> None:
        found = reasons("C.U.R.", (False, True, False, False), uncertainty=(0.9, 0.9, 0.0, 0.6), risk=(0.9, 0.9, 0.9, 0.0))
        assert found == {1: "violated", 0: "uncertain", 3: "uncertain", 2: "risky"}
        assert list(found) == [1, 0, 3, 2]

    @pytest.mark.parametrize(
        ("priority", "signals", "why"),
        [
            ("U.C.", {"uncertainty": (0.9, 0.0, 0.0, 0.0)}, "uncertain"),
            ("G.C.", {"goal": (0.1, 1.0, 1.0, 1.0)}, "risky"),
            ("ThriftyDAgger", {"uncertainty": (0.9, 0.0, 0.0, 0.0)}, "novel"),
            ("ThriftyDAgger", {"goal": (0.1, 1.0, 1.0, 1.0)}, "risky"),
            ("EnsembleDAgger", {"uncertainty": (0.9, 0.0, 0.0, 0.0)}, "uncertain"),
            ("SafeDAgger", {"predicted_discrepancy": (0.9, 0.0, 0.0, 0.0)}, "risky"),
        ],
    )
    def test_of_every_algorithm(self, priority: str, signals: Any, why: str) -> None:
        assert reasons(priority, **signals) == {0: why}

    def test_a_priority_that_does_not_say(self) -> None:
        watch = Reasons(wants([0.0, 2.0, 1.0, 0.0]), Offers(4, 2))
        watch(make_view())
        assert list(zip(watch.order, watch.reason, strict=True)) == [(1, "asked"), (2, "asked")]

    def test_who_was_left_behind_comes_last(self) -> None:
        offers = Offers(4, 2)
        offers.left_behind[3] = 0.0
        watch = Reasons(parse("U.C.", THRESHOLDS), offers)
        watch(make_view(uncertainty=(0.0, 0.6, 0.0, 0.0)))
        assert list(zip(watch.order, watch.reason, strict=True)) == [(1, "uncertain"), (3, "asked")]

    def test_first_come_first_served(self) -> None:
        offers = Offers(4, 2)
        watch = Reasons(parse("U.C.", THRESHOLDS), offers, fifo=True)
        watch(make_view(uncertainty=(0.6, 0.0, 0.0, 0.0)))
        offers.ask(watch.order, watch.reason, 1.0)
        watch(make_view(uncertainty=(0.6, 0.0, 0.9, 0.0)))
        assert watch.order == [0, 2]

    def test_of_equally_needy_ones_who_asked_first(self) -> None:
        offers = Offers(4, 2)
        offers.ask([2], ["violated"], 1.0)
        watch = Reasons(parse("C.", THRESHOLDS), offers)
        watch(make_view(violation=(True, False, True, True)))
        assert watch.order[0] == 2


@pytest.mark.parametrize("priority", ["C.", "U.C.", "C.U.R.", "Random.", "U.G.C.", *GATES])
def test_every_algorithm_can_be_served(priority: str, tmp_path: Path) -> None:
    with Serving(
        config(tmp_path, priority=priority, fleet="sim:small:goal_fleet", run={"expert": "small:Reaching"})
    ) as server:
        server.of.join("ann")
        server.steps(10)
        lease = server.take("ann", 1) if not server.now.leases else None
        if lease is not None:
            server.of.give_back("ann", 1)
        assert server.of.healthy["ok"], server.of.healthy


class TestGated:
    def test_the_algorithm_takes_the_robot_back(self, tmp_path: Path) -> None:
        """Nobody asks, so whoever takes a robot does not keep it."""
        with Serving(config(tmp_path, gated=True)) as server:
            server.of.join("ann")
            server.of.take("ann", 1)
            assert server.wait_told(LeaseEnded, operator="ann").why == "ceded"
            server.wait(lambda: server.now.mode[1] == Mode.AUTONOMOUS)

    def test_while_the_robot_asks_the_person_has_it(self, tmp_path: Path) -> None:
        settings = config(tmp_path, gated=True, priority="U.C.", run={"thresholds": PriorityConfig(uncertainty=0.1)})
        with Serving(settings) as server:
            engine = server.of.engine
            engine.loop.signals["uncertainty"] = lambda view: np.full(4, 0.5)
            server.of.join("ann")
            robot = server.wait_told(Offer, operator="ann").robot
            lease = server.of.accept("ann", robot)
            server.wait(lambda: server.now.mode[robot] == Mode.TELEOPERATED)
            for _ in range(10):
                server.of.renew("ann", lease.id)
                server.steps(2)
            assert not server.told(LeaseEnded)
            engine.loop.signals["uncertainty"] = lambda view: np.full(4, -1.0)
            assert server.wait_told(LeaseEnded, lease=lease.id).why == "ceded"


class TestAssist:
    def test_it_can_be_forbidden(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, assist=False)) as server:
            assert not server.of.description.controls.assist
            lease = server.take("ann", 1)
            with pytest.raises(Denied) as denied:
                server.of.command("ann", 1, lease.id, 0, None, assist=True)
            assert denied.value.code == "bad_command"


class TestWaiting:
    def test_people_see_what_changes_while_the_simulation_waits_for_them(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, lockstep=True, hz=100.0)) as server:
            server.of.join("ann")
            server.of.take("ann", 1)
            lease = server.wait_told(LeaseGranted).lease
            server.wait(lambda: server.now.leases.get(1, {}).get("id") == lease.id, 1.0, "the lease is not to be seen")
            t = server.now.t
            for _ in range(12):
                server.of.renew("ann", lease.id)
                time.sleep(0.1)
            assert server.now.t <= t + 1
            shown = [e.snapshot.time for e in server.told(Stepped) if e.snapshot.t == server.now.t]
            assert len(shown) >= 2, "a sign of life now and then"
