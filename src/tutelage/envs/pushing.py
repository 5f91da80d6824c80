"""Quasi-static pushing of a square block by a point, for many blocks at once.

The block slides slowly, so that friction alone decides: inertia plays no part, and the block stops with the pusher. Friction
between block and table is the ellipsoidal limit surface of a block that presses evenly on the table (Lynch, Maekawa and
Tanie, 1992): under a force f at the point r it moves with velocity f and turns with (r x f) / c^2, up to a common factor,
where c is 0.3826 of its side. Friction between pusher and block is Coulomb's: the pusher sticks to the face while the force
lies within the friction cone, else it slides along the face and the force lies on the cone's edge.

Limits: the pusher is a point, it starts in contact, and it is in nobody's way; friction is the same everywhere and does not
depend on speed. What the block runs into does not push back: the push ends there.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

TURN_RADIUS = 0.3826
"""c of a square with sides of 1: the mean distance of its points from its middle."""
SUBSTEP = 0.002
"""How far the pusher moves at a time, m."""


@numba.njit(nogil=True, cache=True)
def _outside(x, y, angle, half, wall, corner, obstacle):  # type: ignore[no-untyped-def]
    """Whether a block touches a wall or an obstacle, or its middle is in one of the two corners that are cut off."""
    reach = half * (abs(np.cos(angle)) + abs(np.sin(angle)))  # of the block along the axes of the table
    if abs(x) + reach > wall or abs(y) + reach > wall or abs(x + y) > corner:
        return True
    if obstacle <= 0.0 or abs(x) > obstacle + reach or abs(y) > obstacle + reach:
        return False
    # Two squares overlap unless an axis of one of them separates them; the table's do not.
    c, s = np.cos(angle), np.sin(angle)
    extent = half + obstacle * (abs(c) + abs(s))
    return abs(c * x + s * y) < extent and abs(c * y - s * x) < extent


@numba.njit(nogil=True, cache=True)
def outside(blocks, half, wall, corner, obstacle):  # type: ignore[no-untyped-def]
    """Which blocks (N, 3) (x, y, angle) are where they must not be, (N,) bool.

    Args:
        blocks: where they are, m and rad.
        half: half of a block's side, m.
        wall: distance of the four walls from the middle, m.
        corner: a block's middle must have |x + y| <= corner, m.
        obstacle: half of the side of a square obstacle in the middle, m; 0: there is none.
    """
    found = np.zeros(len(blocks), dtype=np.bool_)
    for i in range(len(blocks)):
        found[i] = _outside(blocks[i, 0], blocks[i, 1], blocks[i, 2], half, wall, corner, obstacle)
    return found


@numba.njit(nogil=True, cache=True)
def _motion(rx, ry, nx, ny, vx, vy, friction, c2):  # type: ignore[no-untyped-def]
    """Velocity (x, y) and turning rate of a block whose point r, on a face with inward normal n, is pushed with velocity v.

    All on the block's own axes.
    """
    # Sticking: the force that makes the point move as the pusher does.
    scale = 1.0 / (c2 + rx * rx + ry * ry)
    fx = ((c2 + rx * rx) * vx + rx * ry * vy) * scale
    fy = (rx * ry * vx + (c2 + ry * ry) * vy) * scale
    normal, across = fx * nx + fy * ny, -fx * ny + fy * nx
    if abs(across) > friction * normal:
        # Sliding: the force is on the edge of the cone, and only along the normal do both move alike.
        side = friction if across > 0.0 else -friction
        fx, fy = nx - side * ny, ny + side * nx
        turn = (rx * fy - ry * fx) / c2
        into = (fx - turn * ry) * nx + (fy + turn * rx) * ny
        if into <= 1e-9:
            return 0.0, 0.0, 0.0
        scale = (vx * nx + vy * ny) / into
        fx, fy = scale * fx, scale * fy
    return fx, fy, (rx * fy - ry * fx) / c2


@numba.njit(nogil=True, cache=True)
def push(blocks, start, way, friction, half, wall, corner, obstacle):  # type: ignore[no-untyped-def]
    """Where blocks (N, 3) (x, y, angle) are after a push, (N, 3). It ends early where a block is where it must not be.

    Args:
        blocks: where they are, m and rad.
        start: (N, 2) where each pusher begins, m, on the block's own axes: a point of one of its faces.
        way: (N, 2) how far it moves, m, on the table's axes.
        friction: (N,) coefficient between pusher and block.
        half, wall, corner, obstacle: see `outside`.
    """
    after = blocks.copy()
    c2 = (TURN_RADIUS * 2.0 * half) ** 2
    for i in range(len(blocks)):
        length = np.hypot(way[i, 0], way[i, 1])
        steps = int(np.ceil(length / SUBSTEP - 1e-6))  # not one more for a rounding error
        if steps == 0:
            continue
        dx, dy = way[i, 0] / steps, way[i, 1] / steps
        x, y, angle = blocks[i, 0], blocks[i, 1], blocks[i, 2]
        rx, ry = start[i, 0], start[i, 1]
        # The face on which it stands, by its inward normal.
        if abs(rx) >= abs(ry):
            nx, ny = -np.sign(rx), 0.0
        else:
            nx, ny = 0.0, -np.sign(ry)
        for _ in range(steps):
            c, s = np.cos(angle), np.sin(angle)
            vx, vy = c * dx + s * dy, c * dy - s * dx
            if vx * nx + vy * ny <= 0.0:
                break  # the face turned away from it
            mx, my, turn = _motion(rx, ry, nx, ny, vx, vy, friction[i], c2)
            # Where the pusher is next, as the block sees it; the face is straight, so it stays on it.
            slip = -(vx - mx + turn * ry) * ny + (vy - my - turn * rx) * nx
            rx, ry = rx - slip * ny, ry + slip * nx
            x, y, angle = x + c * mx - s * my, y + s * mx + c * my, angle + turn
            if abs(-rx * ny + ry * nx) > half or _outside(x, y, angle, half, wall, corner, obstacle):
                break  # it slid off the end of the face, or the block is where it must not be
        after[i, 0], after[i, 1], after[i, 2] = x, y, angle
    return after
