"""Block pushing: the mechanics of a push, walls, corners and obstacle, goals that move on, images, two kinds of humans."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tutelage.envs.array_fleet import ArrayFleet
from tutelage.envs.experts.block_pushing import clockwise, counterclockwise
from tutelage.envs.pushing import TURN_RADIUS, outside, push
from tutelage.envs.raster import paint
from tutelage.envs.tasks.block_pushing import (
    BLOCK,
    BORDER,
    CORNER,
    FACES,
    GOAL,
    GOAL_RADIUS,
    HALF,
    OBSTACLE,
    RING,
    STEP,
    STONE,
    WALL,
    rotate,
    upright,
)  # fmt: skip
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig

FREE = (HALF, 10.0, 20.0, 0.0)
"""A table without an end."""


def blocks(n: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-0.05, 0.05, (n, 2)), rng.uniform(-3, 3, (n, 1))], axis=1)


def contacts(n: int, seed: int = 1) -> Any:
    """Points of the faces of a block, and the inward normals there, on its own axes."""
    rng = np.random.default_rng(seed)
    normal = FACES[rng.integers(4, size=n)]
    return -HALF * normal + HALF * rng.uniform(-0.9, 0.9, (n, 1)) * normal[:, ::-1], normal


def fleet_at(name: str, *states: Any, level: str = "none") -> ArrayFleet:
    fleet = ArrayFleet(name, len(states), disturbance=level)
    fleet.reset(seed=0)
    fleet.put(np.array(states, dtype=float))
    return fleet


# -- mechanics ------------------------------------------------------------------------------------------------------


def test_a_push_through_the_middle_moves_and_does_not_turn() -> None:
    at, normal = blocks(50), FACES[np.arange(50) % 4]
    after = push(at, -HALF * normal, 0.03 * rotate(normal, at[:, 2]), np.full(50, 0.5), *FREE)
    np.testing.assert_allclose(after[:, :2] - at[:, :2], 0.03 * rotate(normal, at[:, 2]), atol=1e-12)
    np.testing.assert_allclose(after[:, 2], at[:, 2], atol=1e-12)


def test_a_push_beside_the_middle_turns_the_block_away_and_as_theory_says() -> None:
    offset = np.array([0.004, -0.004, 0.012, -0.012])
    start = np.stack([np.full(4, -HALF), offset], axis=1)
    way = np.tile([1e-4, 0.0], (4, 1))
    after = push(np.zeros((4, 3)), start, way, np.full(4, 10.0), *FREE)  # rough: the pusher sticks
    c2 = (2 * HALF * TURN_RADIUS) ** 2
    far2 = HALF**2 + offset**2
    np.testing.assert_allclose(after[:, 0], 1e-4 * (c2 + HALF**2) / (c2 + far2), rtol=1e-3)
    np.testing.assert_allclose(after[:, 2], -1e-4 * offset / (c2 + far2), rtol=1e-3)


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.6, 2.0])
def test_contact_is_one_sided_and_never_gains_energy(friction: float) -> None:
    """The pusher pushes and does not pull, does not sink in, and the block moves no faster than its contact."""
    n, tiny = 500, 1e-6
    at, (start, normal) = blocks(n), contacts(n)
    way = tiny * rotate(normal, np.random.default_rng(2).uniform(-1.4, 1.4, n))  # on the block's axes, and into it
    after = push(at, start, rotate(way, at[:, 2]), np.full(n, friction), *FREE)
    moved, turn = rotate(after[:, :2] - at[:, :2], -at[:, 2]), after[:, 2] - at[:, 2]
    contact = moved + turn[:, None] * np.stack([-start[:, 1], start[:, 0]], axis=1)
    into = lambda vectors: (vectors * normal).sum(axis=1)  # noqa: E731
    np.testing.assert_allclose(into(contact), into(way), rtol=1e-3, atol=1e-9)
    # The force that this motion stands for, by the limit surface: within the friction cone, and its moment fits.
    c2 = (2 * HALF * TURN_RADIUS) ** 2
    across = (moved * np.stack([-normal[:, 1], normal[:, 0]], axis=1)).sum(axis=1)
    assert (into(moved) > 0).all()
    assert (np.abs(across) <= friction * into(moved) * (1 + 1e-3) + 1e-12).all()
    np.testing.assert_allclose(c2 * turn, start[:, 0] * moved[:, 1] - start[:, 1] * moved[:, 0], rtol=1e-3, atol=1e-12)
    power = (moved * way).sum(axis=1)
    assert (power >= (moved * contact).sum(axis=1) - 1e-15).all(), "sliding along the face costs energy"


def test_a_rough_pusher_sticks_and_a_smooth_one_slides() -> None:
    start, way = np.array([[-HALF, 0.0]]), np.array([[0.01, 0.01]])
    rough, smooth = (push(np.zeros((1, 3)), start, way, np.array([friction]), *FREE)[0] for friction in (2.0, 0.0))
    assert rough[1] > 0.002, "it takes the block along sideways"
    assert abs(smooth[1]) < 0.001
    assert smooth[0] > 0.008


def test_a_pusher_that_slides_off_the_face_leaves_the_block() -> None:
    start, way = np.array([[-HALF, 0.9 * HALF]]), np.array([[0.01, 0.03]])
    after = push(np.zeros((1, 3)), start, way, np.array([0.2]), *FREE)[0]
    assert np.linalg.norm(after[:2]) < 0.005


def test_no_push_no_motion() -> None:
    at, (start, _) = blocks(5), contacts(5)
    assert np.array_equal(push(at, start, np.zeros((5, 2)), np.ones(5), *FREE), at)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_pushes_know_no_preferred_direction(quarter: int) -> None:
    at, (start, normal), friction = blocks(200), contacts(200), np.full(200, 0.4)
    way = 0.02 * rotate(rotate(normal, at[:, 2]), np.random.default_rng(3).uniform(-1, 1, 200))
    angle = np.full(200, quarter * np.pi / 2 + 0.3)
    turned = np.concatenate([rotate(at[:, :2], angle), at[:, 2:] + angle[:, None]], axis=1)
    one, other = push(at, start, way, friction, *FREE), push(turned, start, rotate(way, angle), friction, *FREE)
    np.testing.assert_allclose(other[:, :2], rotate(one[:, :2], angle), atol=1e-9)
    np.testing.assert_allclose(other[:, 2], one[:, 2] + angle, atol=1e-9)


def test_pushes_are_the_same_in_a_mirror() -> None:
    at, (start, normal), friction = blocks(200), contacts(200), np.full(200, 0.4)
    way = 0.02 * rotate(rotate(normal, at[:, 2]), np.random.default_rng(3).uniform(-1, 1, 200))
    flip = np.array([1.0, -1.0])
    one = push(at, start, way, friction, *FREE)
    other = push(at * [1, -1, -1], start * flip, way * flip, friction, *FREE)
    np.testing.assert_allclose(other, one * [1, -1, -1], atol=1e-9)


# -- where a block must not be --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "block", "bad"),
    [
        ("BlockPushing", (WALL - HALF - 0.001, 0, 0), False),
        ("BlockPushing", (WALL - HALF + 0.001, 0, 0), True),
        ("BlockPushing", (WALL - HALF - 0.001, 0, np.pi / 4), True),
        ("BlockPushing", (0, -WALL + HALF - 0.001, np.pi), True),
        ("BlockPushing", (CORNER / 2 - 0.001, CORNER / 2 - 0.001, 0), False),
        ("BlockPushing", (CORNER / 2 + 0.001, CORNER / 2 + 0.001, 0), True),
        ("BlockPushing", (-CORNER / 2 - 0.001, -CORNER / 2 - 0.001, 0), True),
        ("BlockPushing", (CORNER / 2 + 0.001, -CORNER / 2 - 0.001, 0), False),
        ("BlockPushing", (0, 0, 1.0), False),
        ("ObstaclePushing", (0, 0, 1.0), True),
        ("ObstaclePushing", (OBSTACLE + HALF + 0.001, 0, 0), False),
        ("ObstaclePushing", (OBSTACLE + HALF - 0.001, 0, np.pi / 2), True),
        ("ObstaclePushing", (OBSTACLE + HALF + 0.001, 0, np.pi / 4), True),
        ("ObstaclePushing", (OBSTACLE + HALF - 0.005, OBSTACLE + HALF - 0.005, np.pi / 4), False),
        ("ObstaclePushing", (OBSTACLE + HALF - 0.005, OBSTACLE + HALF - 0.005, 0), True),
        ("ObstaclePushing", (CORNER / 2 + 0.005, CORNER / 2 + 0.005, 0), False),
        ("ObstaclePushing", (0, WALL - HALF + 0.001, 0), True),
    ],
)
def test_walls_corners_and_obstacle(name: str, block: Any, bad: bool) -> None:
    assert fleet_at(name, [*block, 0.1, 0.0]).task.violation(np.array([[*block, 0.1, 0.0]]))[0] == bad


def test_overlap_with_the_obstacle_is_that_of_the_two_squares() -> None:
    rng = np.random.default_rng(0)
    at = np.concatenate([rng.uniform(-0.08, 0.08, (300, 2)), rng.uniform(-3, 3, (300, 1))], axis=1)
    found = outside(at, HALF, 1.0, 2.0, OBSTACLE)
    grid = np.linspace(-HALF, HALF, 81)
    points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    for block, hit in zip(at, found, strict=True):
        inside = np.abs(rotate(points, np.full(len(points), block[2])) + block[:2]).max(axis=1).min() < OBSTACLE
        closest = np.abs(rotate(points, np.full(len(points), block[2])) + block[:2]).max(axis=1).min() - OBSTACLE
        assert hit == inside or abs(closest) < 0.0006, "the sampled points are 0.5 mm apart"


def test_a_push_against_the_obstacle_ends_there() -> None:
    fleet = fleet_at("ObstaclePushing", [OBSTACLE + HALF + 0.005, 0, 0, -0.1, 0], [0, RING, 0, 0, -0.1])
    obs, _, _, _, info = fleet.step(np.array([[-1.0, 0.0], [0.0, 0.0]]))
    assert info["violation"].tolist() == [True, False]
    assert OBSTACLE + HALF - 0.003 < obs[0, 0] < OBSTACLE + HALF
    obs, info = fleet.reset(options={"reset_mask": info["violation"]})
    assert not info["violation"].any()
    assert obs[1].tolist() == [*fleet.states[1, :2].tolist(), 1, 0, 0, -0.1]


# -- actions, goals -------------------------------------------------------------------------------------------------


def test_the_four_pushes_go_along_the_axes_of_the_block() -> None:
    for angle in (0.0, 0.3, -0.5, 1.3, 2.0, -2.9):
        fleet = fleet_at("BlockPushing", *[[0, 0, angle, 0.1, 0.1]] * 4)
        obs = fleet.step(2.0 * np.eye(4) - 1)[0]
        np.testing.assert_allclose(obs[:, :2], STEP * rotate(FACES, np.full(4, upright(np.array([angle]))[0])), atol=1e-9)
        assert (fleet.states[:, 2] == pytest.approx(angle)) or np.allclose(fleet.states[:, 2], angle)


def test_a_continuous_push_goes_from_the_middle_along_its_vector() -> None:
    angles = np.linspace(-3, 3, 40)
    way = np.stack([np.cos(np.arange(40)), np.sin(np.arange(40))], axis=1)
    fleet = fleet_at("ObstaclePushing", *[[0.09, 0.09, angle, -0.1, 0] for angle in angles])
    obs = fleet.step(0.5 * way)[0]
    moved = obs[:, :2] - 0.09
    oblique = np.abs(upright(np.arange(40.0) - angles))
    sticks = oblique < np.arctan(0.6) - 1e-6
    np.testing.assert_allclose(moved[sticks], 0.5 * STEP * way[sticks], atol=1e-9)
    assert sticks.sum() > 15
    assert (np.linalg.norm(moved, axis=1) <= 0.5 * STEP + 1e-9).all()
    assert (np.abs(fleet.states[~sticks, 2] - angles[~sticks]) > 1e-3).all(), "an oblique push turns the block"


@pytest.mark.parametrize("name", ["BlockPushing", "ObstaclePushing"])
def test_after_a_success_the_block_stays_and_the_goal_moves_on(name: str) -> None:
    near = [-STEP if name == "BlockPushing" else 0.0, -RING + 0.01, 0.1, 0.0, -RING]  # no wish is a push along +x
    fleet = fleet_at(name, near, [0.05, RING, 0.2, -0.1, 0.0])
    _, reward, _, _, info = fleet.step(np.zeros((2, len(fleet.action_low))))
    assert info["success"].tolist() == [True, False]
    assert reward.tolist() == [1, 0]
    done = fleet.states[0].copy()
    obs, _ = fleet.reset(options={"reset_mask": info["success"]})
    assert obs[0, :2].tolist() == done[:2].tolist()
    assert np.linalg.norm(obs[0, 4:] - done[:2]) > 2 * GOAL_RADIUS
    anew, _ = fleet.reset(options={"reset_mask": np.array([True, False])})
    assert anew[0, :2].tolist() != done[:2].tolist(), "but one that is reset in the middle of an episode begins anew"


def test_goals_are_within_reach_and_blocks_begin_where_they_may() -> None:
    fleet = ArrayFleet("BlockPushing", 2000)
    obs, info = fleet.reset(seed=0)
    assert not info["violation"].any()
    goals = np.concatenate([obs[:, 4:6], np.zeros((2000, 1))], axis=1)
    assert not fleet.task.outside(goals).any()
    assert (np.linalg.norm(obs[:, 4:6] - obs[:, :2], axis=1) > 2 * GOAL_RADIUS).all()
    assert (np.abs(obs[:, :2]) <= 0.04).all(), "near the middle of the table"
    assert min(np.histogram(obs[:, 4 + axis], bins=5)[0].min() for axis in (0, 1)) > 250

    fleet = ArrayFleet("ObstaclePushing", 2000)
    obs, info = fleet.reset(seed=0)
    assert not info["violation"].any()
    goals = np.concatenate([obs[:, 4:6], np.full((2000, 1), 0.7)], axis=1)
    assert not fleet.task.outside(goals).any()
    np.testing.assert_allclose(np.arctan2(*obs[:, 5:3:-1].T), np.arctan2(*-obs[:, 1::-1].T), atol=1e-9)
    sides = np.abs(obs[:, :2]).argmax(axis=1) + 2 * (obs[:, :2].sum(axis=1) > 0)
    assert np.bincount(sides, minlength=4).min() > 400, "on each side of the obstacle"


# -- humans ---------------------------------------------------------------------------------------------------------


def test_humans_go_round_the_obstacle_on_their_own_side_and_take_a_shorter_way() -> None:
    for human, sign in ((clockwise(), -1), (counterclockwise(), 1)):
        fleet = ArrayFleet("ObstaclePushing", 40, disturbance="none")
        obs, _ = fleet.reset(seed=0)
        turned, before = np.zeros(40), np.arctan2(obs[:, 1], obs[:, 0])
        for _ in range(15):
            obs = fleet.step(human.act(obs))[0]
            bearing = np.arctan2(obs[:, 1], obs[:, 0])
            turned += (bearing - before + np.pi) % (2 * np.pi) - np.pi
            before = bearing
        assert (sign * turned > 2.5).all()
        shorter = fleet_at("ObstaclePushing", *[[0.0, RING, 0, 0.09 * side, -0.05] for side in (1, -1)])
        x = shorter.step(human.act(shorter._observe()))[0][:, 0]
        assert x[0] > 0 > x[1]


def test_a_team_has_both_kinds() -> None:
    people = assemble(RunConfig("ObstaclePushing", robots=4, humans=2, threads=1)).loop().team
    obs = np.array([[0.0, RING, 1.0, 0.0, 0.0, -RING]])
    first, second = (people.act(obs, np.array([0]), np.array([j]), 2)[0, 0] for j in (0, 1))
    assert first > 0 > second, "from the top, clockwise is to the right"


# -- images ---------------------------------------------------------------------------------------------------------


def middle_of(picture: Any, colour: Any, tolerance: int = 40) -> Any:
    """Mean position (x, y) of the pixels of a colour, m."""
    rows, columns = np.nonzero(np.abs(picture.astype(int) - colour).max(axis=2) < tolerance)
    scale = (WALL + 0.01) / (len(picture) / 2)
    return np.array([columns.mean() + 0.5 - len(picture) / 2, len(picture) / 2 - rows.mean() - 0.5]) * scale


@pytest.mark.parametrize("name", ["BlockPushing", "ObstaclePushing"])
def test_images_show_block_and_goal_where_they_are(name: str) -> None:
    fleet = ArrayFleet(name, 30, observation="images")
    images, _ = fleet.reset(seed=3)
    assert images.shape == (30, 64, 64, 3)
    for image, state in zip(images, fleet.states, strict=True):
        if np.linalg.norm(state[:2] - state[3:]) > 0.06:
            np.testing.assert_allclose(middle_of(image, BLOCK), state[:2], atol=0.002)
            np.testing.assert_allclose(middle_of(image, GOAL), state[3:], atol=0.002)
        assert (image[0, 0] == BORDER).all()
        assert (image[32, 32] == STONE).all() == (name == "ObstaclePushing")
    moved, _, _, _, info = fleet.step(np.ones((30, len(fleet.action_low))))
    assert not np.array_equal(moved, images)
    np.testing.assert_array_equal(info["state"], fleet._observe())


def test_a_turned_square_is_drawn_turned_and_with_its_area() -> None:
    background, white = np.zeros((40, 40, 3), dtype=np.uint8), np.full((1, 3), 255, dtype=np.uint8)
    for disc, area in ((False, 400.0), (True, np.pi * 100)):
        shapes = np.array([[[20.0, 20.0, 10.0, angle]] for angle in np.linspace(0, 1.5, 12)])
        pictures = paint(background, shapes, np.array([disc]), white)[..., 0] / 255
        np.testing.assert_allclose(pictures.sum(axis=(1, 2)), area, rtol=0.02)
    tilted = paint(background, np.array([[[20.0, 20.0, 10.0, np.pi / 4]]]), np.array([False]), white)[0, ..., 0]
    assert tilted[20, 7] > 0
    assert tilted[12, 12] == 0
    assert paint(background, np.array([[[-5.0, 60.0, 10.0, 0.3]]]), np.array([False]), white).max() == 0, (
        "out of the picture"
    )
