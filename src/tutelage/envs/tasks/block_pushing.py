"""Block pushing, twice: a robot pushes a block to a goal on a table, which it sees from above; violation: walls and corners.

`BlockPushing` is the physical experiment of section 5.6 of the dissertation: four discrete pushes, random goals.
`ObstaclePushing` is that of section 6.5: continuous pushes around an obstacle, which humans pass on different sides.
"""

from __future__ import annotations

import functools
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array, ArrayTask, View, World

HALF = 0.02
"""Half of the block's side, m."""
WALL = 0.15
"""Distance of the walls from the middle of the table, m."""
STEP = 0.03
"""Length of a discrete push, m; and of a continuous one along each axis, at most."""
GOAL_RADIUS = 0.025
"""The goal is reached when the block's middle is so near, m."""
FRICTION = 0.6
"""Between pusher and block."""
CORNER = 0.2
"""Without an obstacle, a block with |x + y| beyond this is out of the pusher's reach: two opposite corners, m."""
OBSTACLE = 0.035
"""Half of the side of the obstacle, m."""
RING = 0.098
"""Distance from the middle at which the block begins beside the obstacle, m."""
FACES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Which way each discrete push goes, on the axes of a block that is not turned."""

TABLE, BORDER, BLOCK, GOAL, STONE = np.array(
    [[214, 186, 146], [120, 92, 62], [40, 80, 200], [70, 170, 80], [70, 70, 74]], dtype=np.uint8
)
"""Colours: wood, its border, the cube, the goal, the obstacle."""
VIEW = View(0.0, 0.0, 2 * (WALL + 0.01), 2 * (WALL + 0.01))
"""What the camera sees: the table, m."""


class _Pushing(ArrayTask):
    """What both have in common.

    State: middle (x, y) and angle of the block, middle (x, y) of the goal. Observations: where the block is (2, m), cosine
    and sine of four times its angle (a square looks the same after a quarter turn), where the goal is (2, m).
    """

    horizon = 50
    dt = 1.0
    corner: ClassVar[float]
    obstacle: ClassVar[float]
    action_low: ClassVar[Array]
    action_high: ClassVar[Array]

    def observe(self, state: Array) -> Array:
        quarter = 4 * state[:, 2]
        return np.stack([state[:, 0], state[:, 1], np.cos(quarter), np.sin(quarter), state[:, 3], state[:, 4]], axis=1)

    def violation(self, state: Array) -> NDArray[np.bool_]:
        return self.outside(state[:, :3])

    def outside(self, blocks: Array) -> NDArray[np.bool_]:
        """Which blocks (N, 3) (x, y, angle) touch a wall or the obstacle, or are in a corner out of reach."""
        from tutelage.envs.pushing import outside

        where = np.ascontiguousarray(blocks)
        return np.asarray(outside(where, HALF, WALL, self.corner, self.obstacle))

    def success(self, state: Array) -> NDArray[np.bool_]:
        return np.asarray(np.square(state[:, :2] - state[:, 3:]).sum(axis=1) <= GOAL_RADIUS**2)

    def push(self, state: Array, start: Array, way: Array, world: World) -> Array:
        """The states after pushes from `start` (N, 2), m, on the block's axes, by `way` (N, 2), m, on the table's."""
        from tutelage.envs.pushing import push

        moved = push(
            np.ascontiguousarray(state[:, :3]), start, way, FRICTION * world.friction,
            HALF, WALL, self.corner, self.obstacle,
        )  # fmt: skip
        return np.concatenate([moved, state[:, 3:]], axis=1)

    def draw(self, state: Array, width: int, height: int) -> NDArray[np.uint8]:
        from tutelage.envs.raster import paint

        scale = VIEW.scale(width, height)
        x, y, angle, goal_x, goal_y = state.T
        shapes = np.zeros((len(state), 3, 4))
        shapes[:, 0, :3] = np.stack([goal_x, goal_y, np.full_like(x, GOAL_RADIUS)], axis=1)
        shapes[:, 1, 2] = self.obstacle
        shapes[:, 2] = np.stack([x, y, np.full_like(x, HALF), angle], axis=1)
        shapes[:, :, :3] *= scale
        shapes[:, :, 0] += width / 2  # the middle of the table is that of the picture
        shapes[:, :, 1] = height / 2 - shapes[:, :, 1]  # y and angles are counted upwards
        shapes[:, :, 3] *= -1
        discs, colours = np.array([True, False, False]), np.stack([GOAL, STONE, BLOCK])
        return paint(_background(width, height), shapes, discs, colours)


class BlockPushing(_Pushing):
    """6 observations (or images), 4 actions: how much each push is wanted; the block is pushed by what is wanted most.

    The pushes go along those of the block's axes that are nearest to the table's +x, +y, -x, -y, by 3 cm, in the middle of a
    face. Violation: the block touches a wall, or is in one of two corners out of reach. Goal: within 2.5 cm of a random
    place; the block stays there, and the next goal is another one.
    """

    name = "BlockPushing"
    noise_size = 2
    corner, obstacle = CORNER, 0.0
    disturbance = "extreme"
    offline_pairs = 375
    expert = "tutelage.envs.experts.block_pushing:Pusher"
    action_low, action_high = -np.ones(4, dtype=np.float32), np.ones(4, dtype=np.float32)
    summary = "a block is pushed to random goals, four ways; violation: walls, two corners out of reach"

    def initial(self, rng: np.random.Generator, n: int) -> Array:
        block = np.concatenate([rng.uniform(-0.04, 0.04, (n, 2)), rng.uniform(-0.25, 0.25, (n, 1))], axis=1)
        return np.concatenate([block, _goals(rng, block[:, :2])], axis=1)

    def onward(self, rng: np.random.Generator, state: Array) -> Array:
        return np.concatenate([state[:, :3], _goals(rng, state[:, :2])], axis=1)

    def advance(self, state: Array, actions: Array, world: World) -> Array:
        angle = upright(state[:, 2])
        inward = FACES[np.argmax(actions, axis=1)]
        offset = 0.5 * HALF * np.clip(world.noise[:, :1], -1.5, 1.5)
        length = STEP * np.clip(1.0 + 0.5 * world.noise[:, 1:], 0.0, 2.0)
        start = -HALF * inward + offset * inward[:, ::-1]
        # FACES are on the axes of a block that is turned by less than an eighth; the state counts quarter turns as well.
        quarters = state[:, 2] - angle
        return self.push(state, rotate(start, -quarters), rotate(length * inward, angle), world)


class ObstaclePushing(_Pushing):
    """6 observations (or images), 2 actions: along which vector the block is pushed, from its middle.

    The push is at most 3 cm along each axis of the table. It meets the block where a line against its direction through the
    block's middle leaves the block, and slides along the face if it is too oblique. Violation: the block touches a wall or
    the obstacle. Goal: within 2.5 cm of the place opposite to where the block began; the block stays there, and the next
    goal is the place opposite.
    """

    name = "ObstaclePushing"
    noise_size = 3
    corner, obstacle = 2 * WALL, OBSTACLE
    disturbance = "strong"
    offline_pairs = 336
    expert = "tutelage.envs.experts.block_pushing:team"
    action_low, action_high = -np.ones(2, dtype=np.float32), np.ones(2, dtype=np.float32)
    summary = "a block is pushed around an obstacle, any way; violation: walls and obstacle"

    def initial(self, rng: np.random.Generator, n: int) -> Array:
        side = FACES[rng.integers(4, size=n)]
        place = RING * side + rng.uniform(-0.01, 0.01, (n, 2))
        return np.concatenate([place, rng.uniform(-np.pi / 4, np.pi / 4, (n, 1)), _opposite(place)], axis=1)

    def onward(self, rng: np.random.Generator, state: Array) -> Array:
        return np.concatenate([state[:, :3], _opposite(state[:, :2])], axis=1)

    def advance(self, state: Array, actions: Array, world: World) -> Array:
        way = STEP * np.clip(actions + world.noise[:, :2], -1.0, 1.0)
        along = rotate(way, -state[:, 2])
        longer = np.maximum(np.abs(along).max(axis=1, keepdims=True), 1e-12)
        start = -HALF * along / longer
        # Beside the point that was meant, on the same face.
        across = np.where(np.abs(along) < longer, 1.0, 0.0)
        start = np.clip(start + 0.5 * HALF * np.clip(world.noise[:, 2:], -1.5, 1.5) * across, -HALF, HALF)
        return self.push(state, start, way, world)


def upright(angle: Array) -> Array:
    """Angles (N,) of squares without their quarter turns: from -45 to 45 degrees, rad."""
    return angle - np.rint(angle / (np.pi / 2)) * (np.pi / 2)


def rotate(vectors: Array, angle: Array) -> Array:
    """Vectors (N, 2) turned by angles (N,), rad, counter-clockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], axis=1)


def _goals(rng: np.random.Generator, blocks: Array) -> Array:
    """Random places (n, 2) within reach, m, of which none is where its block is already."""
    side, reach = WALL - 2 * HALF, CORNER - 2 * HALF
    goals = rng.uniform(-side, side, (len(blocks), 8, 2))
    good = (np.abs(goals.sum(axis=2)) <= reach) & (np.linalg.norm(goals - blocks[:, None], axis=2) > 3 * GOAL_RADIUS)
    first = np.argmax(good, axis=1)
    chosen = goals[np.arange(len(blocks)), first]
    away = np.where(np.abs(blocks) > 0.02, -blocks, 0.08)  # eight draws that are all bad: the other side of the table
    away *= np.minimum(reach / np.maximum(np.abs(away.sum(axis=1, keepdims=True)), 1e-9), 1.0)
    return np.where(good.any(axis=1)[:, None], chosen, away)


def _opposite(blocks: Array) -> Array:
    """The places (n, 2) opposite to blocks beside the obstacle, kept between it and the walls, m."""
    far = np.linalg.norm(blocks, axis=1, keepdims=True)
    return np.asarray(-blocks * np.clip(far, RING - 0.01, RING + 0.01) / np.maximum(far, 1e-9))


@functools.lru_cache(16)
def _background(width: int, height: int) -> NDArray[np.uint8]:
    """The empty table, (height, width, 3)."""
    x, y = (np.abs(at) for at in VIEW.points(width, height))
    inside = (x < WALL)[None, :] & (y < WALL)[:, None]
    return np.asarray(np.where(inside[..., None], TABLE, BORDER))
