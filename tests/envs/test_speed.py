"""How fast a fleet is: what is repeated while the clock runs is what was recorded."""

from __future__ import annotations

import numpy as np

from tutelage.envs.array_fleet import ArrayFleet
from tutelage.envs.experts.block_pushing import Pusher
from tutelage.envs.speed import record, steps_a_second


def test_a_recorded_episode_is_repeated_number_for_number() -> None:
    fleet = ArrayFleet("BlockPushing", 5)
    episode = record(fleet, Pusher(), 40, seed=3)
    after = fleet.states.copy()
    assert episode.actions.shape == (40, 5, 4)
    assert episode.robot_steps == 200
    assert episode.again.any(), "robots that are done begin again"
    fleet.reset(seed=3)
    episode.play(fleet)
    assert np.array_equal(fleet.states, after)


def test_without_a_human_actions_are_random_and_small() -> None:
    fleet = ArrayFleet("Navigation", 4)
    episode = record(fleet, None, 10)
    assert 0.1 < np.abs(episode.actions).max() <= 0.3
    assert np.array_equal(episode.actions, record(fleet, None, 10).actions)


def test_a_rate_is_a_positive_number() -> None:
    assert steps_a_second(ArrayFleet("Navigation", 10), seconds=0.01) > 100
