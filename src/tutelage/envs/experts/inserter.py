"""What the algorithmic humans of the two peg insertions share: what to do next with a ring, its handle and a peg."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Array

Mask = NDArray[np.bool_]

OVER_HANDLE, OVER_PEG, DOWN = 0.06, 0.03, 0.03
"""How high the grip approaches above the handle, the ring above the tip of the peg; where the ring is let go, m."""
CLOSE, STRAIGHT, CENTRED = 0.008, 0.12, 0.007
"""Near enough to the handle to go down to it, m; turned well enough, rad; near enough to the peg's axis to go down, m."""
KEEP_AWAY = 0.1
"""Nearer to the peg's axis than this, an empty gripper moves sideways only above its tip, m."""
UPRIGHT = 0.7
"""Cosine of how far a held ring may hang over."""
ASIDE = np.array([-0.15, 0.0])
"""From the peg to where a ring that hangs over is dropped, to be gripped better, m."""


@dataclass(frozen=True)
class Scene:
    """What the human looks at, of N robots. Heights are above the table.

    Attributes:
        grip: (N, 3) where the fingers grip, m.
        yaw: (N,) heading of the gripper, rad; the fingers close across it.
        finger: (N,) distance of a finger from the middle, m.
        ring: (N, 3) middle of the ring, m.
        handle: (N, 3) unit vector along its handle.
        axis: (N, 3) unit vector along its axis.
    """

    grip: Array
    yaw: Array
    finger: Array
    ring: Array
    handle: Array
    axis: Array


class Inserter(ABC):
    """Looks at each row alone and keeps no memory, so it can take over in any state: whatever went wrong, the next step
    follows from where gripper and ring are now.

    Without the ring: rise, go above the handle and turn across it, go down with open fingers, shut them. With it: rise above
    the peg's tip, go above the peg, go down, let go. A ring whose handle is too near to the peg for the fingers is first
    hooked by its hole, with the fingers shut, and dragged away.
    """

    peg: ClassVar[Array]
    """Where the peg stands, (x, y), m."""
    peg_height: ClassVar[float]
    handle_at: ClassVar[float]
    """From the middle of the ring to where its handle is gripped, m."""
    handle_width: ClassVar[float]
    above_handle: ClassVar[float] = 0.0
    """How high the grip should be above the middle of the handle when the fingers shut, m."""
    low_enough: ClassVar[float] = CLOSE
    """How near to that height is near enough, m."""
    lowest: ClassVar[float]
    """The grip does not get lower than this, m."""
    opened: ClassVar[float]
    """Distance of an open finger from the middle, m."""
    spread: ClassVar[float]
    free: ClassVar[float]
    """From the grip to the middle of an open finger; what that needs from the peg's axis, m."""
    step: ClassVar[float]
    twist: ClassVar[float]
    """How far an action of 1 moves the gripper along an axis, m, and turns it, rad."""
    largest_yaw: ClassVar[float]
    """The gripper's yaw is kept within plus or minus this, rad."""

    @abstractmethod
    def look(self, obs: Array) -> Scene:
        """What observations (N, D) float64 show."""

    def act(self, obs: Array) -> Array:
        """Actions (N, 5) float32 for observations (N, D): three steps, a turn, and above 0 "shut"."""
        s = self.look(np.asarray(obs, dtype=np.float64))
        point = s.ring + self.handle_at * s.handle + [0.0, 0.0, self.above_handle]  # where the handle is gripped
        bearing = np.arctan2(s.handle[:, 1], s.handle[:, 0])
        turn = self._turn(s.yaw, bearing)
        between = (s.finger > 0.3 * self.handle_width) & (s.finger < 0.7 * self.handle_width)
        held = between & (np.linalg.norm(point - s.grip, axis=1) < 0.025)
        blocked = ~held & (point[:, 2] < self.peg_height) & self._blocked(point, bearing)

        move, shut = self._fetch(s, point, turn)
        for mask, (other_move, other_shut) in ((blocked, self._drag(s)), (held, self._carry(s))):
            move, shut = np.where(mask[:, None], other_move, move), np.where(mask, other_shut, shut)
        twist = np.where(held, 0.0, turn / self.twist)
        command = np.column_stack([move / self.step, twist, np.where(shut, 1.0, -1.0)])
        return np.clip(command, -1.0, 1.0).astype(np.float32)  # type: ignore[no-any-return]

    def _turn(self, yaw: Array, bearing: Array) -> Array:
        """The smallest turn (N,), rad, after which the fingers close across the handle: either way round will do."""
        turn: Array = (bearing - yaw + np.pi / 2) % np.pi - np.pi / 2
        return np.where(np.abs(yaw + turn) > self.largest_yaw - 0.1, turn - np.sign(yaw + turn) * np.pi, turn)

    def _blocked(self, point: Array, bearing: Array) -> Mask:
        """Whether the peg stands where an open finger must go to grip the handle, (N,)."""
        across = self.spread * np.stack([-np.sin(bearing), np.cos(bearing)], axis=1)
        gaps = [np.linalg.norm(point[:, :2] + side * across - self.peg, axis=1) for side in (1, -1)]
        return np.minimum(*gaps) < self.free  # type: ignore[no-any-return]

    def _approach(self, grip: Array, target: Array, there: Mask, ready: Mask) -> Array:
        """Move (N, 3), m, to a target: over it first, and down to it when `there` (above it) and `ready` (the fingers)."""
        away = target - grip
        height = target[:, 2] + OVER_HANDLE
        beside = np.linalg.norm(grip[:, :2] - self.peg, axis=1) < KEEP_AWAY
        height = np.where(beside, np.maximum(height, self.peg_height + OVER_PEG), height)
        # Low and not there: rise first, or the fingers push the ring about. The fingers open or shut up there as well.
        low = (height - grip[:, 2] > 0.02) & ~(there & ready)
        level = np.where(low[:, None], 0.0, away[:, :2])
        return np.column_stack([level, np.where(there & ready, away[:, 2], height - grip[:, 2])])

    def _fetch(self, s: Scene, point: Array, turn: Array) -> tuple[Array, Mask]:
        """Grip the handle at a point: where to move, (N, 3), m, and whether to shut the fingers, (N,)."""
        there = (np.linalg.norm((point - s.grip)[:, :2], axis=1) < CLOSE) & (np.abs(turn) < STRAIGHT)
        move = self._approach(s.grip, point, there, s.finger > 0.8 * self.opened)
        return move, there & (np.abs(point - s.grip)[:, 2] < self.low_enough)

    def _drag(self, s: Scene) -> tuple[Array, Mask]:
        """Put shut fingers into the hole and move away from the peg: likewise."""
        inside = np.linalg.norm((s.ring - s.grip)[:, :2], axis=1) < 2 * CLOSE
        hooked = inside & (s.grip[:, 2] - s.ring[:, 2] < 3 * CLOSE)
        outward = s.ring[:, :2] - self.peg
        outward = self.step * outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
        pull = np.column_stack([outward, np.minimum(s.ring[:, 2] - s.grip[:, 2], 0.0)])
        approach = self._approach(s.grip, s.ring, inside, s.finger < 0.3 * self.handle_width)
        return np.where(hooked[:, None], pull, approach), np.ones(len(s.ring), dtype=bool)

    def _carry(self, s: Scene) -> tuple[Array, Mask]:
        """Bring the ring to the peg and let go of it there; one that hangs over is put aside instead: likewise."""
        far = np.linalg.norm(s.ring[:, :2] - self.peg, axis=1)
        hangs = np.abs(s.axis[:, 2]) < UPRIGHT
        threaded = (far < 0.012) & (s.ring[:, 2] < self.peg_height)
        down = (threaded | (far < CENTRED)) & ~hangs
        height = self.peg_height + OVER_PEG - s.ring[:, 2]
        low = ~down & (height > 0.015)
        away = self.peg + np.where(hangs[:, None], ASIDE, 0.0) - s.ring[:, :2]
        move = np.column_stack([np.where(low[:, None], 0.0, away), np.where(down, DOWN - 0.01 - s.ring[:, 2], height)])
        lowest = (s.ring[:, 2] < DOWN) | (s.grip[:, 2] < self.lowest + CLOSE)
        let_go = np.where(hangs, far > 0.8 * abs(ASIDE[0]), lowest & (far < 2 * CENTRED))
        return move, ~let_go
