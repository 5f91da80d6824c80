"""The loop: the order of its phases, and what a human's time is spent on."""

from __future__ import annotations

import copy
import json
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from fakes import (
    EPISODE,
    POSITION,
    ROBOT,
    SPEED,
    FakeLearner,
    FakePolicy,
    FakePriority,
    FakeSupervisor,
    PointFleet,
    make_loop,
    violated_first,
    wants,
)
from numpy.random import default_rng

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.modes import END_OF_STEP, Event, Mode
from tutelage.fleet.policy import PromptLearner
from tutelage.fleet.priority import PriorityConfig, parse
from tutelage.fleet.step import Step
from tutelage.fleet.supervisor import NoisySupervisor, PolicySupervisor, Team
from tutelage.learning.critic import Critic, CriticConfig
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner, LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.store import load_tree, save_tree

A, S, T, V, R = Mode.AUTONOMOUS, Mode.SWITCHING, Mode.TELEOPERATED, Mode.VIOLATED, Mode.RESETTING


def run(loop, steps: int) -> list[Step]:
    return [loop.step() for _ in range(steps)]


def modes(steps: list[Step], robot: int = 0) -> list[Mode]:
    """The mode of a robot in each step."""
    return [Mode(step.mode[robot]) for step in steps]


def happened(steps: list[Step], robot: int = 0) -> list[tuple[int, str]]:
    """(timestep, event) of a robot."""
    events = Events.concatenate([step.events for step in steps])
    return [(int(t), Event(e).name) for t, r, _, e, _ in zip(*events, strict=True) if r == robot]


# -- order ----------------------------------------------------------------------------------------------------------


class SpyAllocator(FleetDAgger):
    """Algorithm 4, noted in the log."""

    def __init__(self, log: list[Any], **times: int) -> None:
        super().__init__(**times)
        self.log = log

    def __call__(self, *args: Any) -> Any:
        self.log.append("allocate")
        return super().__call__(*args)


def spied(log: list[Any], **rest: Any):
    """A loop in which every part notes its calls, and every robot times out after each step."""
    return make_loop(
        PointFleet(3, horizon=1, log=log), FakePriority(lambda view: view.uncertainty, log), 1,
        supervisor=FakeSupervisor(log=log), policy=FakePolicy(uncertainty=1.0, log=log),
        allocator=SpyAllocator(log), learner=FakeLearner(log), **rest,
    )  # fmt: skip


def test_the_phases_of_a_step_are_in_order() -> None:
    log: list[Any] = []
    loop = spied(log)
    log.clear()
    loop.step()
    assert log == [
        "policy.act", "priority", "policy.uncertainty", "allocate", "supervisor.act",
        "step_async", "step_wait", "reset", "record", "update",
    ]  # fmt: skip


def test_with_overlap_learning_happens_while_physics_runs() -> None:
    log: list[Any] = []
    loop = spied(log, overlap=True)
    log.clear()
    loop.step()
    assert log[-5:] == ["step_async", "update", "step_wait", "reset", "record"]


@pytest.mark.parametrize(
    ("overlap", "order"),
    [(False, ["policy.act", "hear", "begin", "step_async", "step_wait", "record", "update"]),
     (True, ["policy.act", "begin", "step_async", "update", "step_wait", "record"])],
)  # fmt: skip
def test_a_prompt_learner_begins_when_it_has_what_it_learns_from_and_acting_has_had_all_cores(overlap, order) -> None:
    class Prompt(FakeLearner):
        def hear(self, t, obs, wanted) -> None:
            self.log.append("hear")
            heard.append((t, obs.copy(), wanted.copy()))

        def begin(self, t) -> None:
            self.log.append("begin")
            begun.append(t)

    log: list[Any] = []
    heard: list[Any] = []
    begun: list[int] = []
    fleet, policy = PointFleet(3, log=log), FakePolicy(log=log)
    loop = make_loop(fleet, wants([0.0, 1.0, 0.0]), policy=policy, learner=Prompt(log), overlap=overlap)
    assert isinstance(loop.learner, PromptLearner)
    loop.step()
    log.clear()
    step = loop.step()
    assert [what for what in log if what in order] == order
    assert begun == [0, 1]
    assert step.taught.tolist() == [False, True, False]
    assert step.losses == {"policy": 1.0}
    if overlap:
        assert not heard
        return
    t, obs, wanted = heard[-1]
    assert t == step.t == 1
    np.testing.assert_array_equal(obs, step.obs[step.taught])
    np.testing.assert_array_equal(wanted, step.wanted[step.taught])


def test_with_overlap_nothing_is_heard_early() -> None:
    class Prompt(FakeLearner):
        def hear(self, t, obs, wanted) -> dict[str, float]:
            raise AssertionError

    make_loop(PointFleet(2), wants([1.0, 0.0]), learner=Prompt(), overlap=True).step()


@pytest.mark.parametrize(("overlap", "known"), [(False, [1, 2, 3, 4]), (True, [0, 1, 2, 3])])
def test_the_update_at_t_sees_the_data_up_to_t_or_with_overlap_up_to_t_minus_1(overlap, known) -> None:
    learner = FakeLearner()
    run(make_loop(PointFleet(2), wants([1.0, 0.0]), learner=learner, overlap=overlap), 4)
    assert learner.known == known


@pytest.mark.parametrize("overlap", [False, True])
def test_the_losses_of_an_update_belong_to_its_step(overlap) -> None:
    loop = make_loop(PointFleet(2), wants([1.0, 0.0]), learner=FakeLearner(), overlap=overlap)
    assert [step.losses for step in run(loop, 3)] == [{"policy": 0.0}, {"policy": 1.0}, {"policy": 2.0}]


def test_a_signal_is_computed_only_if_asked_for_and_then_once() -> None:
    log: list[Any] = []
    policy = FakePolicy(uncertainty=0.7, log=log)
    steps = run(make_loop(PointFleet(2), parse("C."), policy=policy), 3)
    assert "policy.uncertainty" not in log
    assert all(step.signals == {} for step in steps)
    twice = FakePriority(lambda view: view.uncertainty + view.uncertainty)
    (step,) = run(make_loop(PointFleet(2), twice, policy=policy), 1)
    assert log.count("policy.uncertainty") == 1
    assert step.signals["uncertainty"].tolist() == [0.7, 0.7]


def test_what_happens_before_the_step_is_noted_before_what_happens_at_its_end() -> None:
    loop = make_loop(PointFleet(4, noise=0.1, bound=0.3, horizon=7), FakePriority(violated_first), 2)
    for step in run(loop, 100):
        at_end = np.isin(step.events.event, END_OF_STEP)
        assert (np.diff(at_end.astype(int)) >= 0).all()
        assert (step.events.t == step.t).all()


# -- teleoperation --------------------------------------------------------------------------------------------------


def test_a_teleoperated_robot_executes_the_humans_action_and_the_others_their_own() -> None:
    fleet = PointFleet(3)
    (step,) = run(make_loop(fleet, wants([0.0, 1.0, 0.0]), policy=FakePolicy(-0.25), supervisor=FakeSupervisor(0.5)), 1)
    assert step.actions[:, 0].tolist() == [-0.25, 0.5, -0.25]
    assert step.proposed[:, 0].tolist() == [-0.25, -0.25, -0.25]
    np.testing.assert_allclose(step.next_obs[:, POSITION], SPEED * step.actions[:, 0])
    assert step.human.tolist() == [-1, 0, -1]


def test_what_the_human_saw_and_did_is_what_the_step_says() -> None:
    human = FakeSupervisor(0.5)
    loop = make_loop(PointFleet(4, noise=0.1, start=0.5), FakePriority(lambda v: v.rng.random(4)), 2, supervisor=human)
    steps = run(loop, 50)
    assert len(human.seen) == 50
    for step, (obs, robots) in zip(steps, human.seen, strict=True):
        teleoperated = np.flatnonzero(step.mode == T)
        assert sorted(robots.tolist()) == teleoperated.tolist()
        np.testing.assert_array_equal(obs, step.obs[robots])
        np.testing.assert_array_equal(obs[:, ROBOT], robots)
        np.testing.assert_array_equal(step.actions[robots], 0.5)


def test_human_actions_are_clipped_to_the_bounds_of_the_robot() -> None:
    (step,) = run(make_loop(PointFleet(1), wants([1.0]), supervisor=FakeSupervisor(7.0)), 1)
    assert step.actions.tolist() == [[1.0]]


def test_a_teleoperation_lasts_its_minimum_time_although_the_need_is_gone() -> None:
    loop = make_loop(PointFleet(1), FakePriority(lambda view: [float(view.t == 1)]), allocator=FleetDAgger(t_teleop=4))
    assert modes(run(loop, 8)) == [A, T, T, T, T, A, A, A]


def test_a_human_stays_longer_where_the_need_lasts_without_a_new_assignment() -> None:
    loop = make_loop(PointFleet(2), wants([1.0, 0.5]), allocator=FleetDAgger(t_teleop=2))
    steps = run(loop, 7)
    assert modes(steps) == [T] * 7
    assert happened(steps) == [(0, "ASSIGN"), (0, "TAKE_OVER")]


def test_a_human_moves_on_when_another_robot_needs_more() -> None:
    need = FakePriority(lambda view: [1.0, 2.0 * (view.t >= 1)])
    steps = run(make_loop(PointFleet(2), need, allocator=FleetDAgger(t_teleop=3)), 6)
    assert modes(steps, 0) == [T, T, T, A, A, A]
    assert modes(steps, 1) == [A, A, A, T, T, T]
    assert happened(steps, 0)[-1] == (3, "RELEASE")


def test_a_robot_that_falls_while_teleoperated_frees_its_human_who_may_go_elsewhere() -> None:
    fleet = PointFleet(2, falls={1: [0]})
    need = FakePriority(lambda view: np.where(view.violation, 0.0, [2.0, 1.0]))
    steps = run(make_loop(fleet, need, allocator=FleetDAgger(t_teleop=5)), 4)
    assert modes(steps, 0) == [T, T, V, V]
    assert modes(steps, 1) == [A, A, T, T]
    assert happened(steps, 0) == [(0, "ASSIGN"), (0, "TAKE_OVER"), (1, "VIOLATE")]


def test_a_teleoperation_goes_on_across_a_soft_reset() -> None:
    steps = run(make_loop(PointFleet(1, horizon=2), wants([1.0]), allocator=FleetDAgger(t_teleop=5)), 5)
    assert modes(steps) == [T] * 5
    assert [name for _, name in happened(steps)] == ["ASSIGN", "TAKE_OVER", "TIMEOUT", "TIMEOUT"]


def test_the_priority_sees_who_is_helped_for_how_long_and_the_last_human_action() -> None:
    seen = []

    def look(view):
        seen.append((view.supervised.tolist(), view.duration.tolist(), view.human_action[:, 0].tolist()))
        return [1.0, 0.0]

    run(make_loop(PointFleet(2), FakePriority(look), supervisor=FakeSupervisor(0.5)), 2)
    (first, _, nothing), (then, duration, action) = seen
    assert first == [False, False]
    assert np.isnan(nothing).all()
    assert then == [True, False]
    assert duration == [1, 1]
    assert action[0] == 0.5
    assert np.isnan(action[1])


# -- hard resets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("t_reset", [1, 2, 5])
def test_a_hard_reset_costs_exactly_t_r_human_steps(t_reset) -> None:
    fleet = PointFleet(1, falls={2: [0]})
    steps = run(make_loop(fleet, parse("C."), allocator=FleetDAgger(t_reset=t_reset)), 12)
    assert modes(steps) == [A] * 3 + [R] * t_reset + [A] * (9 - t_reset)
    assert sum(int((step.human >= 0).sum()) for step in steps) == t_reset
    assert happened(steps) == [
        (2, "VIOLATE"), (3, "ASSIGN"), (3, "START_RESET"), (2 + t_reset, "HARD_RESET"),
    ]  # fmt: skip


def test_a_robot_that_waits_for_or_undergoes_a_reset_stands_still_whatever_its_policy_wants() -> None:
    fleet = PointFleet(3, falls={0: [0, 1]})
    steps = run(make_loop(fleet, parse("C."), 1, policy=FakePolicy(1.0), allocator=FleetDAgger(t_reset=4)), 9)
    for step, moved in zip(steps, fleet.moved, strict=True):
        still = np.isin(step.mode, [V, R])
        np.testing.assert_array_equal(moved, ~still)
        np.testing.assert_array_equal(step.next_obs[still], step.obs[still])
        assert (step.reward[still] == 0).all()
    assert [(step.mode == V).sum() for step in steps] == [0, 1, 1, 1, 1, 0, 0, 0, 0]


def test_humans_never_act_on_a_robot_in_violation() -> None:
    human = FakeSupervisor()
    loop = make_loop(PointFleet(4, noise=0.3, bound=0.5), FakePriority(violated_first), 3, supervisor=human)
    steps = run(loop, 120)
    assert any((step.mode == R).any() for step in steps)
    assert all((np.abs(obs[:, POSITION]) <= 0.5).all() for obs, _ in human.seen)


def test_the_first_observation_after_a_hard_reset_is_of_the_new_episode() -> None:
    fleet = PointFleet(1, falls={0: [0]})
    steps = run(make_loop(fleet, parse("C."), policy=FakePolicy(1.0), allocator=FleetDAgger(t_reset=2)), 4)
    assert modes(steps) == [A, R, R, A]
    assert [step.obs[0, EPISODE] for step in steps] == [0, 0, 0, 1]
    assert steps[2].next_obs[0, EPISODE] == 0
    assert steps[3].obs[0, POSITION] == 0
    assert [step.violation[0] for step in steps] == [True, True, True, False]


def test_a_human_who_finished_a_reset_may_teleoperate_the_same_robot_at_once() -> None:
    fleet = PointFleet(1, falls={0: [0]})
    steps = run(make_loop(fleet, FakePriority(lambda v: [float(v.t > 0)]), allocator=FleetDAgger(t_reset=2)), 5)
    assert modes(steps) == [A, R, R, T, T]
    assert happened(steps)[3:] == [(2, "HARD_RESET"), (3, "ASSIGN"), (3, "TAKE_OVER")]


def test_violators_beyond_the_number_of_humans_wait_and_are_all_reset_in_turn() -> None:
    fleet = PointFleet(6, falls={0: range(6)})
    steps = run(make_loop(fleet, parse("C."), 2, allocator=FleetDAgger(t_reset=3)), 10)
    assert [(step.mode == R).sum() for step in steps] == [0] + [2] * 9
    assert (steps[-1].next_obs[:, EPISODE] + (steps[-1].mode == R) == 1).all()


def test_violators_wait_their_turn_in_no_order_of_index() -> None:
    first = []
    for seed in range(200):
        loop = make_loop(PointFleet(4, falls={0: range(4)}), parse("C."), seed=seed)
        first.append(int(np.flatnonzero(run(loop, 2)[1].mode == R)[0]))
    assert np.bincount(first, minlength=4).min() > 30


def test_constraint_violations_have_no_priority_in_the_initial_period() -> None:
    fleet = PointFleet(1, falls={1: [0]})
    loop = make_loop(fleet, parse("C.U.R.", PriorityConfig(initial=6)), signals={"risk": lambda view: np.zeros(1)})
    assert modes(run(loop, 8)) == [A, A, V, V, V, V, R, R]


# -- soft resets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fleet", "event"),
    [({"horizon": 3}, "TIMEOUT"), ({"successes": {2: [0]}}, "SUCCESS"), ({"horizon": 3, "successes": {2: [0]}}, "SUCCESS")],
    ids=["timeout", "success", "success at the horizon"],
)
def test_a_soft_reset_is_free(fleet, event) -> None:
    steps = run(make_loop(PointFleet(1, **fleet), parse("C."), policy=FakePolicy(1.0)), 5)
    assert modes(steps) == [A] * 5
    assert happened(steps)[0] == (2, event)
    assert [step.obs[0, EPISODE] for step in steps[:4]] == [0, 0, 0, 1]
    assert steps[2].next_obs[0, EPISODE] == 0  # what the step led to, before the reset
    assert all((step.human == -1).all() for step in steps)


def test_a_reset_of_some_robots_leaves_the_others_in_their_episode() -> None:
    steps = run(make_loop(PointFleet(3, successes={1: [2]}), parse("C.")), 3)
    assert steps[-1].obs[:, EPISODE].tolist() == [0, 0, 1]


class ForgetfulFleet(PointFleet):
    """Says again and again that a paused robot has timed out and succeeded."""

    def step_wait(self):
        obs, reward, terminated, truncated, info = super().step_wait()
        paused = ~self.moved[-1]
        return obs, reward, terminated, truncated | paused, {**info, "success": info["success"] | paused}


def test_a_paused_robot_keeps_its_episode_whatever_the_fleet_says_about_its_end() -> None:
    need = FakePriority(lambda view: [float(view.t == 2)])
    steps = run(make_loop(ForgetfulFleet(1), need, latency=3, policy=FakePolicy(1.0)), 6)
    assert [step.obs[0, EPISODE] for step in steps] == [0] * 6
    assert happened(steps) == [(2, "ASSIGN"), (5, "TAKE_OVER")]


def test_a_robot_that_falls_at_the_moment_of_success_has_not_succeeded() -> None:
    steps = run(make_loop(PointFleet(1, falls={1: [0]}, successes={1: [0]}), wants([0.0])), 3)
    assert happened(steps) == [(1, "VIOLATE")]
    assert not steps[1].success.any()
    assert modes(steps) == [A, A, V]


# -- the human data -------------------------------------------------------------------------------------------------


def test_the_human_data_hold_what_the_human_saw_never_the_end_of_an_old_episode() -> None:
    """The first pair after a reset must show the new episode, and a terminal observation must show nowhere."""
    dataset = AggregatedDataset((4,), 1, 1, default_rng(0))
    policy = EnsemblePolicy(4, np.array([-1.0]), np.array([1.0]), members=1, hidden=(4,))
    learner = ImitationLearner(policy, dataset, LearnerConfig(schedule="never"))
    human = FakeSupervisor(0.5)
    fleet = PointFleet(5, noise=0.2, bound=0.6, horizon=6, start=0.1)
    allocator = FleetDAgger(t_teleop=2, t_reset=2)
    loop = make_loop(fleet, FakePriority(violated_first), 3, supervisor=human, learner=learner, allocator=allocator)
    steps = run(loop, 200)

    seen = np.concatenate([obs for obs, _ in human.seen])
    np.testing.assert_array_equal(dataset.obs.rows.numpy(), seen.astype(np.float32))
    assert (dataset.actions.rows.numpy() == 0.5).all()
    ends = [step.next_obs[np.isin(step.mode, [A, T]) & (step.violation | step.truncated)] for step in steps]
    rows = {tuple(row) for row in seen.tolist()}
    assert len(np.concatenate(ends)) > 50
    assert not rows & {tuple(row) for row in np.concatenate(ends).tolist()}


def test_every_human_step_is_either_a_pair_of_data_or_a_part_of_a_reset() -> None:
    learner = FakeLearner()
    fleet = PointFleet(5, noise=0.2, bound=0.6)
    steps = run(make_loop(fleet, FakePriority(violated_first), 3, learner=learner), 100)
    assert learner.steps == steps
    for step in steps:
        np.testing.assert_array_equal(step.human >= 0, np.isin(step.mode, [T, R]))


# -- switching latency ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_switching_latency_pauses_the_robot_that_many_steps(latency) -> None:
    fleet = PointFleet(1)
    need = FakePriority(lambda view: [float(view.t == 2)])
    loop = make_loop(fleet, need, latency=latency, policy=FakePolicy(1.0), allocator=FleetDAgger(t_teleop=2))
    steps = run(loop, 9)
    assert modes(steps) == [A, A] + [S] * latency + [T, T] + [A] * (5 - latency)
    assert sum(int(~moved[0]) for moved in fleet.moved) == latency
    assert all((step.reward == 0).all() for step in steps if step.mode[0] == S)


def test_latency_delays_a_hard_reset_likewise_and_counts_as_human_time() -> None:
    loop = make_loop(PointFleet(1, falls={0: [0]}), parse("C."), latency=2, allocator=FleetDAgger(t_reset=3))
    steps = run(loop, 8)
    assert modes(steps) == [A, S, S, R, R, R, A, A]
    assert [step.human[0] for step in steps] == [-1, 0, 0, 0, 0, 0, -1, -1]


def test_each_human_has_a_latency_of_their_own() -> None:
    loop = make_loop(PointFleet(2), wants([2.0, 1.0]), 2, latency=[0, 2])
    steps = run(loop, 4)
    assert modes(steps, 0) == [T, T, T, T]
    assert modes(steps, 1) == [S, S, T, T]


def test_latency_needs_a_fleet_that_can_pause() -> None:
    with pytest.raises(ConfigError, match="latency needs a fleet that can pause"):
        make_loop(PointFleet(2, can_pause=False), wants([1.0, 0.0]), latency=[1])
    make_loop(PointFleet(2, can_pause=False), wants([1.0, 0.0]), latency=[0])


# -- one clear line -------------------------------------------------------------------------------------------------


def test_more_humans_than_robots_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"^3 humans for 2 robots: use at most one human a robot \(M <= N\)$"):
        make_loop(PointFleet(2), wants([1.0, 1.0]), 3)


class BadPolicy(FakePolicy):
    """Answers what it was given."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.answer = answer

    def act(self, obs: Any) -> Any:
        return self.answer


class BadSupervisor(FakeSupervisor):
    def act(self, obs: Any, robots: Any) -> Any:
        return self.action


class BadFleet(PointFleet):
    """Shows `wrong` instead of an observation, from step `since` on."""

    def __init__(self, wrong: Any, since: int, **rest: Any) -> None:
        self.wrong, self.since = wrong, since
        super().__init__(2, **rest)

    def step_wait(self) -> Any:
        obs, *rest = super().step_wait()
        return (self.wrong if self.t > self.since else obs), *rest


def nan_at(robot: int) -> Any:
    obs = np.zeros((2, 4))
    obs[robot, 3] = np.nan
    return obs


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({"policy": BadPolicy(np.zeros((2, 2)))}, "BadPolicy.act must return (2, 1), got (2, 2)"),
        ({"policy": BadPolicy(np.zeros(2))}, "BadPolicy.act must return (2, 1), got (2,)"),
        (
            {"policy": BadPolicy(np.array([[0.0], [np.nan]]))},
            "the action of BadPolicy is not finite for robot 1 at timestep 0",
        ),
        ({"policy": FakePolicy(uncertainty=np.nan)}, "signal 'uncertainty' is not finite for robot 0"),
        (
            {"policy": FakePolicy(uncertainty=lambda obs: np.zeros((2, 1)))},
            "signal 'uncertainty' must have shape (2,), got (2, 1)",
        ),
        ({"supervisor": BadSupervisor(np.zeros((1, 3)))}, "BadSupervisor.act must return (1, 1), got (1, 3)"),
        ({"supervisor": BadSupervisor(np.array([[np.inf]]))}, "BadSupervisor.act returned a number that is not finite"),
        ({"priority": wants([1.0, 1.0, 1.0])}, "a priority must return (2, K), got (3, 1)"),
        ({"priority": wants(np.zeros((2, 0)))}, "a priority must return (2, K), got (2, 0)"),
        ({"priority": wants([0.0, np.nan])}, "the priority of robot 1 is NaN"),
        ({"fleet": BadFleet(nan_at(1), 2)}, "the observation is not finite for robot 1 at timestep 3"),
        ({"fleet": BadFleet(nan_at(0), 2, horizon=3)}, "the last observation is not finite for robot 0 at timestep 2"),
        ({"fleet": BadFleet(np.zeros((5, 4)), 0)}, "the observation is there for 5 robots, and the fleet has 2"),
    ],
)
def test_a_broken_contract_is_one_clear_line(parts, line) -> None:
    parts = {"fleet": PointFleet(2), "priority": FakePriority(lambda v: 1 + v.uncertainty), **copy.deepcopy(parts)}
    loop = make_loop(**parts)
    with pytest.raises(ContractError) as caught:
        run(loop, 5)
    assert str(caught.value) == line


def test_a_priority_that_needs_an_unknown_signal_says_which_ones_there_are() -> None:
    with pytest.raises(ConfigError, match=r"no signal 'risk' \(it has: uncertainty\)"):
        make_loop(PointFleet(2), parse("R.")).step()


def test_a_policy_without_uncertainty_is_fine_until_somebody_asks() -> None:
    class Plain:
        def act(self, obs):
            return np.zeros((len(obs), 1))

    loop = make_loop(PointFleet(2), parse("C."), policy=Plain())
    loop.step()
    loop.priority = parse("U.")
    with pytest.raises(ConfigError, match=r"no signal 'uncertainty' \(it has: none\)"):
        loop.step()


# -- subscribers ----------------------------------------------------------------------------------------------------


class Listener:
    def __init__(self) -> None:
        self.heard: list[Any] = []

    def on_start(self, loop) -> None:
        self.heard.append("start")

    def on_step(self, loop, step) -> None:
        self.heard.append(step.t)

    def on_end(self, loop) -> None:
        self.heard.append("end")


def test_subscribers_hear_the_beginning_every_step_and_the_end() -> None:
    listener = Listener()
    loop = make_loop(PointFleet(1), parse("C."), subscribers=[listener])
    loop.run(3)
    loop.run(5)  # until timestep 5, not for 5 more
    assert listener.heard == ["start", 0, 1, 2, "end", "start", 3, 4, "end"]


def test_subscribers_hear_the_end_of_a_run_that_fails() -> None:
    listener = Listener()
    loop = make_loop(PointFleet(1), FakePriority(lambda v: [np.nan if v.t == 1 else 0.0]), subscribers=[listener])
    with pytest.raises(ContractError):
        loop.run(3)
    assert listener.heard == ["start", 0, "end"]


# -- seeds and resuming ---------------------------------------------------------------------------------------------


def same(one: Step, other: Step) -> None:
    """Two steps are equal bit for bit."""
    for f in fields(Step):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if isinstance(a, dict):
            assert a.keys() == b.keys()
            assert all(np.array_equal(a[k], b[k]) for k in a), f.name
        elif isinstance(a, tuple):
            assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True)), f.name
        else:
            assert np.array_equal(a, b, equal_nan=f.name == "wanted"), f.name


def full_loop(seed: int, text: str, schedule: Any, overlap: bool):
    """Everything that has a state: noisy fleet and human, ensemble, critics, running moments, random ties."""
    low, high = np.array([-1.0], np.float32), np.array([1.0], np.float32)
    policy = EnsemblePolicy(4, low, high, members=3, hidden=(8, 8), seed=seed)
    zero, one = torch_zeros(4), torch_zeros(4) + 1
    critics = {
        name: Critic(
            4, 1, event, policy, CriticConfig(batch=8, hidden=(8,), every=2, capacity=60),
            (zero, one, torch_zeros(1), torch_zeros(1) + 1), default_rng(seed + 1), seed + 2,
        )
        for name, event in (("risk", "bad"), ("goal", "good"))
    }  # fmt: skip
    learner = ImitationLearner(
        policy, AggregatedDataset((4,), 1, 3, default_rng(seed + 3)),
        LearnerConfig(schedule=schedule, every=3, gradient_steps=2, batch=8, learning_rate=1e-2), critics, seed=seed,
    )  # fmt: skip
    human = NoisySupervisor(PolicySupervisor(FakePolicy(-0.3)), 0.2, default_rng(seed + 4))
    config = PriorityConfig(uncertainty=1e-4, risk=0.1, combined=0.5, random=0.6, initial=5)
    return make_loop(
        PointFleet(8, noise=0.15, bound=0.6, goal=0.5, horizon=15, start=0.2), parse(text, config), 3, latency=1,
        supervisor=human, policy=policy, learner=learner, allocator=FleetDAgger(2, 3), overlap=overlap, seed=seed,
        signals={name: (lambda view, critic=critic: critic(view.obs, view.actions)) for name, critic in critics.items()},
    )  # fmt: skip


def torch_zeros(n: int):
    import torch

    return torch.zeros(n)


CASES = [("C.U.R.", "step", False), ("U.G.C.", "scratch", True), ("Random.C.", "episode", False), ("C.R.G.", "step", True)]


@pytest.mark.parametrize(("text", "schedule", "overlap"), CASES)
def test_a_resumed_loop_continues_bit_for_bit(text, schedule, overlap, tmp_path) -> None:
    loop = full_loop(0, text, schedule, overlap)
    run(loop, 40)
    save_tree(tmp_path / "checkpoint", loop.state_dict())
    uninterrupted = run(loop, 40)

    resumed = full_loop(0, text, schedule, overlap)
    run(resumed, 7)  # none of this may be left over
    resumed.load_state_dict(load_tree(tmp_path / "checkpoint"))
    for expected, found in zip(uninterrupted, run(resumed, 40), strict=True):
        same(expected, found)
    assert sum(len(step.events.t) for step in uninterrupted) > 20
    assert any(step.losses for step in uninterrupted)


def test_a_state_in_memory_can_be_returned_to_however_often() -> None:
    loop = full_loop(0, "C.U.R.", "step", False)
    run(loop, 30)
    state = loop.state_dict()
    first = run(loop, 40)
    for _ in range(2):
        loop.load_state_dict(state)
        for expected, found in zip(first, run(loop, 40), strict=True):
            same(expected, found)


def test_the_last_human_actions_are_part_of_the_state() -> None:
    def seen(loop):
        loop.priority = FakePriority(lambda view: actions.append(view.human_action.tolist()) or [0.0, 0.0])
        loop.step()
        return actions.pop()

    actions: list[Any] = []
    loop = make_loop(PointFleet(2), wants([1.0, 1.0]), 2, supervisor=FakeSupervisor(0.5))
    loop.step()
    again = make_loop(PointFleet(2), wants([0.0, 0.0]), 2)
    again.load_state_dict(loop.state_dict())
    assert seen(again) == seen(loop) == [[0.5], [0.5]]


def test_the_state_is_arrays_and_json_values() -> None:
    def check(tree: Any) -> None:
        for value in tree.values():
            if isinstance(value, dict):
                check(value)
            elif not isinstance(value, np.ndarray):
                json.dumps(value)

    loop = full_loop(0, "U.G.C.", "step", False)
    run(loop, 10)
    check(loop.state_dict())


def test_the_same_seed_gives_the_same_run_and_another_seed_another_one() -> None:
    one, same_seed, other = (run(full_loop(seed, "C.U.R.", "step", False), 30) for seed in (4, 4, 5))
    for expected, found in zip(one, same_seed, strict=True):
        same(expected, found)
    assert not np.array_equal(one[-1].obs, other[-1].obs)


# -- the humans -----------------------------------------------------------------------------------------------------


def test_humans_who_act_alike_are_asked_in_one_batch_and_others_get_their_own_robots() -> None:
    alike, other = FakeSupervisor(0.1), FakeSupervisor(0.9)
    team = Team([alike, other, alike])
    obs = np.arange(12.0).reshape(3, 4)
    actions = team.act(obs, np.array([7, 5, 6]), np.array([2, 1, 0]), 1)
    np.testing.assert_allclose(actions[:, 0], [0.1, 0.9, 0.1])
    assert [robots.tolist() for _, robots in alike.seen] == [[7, 6]]
    assert [robots.tolist() for _, robots in other.seen] == [[5]]


def test_a_trembling_hand_resumes_with_the_state_of_the_hand_inside() -> None:
    def hand(seed):
        return NoisySupervisor(NoisySupervisor(FakeSupervisor(), 0.1, default_rng(seed)), 0.2, default_rng(seed + 1))

    one, other = hand(0), hand(50)
    ask = np.zeros((3, 4)), np.arange(3)
    one.act(*ask)
    other.load_state_dict(json.loads(json.dumps(one.state_dict())))
    np.testing.assert_array_equal(one.act(*ask), other.act(*ask))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Team([]), "at least one human"),
        (lambda: Team([FakeSupervisor()], -1), "latency must be >= 0"),
        (lambda: NoisySupervisor(FakeSupervisor(), -0.1, default_rng(0)), "noise must be >= 0"),
        (lambda: NoisySupervisor(FakeSupervisor(), float("nan"), default_rng(0)), "noise must be >= 0"),
    ],
)
def test_impossible_humans_are_refused(build, message) -> None:
    with pytest.raises(ConfigError, match=message):
        build()


def test_two_humans_for_one_robot_are_refused() -> None:
    class Crowd(FleetDAgger):
        def __call__(self, ranks, previous, mode, age, rng):
            return np.zeros(len(previous), dtype=np.int64)

    loop = make_loop(PointFleet(3), FakePriority(lambda view: [1.0, 0.0, 0.0]), 2, allocator=Crowd(1, 1))
    with pytest.raises(ContractError, match="two humans to one robot"):
        loop.step()
