"""The loop with people and real robots: who cannot be reached, who says nothing, who takes as long as it takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes import FakeLearner, FakePolicy, FakePriority, FakeSupervisor, PointFleet, make_loop, wants
from hypothesis import given
from hypothesis import strategies as st

from tutelage.errors import ConfigError
from tutelage.fleet.allocation import FirstComeFirstServed
from tutelage.fleet.events import Events
from tutelage.fleet.loop import Loop
from tutelage.fleet.metrics import EventLog, summary
from tutelage.fleet.modes import MOVING, Event, Mode
from tutelage.fleet.step import Step
from tutelage.fleet.supervisor import Team
from tutelage.fleet.tally import Tally
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner, LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy

A, S, T, V, R, O = Mode  # noqa: E741


class Persons(Team):
    """Persons: `says` their actions (NaN: nothing), `came` who has accepted, `resetting` who wants a reset, `done` who is through."""

    pauses = True

    def __init__(self, m: int) -> None:
        super().__init__([FakeSupervisor()] * m)
        self.says: Any = np.full(m, 0.5)
        self.came, self.resetting, self.done = np.ones(m, dtype=bool), np.zeros(m, dtype=bool), np.ones(m, dtype=bool)

    def ready(self, robots: Any, humans: Any, age: Any) -> Any:
        return self.came[humans]

    def resets(self, robots: Any, humans: Any) -> Any:
        return self.resetting[humans]

    def has_reset(self, robots: Any, humans: Any, due: Any) -> Any:
        return due & self.done[humans]

    def act(self, obs: Any, robots: Any, humans: Any, width: int) -> Any:
        return np.broadcast_to(self.says[humans, None], (len(robots), width)).astype(np.float32)


def loop_of(fleet: PointFleet, priority: Any, m: int = 1, learner: Any = None) -> tuple[Loop, Persons]:
    team = Persons(m)
    return Loop(fleet, FakePolicy(), priority, team, learner=learner), team


def modes(steps: list[Step], robot: int = 0) -> list[Mode]:
    return [Mode(step.mode[robot]) for step in steps]


# -- robots out of reach ----------------------------------------------------------------------------------------------


def test_a_robot_out_of_reach_is_left_alone_and_goes_on_by_itself_when_it_is_back() -> None:
    fleet = PointFleet(2, away={2: [0], 3: [0]})
    loop = make_loop(fleet, wants([1, 0]), 1)
    steps = [loop.step() for _ in range(8)]
    assert modes(steps) == [T, T, T, O, O, T, T, T]
    assert [bool(moved[0]) for moved in fleet.moved] == [True, True, True, False, False, True, True, True]
    events = Events.concatenate([step.events for step in steps]).of(Event.DISCONNECT, Event.CONNECT)
    assert [(t, h) for t, h in zip(events.t.tolist(), events.human.tolist(), strict=True)] == [(3, 0), (5, -1)]


def test_the_human_of_a_lost_robot_is_free_for_another() -> None:
    loop = make_loop(PointFleet(2, away={t: [0] for t in range(1, 9)}), wants([2, 1]), 1)
    steps = [loop.step() for _ in range(6)]
    assert modes(steps) == [T, T, O, O, O, O]
    assert modes(steps, 1) == [A, A, T, T, T, T]


def test_a_robot_that_fell_is_still_down_when_it_is_back() -> None:
    loop = make_loop(PointFleet(2, falls={0: [0]}, away={1: [0], 2: [0]}), wants([0, 0]), 1)
    steps = [loop.step() for _ in range(6)]
    assert modes(steps) == [A, V, O, O, V, V]
    assert Event.CONNECT_VIOLATED in Events.concatenate([step.events for step in steps]).event


def test_a_hard_reset_that_is_cut_off_has_not_happened() -> None:
    # t_R is 5 by default
    loop = make_loop(PointFleet(1, falls={0: [0]}, away={2: [0]}), FakePriority(lambda view: 1.0 * view.violation), 1)
    steps = [loop.step() for _ in range(12)]
    assert modes(steps) == [A, R, R, O, R, R, R, R, R, A, A, A]


# -- people who say nothing, and who come when they come ----------------------------------------------------------------


def test_a_robot_whose_person_says_nothing_is_held_and_teaches_nothing() -> None:
    learner = FakeLearner()
    fleet = PointFleet(2)
    loop, team = loop_of(fleet, wants([1, 0]), learner=learner)
    team.says[0] = np.nan
    held = loop.step()
    assert fleet.moved[-1].tolist() == [False, True]
    assert held.moved.tolist() == [False, True]
    assert not held.taught.any()
    assert held.mode[0] == T
    assert np.isnan(held.wanted[0])
    team.says[0] = 0.25
    spoken = loop.step()
    assert spoken.taught.tolist() == [True, False]
    assert spoken.actions[0] == 0.25
    team.says[0] = np.nan
    assert np.isnan(loop.step().wanted[0])
    assert loop.human_action[0] == 0.25, "the last action that was wanted"


def test_silence_is_never_learned_from() -> None:
    fleet = PointFleet(3)
    policy = EnsemblePolicy((4,), fleet.action_low, fleet.action_high, members=2, hidden=(8,), seed=0)
    dataset = AggregatedDataset((4,), 1, 2, np.random.default_rng(0), True)
    learner = ImitationLearner(policy, dataset, LearnerConfig(batch=4))
    team = Persons(2)
    loop = Loop(fleet, policy, wants([1, 1, 0]), team, learner=learner)
    team.says[:] = np.nan, 0.5
    steps = [loop.step() for _ in range(3)]
    assert len(dataset) == sum(int(step.taught.sum()) for step in steps) == 3
    assert np.isfinite(dataset.state_dict()["actions"]).all()


def test_a_robot_waits_until_its_person_has_come() -> None:
    loop, team = loop_of(PointFleet(1), wants([1]))
    team.came[0] = False
    waiting = [loop.step() for _ in range(3)]
    team.came[0] = True
    assert modes([*waiting, loop.step()]) == [S, S, S, T]
    assert not loop.fleet.moved[:3][0].any()


def test_a_person_may_reset_a_robot_that_is_stuck_and_takes_as_long_as_it_takes() -> None:
    fleet = PointFleet(1)
    loop, team = loop_of(fleet, wants([1]))
    steps = [loop.step()]
    team.resetting[0], team.done[0] = True, False
    steps += [loop.step() for _ in range(8)]
    team.resetting[0], team.done[0] = False, True
    steps += [loop.step(), loop.step()]
    assert modes(steps) == [T, *[R] * 9, T]
    assert fleet.obs[0, 2] == 1, "a new episode"


# -- who is next, and what the others do meanwhile ---------------------------------------------------------------------


def test_first_come_first_served_whatever_the_ranks_and_nobody_is_called_away() -> None:
    need = {0: [0, 1, 0], 1: [5, 1, 0], 2: [5, 1, 9], 3: [5, 0, 9], 4: [5, 0, 9], 5: [0, 0, 9]}
    loop = make_loop(PointFleet(3), FakePriority(lambda view: need[view.t]), 1, allocator=FirstComeFirstServed(1))
    assert [int(loop.step().human.argmax()) for _ in range(6)] == [1, 1, 1, 0, 0, 2]


def test_the_queue_survives_a_resume() -> None:
    first, second = (make_loop(PointFleet(3), wants([1, 1, 1]), 1, allocator=FirstComeFirstServed(1)) for _ in range(2))
    for _ in range(4):
        first.step()
    second.load_state_dict(first.state_dict())
    assert second.allocator.needed.tolist() == [4, 4, 4]


def test_robots_that_need_a_human_may_wait_for_one() -> None:
    fleet = PointFleet(3)
    loop = make_loop(fleet, wants([2, 1, 0]), 1, wait=True)
    step = loop.step()
    assert step.held.tolist() == [False, True, False]
    assert step.mode.tolist() == [T, A, A]
    assert fleet.moved[-1].tolist() == step.moved.tolist() == [True, False, True]


def test_people_need_a_fleet_that_can_pause() -> None:
    with pytest.raises(ConfigError, match="needs a fleet that can pause"):
        loop_of(PointFleet(1, can_pause=False), wants([1]))


@given(data=st.data())
def test_whatever_happens_the_log_is_possible_and_the_tally_is_that_of_the_log(data: Any) -> None:
    n, m = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 2))
    fleet = PointFleet(n, horizon=5, away={-1: []})
    ranks = np.zeros((n, 1))
    loop, team = loop_of(fleet, FakePriority(lambda view: ranks), min(m, n))
    tally, parts = Tally(n, len(team)), []
    few = st.lists(st.integers(0, n - 1), max_size=n)
    flags = st.lists(st.booleans(), min_size=len(team), max_size=len(team)).map(np.array)
    for t in range(data.draw(st.integers(1, 12))):
        ranks[:, 0] = data.draw(st.lists(st.integers(0, 2), min_size=n, max_size=n))
        fleet.falls[t], fleet.successes[t], fleet.away[t] = data.draw(few), data.draw(few), data.draw(few)
        team.came, team.resetting, team.done = data.draw(flags), data.draw(flags), data.draw(flags)
        team.says = np.where(data.draw(flags), 0.5, np.nan)
        step = loop.step()
        tally.update(step)
        parts.append(step.events)
        assert not (step.moved & ~MOVING[step.mode]).any()
        assert fleet.moved[-1].tolist() == step.moved.tolist()
        assert not np.isin(step.human[step.mode == O], range(len(team))).any()
    log = EventLog(Events.concatenate(parts), n, len(team), loop.t)
    found = tally.summary()
    assert {name: found[name] for name in summary(log)} == summary(log)
