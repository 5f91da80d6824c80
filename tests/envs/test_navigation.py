"""Navigation: walls, wind, the fork that cannot be taken in the middle, and two kinds of humans."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tutelage.envs.array_fleet import ArrayFleet
from tutelage.envs.experts.navigation import Navigator, downward, team, upward
from tutelage.envs.rollout import rollout
from tutelage.envs.tasks.navigation import GOAL, MIDDLE, OBSTACLE, OPEN, SIZE, START, WALLS, WINDY
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.prepare import demonstrations, prepare
from tutelage.fleet.supervisor import PolicySupervisor
from tutelage.learning.imitation import LearnerConfig

IN_WIND, BEFORE_WIND = [75.0, MIDDLE], [65.0, MIDDLE]


def at(*cells: Any, level: str = "none") -> ArrayFleet:
    """A fleet with a robot in each cell."""
    fleet = ArrayFleet("Navigation", len(cells), disturbance=level)
    fleet.reset(seed=0)
    fleet.put(np.array(cells, dtype=float))
    return fleet


def path(human: Any, start: Any, level: str = "none") -> tuple[Any, bool]:
    """The cells through which a human drives, and whether they lead to the goal."""
    fleet, cells = at(start, level=level), [np.array(start, dtype=float)]
    for _ in range(fleet.horizon):
        obs, _, _, _, info = fleet.step(human.act(cells[-1][None]))
        cells.append(obs[0])
        if info["success"][0] or info["violation"][0]:
            break
    return np.array(cells), bool(info["success"][0])


# -- the maze -------------------------------------------------------------------------------------------------------


def test_the_maze_is_symmetric_closed_and_has_two_ways() -> None:
    assert WALLS.shape == SIZE
    assert np.array_equal(WALLS, WALLS[:, ::-1])
    assert WALLS[[0, -1]].all()
    assert WALLS[:, [0, -1]].all()
    reached, previous = ~WALLS & False, None
    reached[5, 30] = True
    while previous is None or reached.sum() > previous:
        previous, grown = reached.sum(), reached.copy()
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            grown |= np.roll(reached, step, axis)
        reached = grown & ~WALLS
    assert np.array_equal(reached, ~WALLS), "all open cells hang together"
    column = WALLS[int(OBSTACLE[:, 0].mean())]
    assert np.diff(column.astype(int)).tolist().count(-1) == 2, "beside the obstacle there are two ways"


@pytest.mark.parametrize(
    ("cell", "action"),
    [((2, 30), (-1, 0)), ((5, 37), (0, 1)), ((5, 23), (0, -1)), ((22, 30), (1, 0)), ((38, 43), (0, -1)), ((60, 50), (1, 1)),
     ((90, 37), (0.5, 0.5))],
)  # fmt: skip
def test_whoever_runs_into_a_wall_stays_there_until_reset(cell: Any, action: Any) -> None:
    fleet = at(cell, START)
    actions = np.array([action, (0, 0)])
    obs, reward, terminated, _, info = fleet.step(actions)
    assert info["violation"].tolist() == terminated.tolist() == [True, False]
    assert reward.tolist() == [0, 0]
    again, _, _, _, info = fleet.step(-actions)
    assert np.array_equal(again, obs)
    assert info["violation"][0]
    obs, info = fleet.reset(options={"reset_mask": info["violation"]})
    assert obs[0].tolist() == START.tolist()
    assert not info["violation"].any()


@pytest.mark.parametrize(
    ("action", "move"),
    [((1, -1), (1, -1)), ((0.5, -0.5), (1, -1)), ((0.49, -0.49), (0, 0)), ((0, 0), (0, 0)), ((9, -9), (1, -1))],
)
def test_a_robot_ends_in_the_nearest_cell(action: Any, move: Any) -> None:
    obs = at((30, 50)).step(np.array([action], dtype=float))[0]
    assert (obs[0] - (30, 50)).tolist() == list(move)


def test_the_goal_ends_the_episode_with_reward_1() -> None:
    fleet = at(GOAL - [4, 0], GOAL - [4, 3])
    _, reward, terminated, truncated, info = fleet.step(np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert info["success"].tolist() == [True, False]
    assert reward.tolist() == [1, 0]
    assert not (terminated | truncated).any()


# -- wind -----------------------------------------------------------------------------------------------------------


def test_wind_blows_upwards_in_the_right_corridor_only() -> None:
    cells = [START, BEFORE_WIND, [WINDY[0] - 1, 30], [WINDY[0], 30], IN_WIND, [WINDY[1], 30], [WINDY[1] + 1, 30]]
    windy, calm = (at(*cells, level=level).step(np.zeros((7, 2)))[0] for level in ("wind=0.75", "none"))
    assert (calm == np.array(cells)).all()
    assert (windy - calm).tolist() == [[0, 0]] * 3 + [[0, 1]] * 3 + [[0, 0]]
    assert OPEN[0][0][0] < WINDY[0] < WINDY[1] < GOAL[0]


def test_wind_is_strong_but_can_be_held_against() -> None:
    down = np.array([[0.0, -1.0], [0.0, -0.2]])
    fleet = at(IN_WIND, IN_WIND, level="wind=0.75")
    for _ in range(10):
        obs, _, _, _, info = fleet.step(down)
    assert obs[0].tolist() == IN_WIND, "as fast as it can, it just stays"
    assert info["violation"].tolist() == [False, True], "whoever does less is blown against the wall"


def test_the_task_has_wind_and_its_demonstrations_do_not() -> None:
    assert ArrayFleet("Navigation", 1).disturbance.wind == 0.75
    config = assemble(RunConfig("Navigation", robots=4, humans=2, threads=1, offline_pairs=300)).config
    obs = demonstrations(config, team(), 200)[0]
    assert (obs[obs[:, 0] >= WINDY[0]][:, 1] == MIDDLE).all()


# -- the humans -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["none", "wind=0.75"])
def test_one_human_goes_up_at_the_fork_and_the_other_down(level: str) -> None:
    middle = OBSTACLE[:, 0].mean()
    heights = []
    for human in (upward(), downward()):
        cells, succeeded = path(human, START, level)
        assert succeeded
        assert 100 < len(cells) < 130
        heights.append(cells[np.abs(cells[:, 0] - middle) < 10][:, 1])
    assert (heights[0] > OBSTACLE[1][1]).all()
    assert (heights[1] < OBSTACLE[0][1]).all()
    np.testing.assert_allclose(heights[0] - MIDDLE, MIDDLE - heights[1])


@pytest.mark.parametrize("human", [upward(), downward()], ids=["upward", "downward"])
def test_a_human_gets_to_the_goal_from_every_cell(human: Navigator) -> None:
    cells = np.argwhere(~WALLS)
    fleet = at(*cells, level="wind=0.75")
    fleet.horizon = 400
    obs, succeeded = fleet.states, np.zeros(len(cells), dtype=bool)
    for _ in range(300):
        obs, _, _, _, info = fleet.step(human.act(obs))
        succeeded |= info["success"]
    assert succeeded.all()


def test_beside_the_obstacle_a_human_goes_on_the_way_that_was_taken() -> None:
    cells, succeeded = path(upward(), (40, 10))
    assert succeeded
    assert (cells[cells[:, 0] < OBSTACLE[1][0]][:, 1] < OBSTACLE[0][1]).all()


def test_humans_of_both_kinds_demonstrate_equally_often_and_teleoperate_in_turn() -> None:
    config = RunConfig("Navigation", robots=6, humans=5, threads=1, offline_pairs=2220)
    obs = demonstrations(config, team(), 200)[0]
    beside = (obs[:, 0] > 30) & (obs[:, 0] < 45)
    assert abs((obs[beside][:, 1] > MIDDLE).mean() - 0.5) < 0.01
    people = assemble(config).loop().team
    assert [type(human) for human in people.distinct] == [PolicySupervisor] * 2
    said = [people.act(np.array([[18.0, 30.0]]), np.array([0]), np.array([j]), 2)[0, 1] for j in range(5)]
    assert said == [1, -1, 1, -1, 1]


def test_cloning_both_kinds_does_not_get_past_the_fork() -> None:
    """The finding of section 6.5: the mean of both ways is none."""
    config = RunConfig(
        "Navigation", priority="C.", robots=4, humans=2, threads=1, torch_threads=1, offline_pairs=2220, members=2,
        hidden=(64, 64), learner=LearnerConfig(pretrain=600),
    )  # fmt: skip
    both = prepare(assemble(config))
    assert rollout(both.fleet, both.policy, seed=0).succeeded.mean() == 0
