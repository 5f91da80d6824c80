"""The live tally, held against the metrics of the log."""

from __future__ import annotations

import numpy as np
import pytest
from fakes import PointFleet, make_loop
from hypothesis import given, settings
from walks import logs, replay

from tutelage.fleet import metrics
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import Event, Mode
from tutelage.fleet.priority import parse
from tutelage.fleet.step import Step
from tutelage.fleet.tally import Tally


def replayed_steps(log: EventLog) -> list[Step]:
    """The log as the steps of a loop, with a reward of 1 for each success."""
    modes, _ = replay(log)
    nothing = np.empty(0)
    result = []
    for t in range(log.steps):
        events = Events(*(column[log.events.t == t] for column in log.events))
        reward = np.bincount(events.of(Event.SUCCESS).robot, minlength=log.num_robots).astype(np.float64)
        result.append(
            Step(
                t, nothing, nothing, nothing, nothing, modes[t], nothing, reward, nothing, nothing, nothing, nothing, events
            )
        )
    return result


@given(logs())
@settings(max_examples=100, deadline=None)
def test_the_tally_of_any_walk_through_the_modes_is_the_summary_of_its_log(log: EventLog) -> None:
    tally = Tally(log.num_robots, log.num_humans)
    for step in replayed_steps(log):
        tally.update(step)
    assert tally.summary() == {**metrics.summary(log), "reward": metrics.successes(log)}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("latency", [0, 2])
def test_the_tally_of_a_running_loop_is_the_summary_of_its_log(seed: int, latency: int) -> None:
    robots, humans, steps = 7, 3, 80
    fleet = PointFleet(robots, noise=0.3, goal=0.4, bound=0.6, horizon=6)  # chance decides who falls, arrives, runs late
    allocator = FleetDAgger(t_teleop=3, t_reset=2)
    loop = make_loop(fleet, parse("C.Random."), humans, latency=latency, allocator=allocator, seed=seed)
    tally, parts, reward, helped = Tally(robots, humans), [], 0.0, 0
    for t in range(steps):
        if t == steps // 2:  # as in a resumed run
            state, tally = tally.state_dict(), Tally(robots, humans)
            tally.load_state_dict(state)
        step = loop.step()
        tally.update(step)
        parts.append(step.events)
        reward += step.reward.sum()
        helped += np.count_nonzero(step.human >= 0)
        log = EventLog(Events.concatenate(parts), robots, humans, t + 1)
        assert tally.summary() == {**metrics.summary(log), "reward": pytest.approx(reward)}
    assert metrics.human_time(log).total == helped  # alpha as the loop sees it
    assert min(tally.summary()[key] for key in ("successes", "hard_resets", "timeouts", "switches_to_robot")) > 0
    spans = metrics.intervals(log)
    (over,) = np.nonzero((spans.mode == Mode.RESETTING) & (spans.end < steps))
    assert (spans.length[over] == 2).all()  # a hard reset takes t_R timesteps


def test_a_checkpoint_that_is_older_than_an_event_can_be_continued() -> None:
    tally = Tally(2, 1)
    tally.events[:] = np.arange(len(Event))
    state = tally.state_dict()
    state["events"] = state["events"][:-1]
    again = Tally(2, 1)
    again.load_state_dict(state)
    assert again.events.tolist() == [*range(len(Event) - 1), 0]
