"""The algorithmic human for Anymal: a trot, computed from what the robot observes and from nothing else."""

from __future__ import annotations

import numpy as np

from tutelage.envs.tasks.anymal import ACTION, SCALE, STANDING, STIFFNESS
from tutelage.envs.tasks.base import Array

CYCLE = 14
"""Timesteps of 0.02 s in which each foot is once on the ground and once in the air, half of the time each."""
HEIGHT, CLEARANCE, WIDTH = 0.5, 0.085, 0.23
"""Of the hips above the middle of the feet, of a foot in the air, and from a hip's axis out to its foot, m."""
GAIN = np.array([2.0, 1.2, 2.0])
"""How much further (forward, sideways, turning) the feet sweep than on rigid legs: theirs give way."""
FEEDBACK, SHIFT = 0.8, 0.12
"""What an error of the velocity adds to the sweep (1), and how far it shifts the feet the way that the base drifts (s)."""
LOAD, RAMP, DAMPING, LEVEL = 100.0, 0.12, 45.0, 0.2
"""Force that a foot on the ground bears, N, reached and left within this part of its stance; how much less while its hip
rises, N s/m; how far its leg gives way, per metre that its hip is low, where the base leans over."""
FRAME = 0.02
"""Seconds of a timestep."""

_PHASES = np.arange(CYCLE) / CYCLE
_FORE, _SIDE = np.array([1.0, -1.0, 1.0, -1.0]), np.array([1.0, 1.0, -1.0, -1.0])  # LF, LH, RF, RH
_HIP_X, _HIP_Y, _THIGH_X = 0.2999, 0.104, 0.0599
_OUT = 0.08381 + 0.1003 + 0.01305
"""From a hip's axis to the plane in which thigh and shank move, m."""
_THIGH, _SHANK, _HEEL = 0.285, float(np.hypot(0.08795, 0.31547)), float(np.arctan2(0.08795, 0.31547))
"""Lengths, m, and the angle at which the foot stands off the shank, rad."""

FEET = np.stack([(_HIP_X + _THIGH_X) * _FORE, (_HIP_Y + WIDTH) * _SIDE], axis=1)
"""(4, 2) where the feet are in the middle of a stance, as the base sees them, m."""
_LEVER = np.stack([-FEET[:, 1], FEET[:, 0]], axis=1)
"""(4, 2) their velocities when the base turns with 1 rad/s."""
_LEG_PHASES = (_PHASES[:, None] + np.array([0.0, 0.5, 0.5, 0.0])) % 1.0
_DOWN = _LEG_PHASES < 0.5
_PART = 2 * (_LEG_PHASES % 0.5)
"""(K, 4) which feet are on the ground at each phase of the trot, and how much of its stance or swing each has behind it."""
_SWEEP = np.where(_DOWN, 1 - 2 * _PART, -np.cos(np.pi * _PART))
_LIFT = np.where(_DOWN, 0.0, CLEARANCE * np.sin(np.pi * _PART))
_BEARS = np.where(_DOWN, (np.minimum(_PART, 1 - _PART) / RAMP).clip(0, 1), 0.0)


class Trotter:
    """Diagonal legs step together; feet on the ground sweep back as fast as the base is to go forward.

    It keeps no memory, so it can take over in any state. The phase of its gait is in the previous action, a part of an
    observation: it computes what it would do now at each of K = `CYCLE` phases, takes the one nearest to the previous action
    for where the robot is, and does what comes next. A policy that walks otherwise is thus caught in mid-stride.
    """

    def act(self, obs: Array) -> Array:
        """Actions (N, 12) float32 for observations (N, 48)."""
        state = np.asarray(obs, dtype=np.float64) / SCALE
        choices = _choices(state[:, 0:3], state[:, 3:6], state[:, 6:9], state[:, 9:12])
        now = np.square(choices - state[:, None, 36:48]).sum(axis=2).argmin(axis=1)
        return choices[np.arange(len(state)), (now + 1) % CYCLE].astype(np.float32)  # type: ignore[no-any-return]


def _choices(velocity: Array, spin: Array, gravity: Array, command: Array) -> Array:
    """What to do at each phase, (N, K, 12), given velocity, angular velocity, direction of gravity and commands, (N, 3)."""
    error = np.column_stack([velocity[:, :2], spin[:, 2]]) - command
    reach = _at_feet(GAIN * command - FEEDBACK * error) * (CYCLE * FRAME / 4)  # half of the way of a foot on the ground
    plane = _SWEEP[:, :, None] * reach[:, None] + _at_feet(SHIFT * error)[:, None]  # (N, K, 4, 2)
    low = gravity[:, :1] * FEET[:, 0] + gravity[:, 1:2] * FEET[:, 1]
    rising = spin[:, :1] * FEET[:, 1] - spin[:, 1:2] * FEET[:, 0]
    z = _LIFT - HEIGHT + LEVEL * low[:, None]
    load = _BEARS * (LOAD - DAMPING * rising[:, None])
    angles, torques = leg(plane[..., 0], plane[..., 1] + WIDTH * _SIDE, z, load)
    targets = (angles + torques / STIFFNESS).reshape(len(error), CYCLE, 12)
    return ((targets - STANDING) / ACTION).clip(-1, 1)  # type: ignore[no-any-return]


def _at_feet(twist: Array) -> Array:
    """Velocities of the feet, (N, 4, 2), of a base that moves so (N, 3: forward, sideways, turn)."""
    return np.asarray(twist[:, None, :2] + twist[:, 2, None, None] * _LEVER)


def leg(x: Array, y: Array, z: Array, load: Array) -> tuple[Array, Array]:
    """Joint angles that put a foot at x (from the thigh's axis), y and z (from the hip's), m, and the torques that bear a
    vertical load (N) there, as if the leg did not lean sideways; both (..., 4, 3). A foot that is too far away is put as far
    as the leg reaches."""
    out = _OUT * _SIDE
    down = -np.sqrt(np.maximum(y**2 + z**2 - out**2, 0.04))
    abduction = np.arctan2(z, y) - np.arctan2(down, out)
    abduction = (abduction + np.pi) % (2 * np.pi) - np.pi
    cosine = (x**2 + down**2 - _THIGH**2 - _SHANK**2) / (2 * _THIGH * _SHANK)
    bend = -_FORE * np.arccos(cosine.clip(-1, 1))  # knees point to the middle of the robot
    thigh = np.arctan2(-x, -down) - np.arctan2(_SHANK * np.sin(bend), _THIGH + _SHANK * np.cos(bend))
    knee_x = -_THIGH * np.sin(thigh)
    angles = np.stack([abduction, thigh, bend + _FORE * _HEEL], axis=-1)
    return angles, np.stack([-y * load, x * load, (x - knee_x) * load], axis=-1)
