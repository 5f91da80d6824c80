"""One episode on every robot: what counts, and when it ends."""

from __future__ import annotations

from fakes import FakePolicy, PointFleet

from tutelage.envs.rollout import rollout


def test_rewards_count_until_an_episode_ends_however_it_ends() -> None:
    fleet = PointFleet(4, horizon=7, falls={2: [0]}, successes={4: [1]})
    episodes = rollout(fleet, FakePolicy(), seed=0)
    assert episodes.returns.tolist() == [3, 5, 7, 7]
    assert episodes.survived.tolist() == [False, True, True, True]
    assert episodes.succeeded.tolist() == [False, True, False, False]


def test_nothing_is_stepped_after_the_last_end() -> None:
    fleet = PointFleet(2, horizon=50, falls={3: [0], 5: [1]})
    rollout(fleet, FakePolicy(), seed=0)
    assert len(fleet.moved) == 6


def test_the_seed_decides() -> None:
    fleet = PointFleet(3, horizon=30, noise=0.3, bound=0.5)
    first, again, other = (rollout(fleet, FakePolicy(), seed=seed) for seed in (1, 1, 2))
    assert first.returns.tolist() == again.returns.tolist()
    assert first.returns.tolist() != other.returns.tolist()
