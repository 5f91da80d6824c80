"""The learner: what becomes data, and when the policy changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fakes import FakePriority, FakeSupervisor, PointFleet, make_loop, violated_first
from numpy.random import default_rng

from tutelage.errors import ConfigError
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.modes import MOVING, Mode
from tutelage.fleet.policy import Learner, PromptLearner
from tutelage.fleet.step import Step
from tutelage.learning.critic import Critic, CriticConfig
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner, LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.weights import module_state

WIDTH = 4


def make(critics=(), seed: int = 0, **config) -> ImitationLearner:
    policy = EnsemblePolicy(WIDTH, np.array([-1.0]), np.array([1.0]), members=3, hidden=(8,), seed=seed)
    scale = torch.zeros(WIDTH), torch.ones(WIDTH), torch.zeros(1), torch.ones(1)
    critic_config = CriticConfig(batch=8, hidden=(4,), every=2)
    kind = {"risk": "bad", "goal": "good"}
    build = {name: Critic(WIDTH, 1, kind[name], policy, critic_config, scale, default_rng(seed), seed) for name in critics}
    dataset = AggregatedDataset((WIDTH,), 1, 3, default_rng(seed))
    return ImitationLearner(policy, dataset, LearnerConfig(**{"batch": 8, **config}), build, seed=seed)


def step(modes, *, t: int = 0, **masks) -> Step:
    """A step in which robot i sees i, does i / 10 and comes to i + 100."""
    n = len(modes)
    index = np.arange(n, dtype=float)[:, None]
    mask = {name: np.array(masks.get(name, [False] * n)) for name in ("violation", "success", "truncated")}
    return Step(
        t, np.repeat(index, WIDTH, 1), index * 0, index / 9, index / 10, np.array(modes), np.full(n, -1), np.zeros(n),
        np.repeat(index + 100, WIDTH, 1), mask["violation"], mask["success"], mask["truncated"], Events.concatenate([]),
    )  # fmt: skip


def kept(ring) -> dict[str, list]:
    """{obs: end} of the transitions of a critic."""
    now = ring.columns(ring.rows[: ring.size])
    return dict(zip(now["obs"][:, 0].tolist(), now["end"].tolist(), strict=True))


def test_only_teleoperated_robots_become_human_data() -> None:
    learner = make()
    learner.record(step(list(Mode)))
    assert isinstance(learner, Learner)
    assert learner.dataset.obs.rows[:, 0].tolist() == [Mode.TELEOPERATED]
    assert learner.dataset.actions.rows[:, 0].tolist() == pytest.approx([Mode.TELEOPERATED / 10])


def test_critics_see_the_transitions_of_moving_robots_and_no_others() -> None:
    learner = make(["risk"])
    learner.record(step(list(Mode)))
    ring = learner.critics["risk"].plain
    assert kept(ring) == {float(mode): 0.0 for mode in Mode if MOVING[mode]}
    assert ring.columns(ring.rows[: ring.size])["next_obs"][:, 0].tolist() == [
        Mode.AUTONOMOUS + 100,
        Mode.TELEOPERATED + 100,
    ]
    assert learner.critics["risk"].events.size == 0


def test_what_is_an_event_and_what_is_an_end_for_each_critic() -> None:
    learner = make(["risk", "goal"])
    learner.record(step(
        [Mode.AUTONOMOUS] * 5,  # 0 nothing, 1 fell, 2 succeeded on the way, 3 timed out, 4 succeeded by reaching the horizon
        violation=[False, True, False, False, False],
        success=[False, False, True, False, True],
        truncated=[False, False, False, True, True],
    ))  # fmt: skip
    risk, goal = learner.critics["risk"], learner.critics["goal"]
    assert kept(risk.events) == {1.0: 1.0}
    assert kept(risk.plain) == {0.0: 0.0, 2.0: 1.0, 3.0: 0.0, 4.0: 0.0}
    assert set(kept(goal.events)) == {2.0, 4.0}
    assert kept(goal.plain) == {0.0: 0.0, 1.0: 1.0, 3.0: 0.0}


def test_a_critic_sees_the_last_observation_of_an_episode_not_the_first_of_the_next() -> None:
    learner = make(["risk"])
    fleet = PointFleet(4, noise=0.2, bound=0.5, horizon=5)
    loop = make_loop(fleet, FakePriority(violated_first), 2, learner=learner, allocator=FleetDAgger(2, 2))
    for _ in range(80):
        loop.step()
    for ring in (learner.critics["risk"].plain, learner.critics["risk"].events):
        now = ring.columns(ring.rows[: ring.size])
        obs, after = now["obs"], now["next_obs"]
        assert ring.size > 10
        assert (obs[:, 2] == after[:, 2]).all()  # the same episode
        assert (obs[:, 1] + 1 == after[:, 1]).all()  # one timestep later
        assert (now["end"] == float(ring is learner.critics["risk"].events)).all()
    assert (after[:, 0].abs() > 0.5).all()


def changes(learner: ImitationLearner, steps: list[Step], overlap: bool = False) -> list[bool]:
    """Whether the policy changed at each step."""
    result = []
    for one in steps:
        before = module_state(learner.policy)
        if overlap:
            learner.update(one.t)
        learner.record(one)
        if not overlap:
            learner.update(one.t)
        after = module_state(learner.policy)
        result.append(any(not np.array_equal(before[k], after[k]) for k in before))
    return result


def lesson(n: int, ends=()) -> list[Step]:
    """n steps with one teleoperated and one autonomous robot, which fails in the steps `ends`."""
    return [step([Mode.TELEOPERATED, Mode.AUTONOMOUS], t=t, violation=[False, t in ends]) for t in range(n)]


@pytest.mark.parametrize(
    ("config", "due"),
    [
        ({"schedule": "step"}, [0, 1, 2, 3, 4, 5]),
        ({"schedule": "step", "every": 3}, [2, 5]),
        ({"schedule": "scratch", "every": 2}, [1, 3, 5]),
        ({"schedule": "episode"}, [1, 4]),
        ({"schedule": "never"}, []),
    ],
)
def test_the_schedule_says_when_the_policy_changes(config, due) -> None:
    assert np.flatnonzero(changes(make(**config), lesson(6, ends=(1, 4)))).tolist() == due


@pytest.mark.parametrize("schedule", ["step", "episode", "scratch", "never"])
def test_to_hear_first_what_humans_want_changes_nothing(schedule) -> None:
    told = []
    for prompt in (False, True):
        learner, losses = make(["risk"], schedule=schedule, every=2), []
        assert isinstance(learner, PromptLearner)
        for one in lesson(7, ends=(1, 4)):
            if prompt:
                learner.hear(one.t, one.obs[one.taught], one.wanted[one.taught])
                learner.begin(one.t)
            learner.record(one)
            losses.append(learner.update(one.t))
        told.append((losses, learner.state_dict()))
    assert told[0][0] == told[1][0]
    assert same(told[0][1], told[1][1])


def test_what_began_before_anybody_was_heard_goes_on_beside_critics_that_ask_the_policy_of_the_timestep() -> None:
    """As a loop with overlap has it: the policy's step is due, and the critics' too, and neither sees the other's."""
    lessons = lesson(3, ends=(1,))
    told = []
    for ahead in (True, False):
        learner = make(["risk"])
        for one in lessons:
            learner.record(one)
        if ahead:
            learner.begin(9)
            losses = learner.update(9)
        else:
            losses = {"risk": learner.critics["risk"].update()}
            losses["policy"] = learner.gradient_steps(1)
        told.append((losses, learner.state_dict()))
    assert told[0][0] == told[1][0]
    assert same(told[0][1], told[1][1])


def same(one, other) -> bool:
    """Whether two trees of arrays and values are equal to the bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(one, other)


def test_an_end_that_nobody_moved_into_ends_no_episode() -> None:
    """A violated robot stays in violation for many steps; only its fall ends an episode."""
    waiting = [step([Mode.TELEOPERATED, Mode.VIOLATED], t=t, violation=[False, True]) for t in range(3)]
    assert not any(changes(make(schedule="episode"), waiting))


def test_nothing_is_learnt_before_there_are_human_data() -> None:
    learner = make()
    learner.record(step([Mode.AUTONOMOUS]))
    assert learner.update(0) == {}


def test_critics_have_a_rhythm_of_their_own_and_rest_when_nothing_is_learnt() -> None:
    learner, frozen = make(["risk"], every=5), make(["risk"], schedule="never")
    losses = []
    for one in lesson(4):
        learner.record(one)
        frozen.record(one)
        losses.append(set(learner.update(one.t)))
        assert frozen.update(one.t) == {}
    assert losses == [set(), {"risk"}, set(), {"risk"}]


def test_learning_from_scratch_begins_with_new_weights_each_time_and_keeps_the_data() -> None:
    learner = make(schedule="scratch")
    learner.record(lesson(1)[0])
    initial = [w.detach().clone() for w in learner.policy.net.weights]
    learner.restart()
    first = [w.detach().clone() for w in learner.policy.net.weights]
    learner.restart()
    assert not torch.equal(first[0], learner.policy.net.weights[0])
    assert not torch.equal(first[0], initial[0])
    assert [w.shape for w in first] == [w.shape for w in initial]
    assert learner.regression.state_dict() == {}
    assert len(learner.dataset) == 1


def test_a_changed_policy_does_not_answer_from_memory() -> None:
    learner = make(learning_rate=0.1)
    obs = np.ones((5, WIDTH))
    before, spread = learner.policy.act(obs), learner.policy.uncertainty(obs)
    learner.record(lesson(1)[0])
    learner.update(0)
    assert not np.array_equal(learner.policy.act(obs), before)
    assert not np.array_equal(learner.policy.uncertainty(obs), spread)


def test_the_policy_learns_to_do_what_the_human_does() -> None:
    learner = make(learning_rate=1e-2, gradient_steps=5, batch=32)
    fleet = PointFleet(4, start=0.5, horizon=10)
    # The signals of the loop are of no interest here; every robot wants a human.
    loop = make_loop(fleet, FakePriority(lambda view: np.ones(4)), 4, policy=learner.policy, learner=learner,
                     supervisor=FakeSupervisor(0.6))  # fmt: skip
    loop.run(60)
    np.testing.assert_allclose(learner.policy.act(loop.obs), 0.6, atol=0.1)


def test_the_loss_reported_is_the_mean_over_members() -> None:
    learner = make(learning_rate=1e-12)
    learner.dataset.add(np.zeros((1, WIDTH)), np.full((1, 1), 0.25))
    said = learner.policy.net(torch.zeros(1, WIDTH))
    assert learner.gradient_steps(1) == pytest.approx(float((said.detach() - 0.25).square().mean()), rel=1e-5)


@pytest.mark.parametrize(
    "wrong", [{"schedule": "weekly"}, {"every": 0}, {"gradient_steps": 0}, {"batch": 0}, {"learning_rate": 0.0},
              {"learning_rate": float("nan")}, {"pretrain": -1}],
)  # fmt: skip
def test_impossible_settings_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        LearnerConfig(**wrong)
