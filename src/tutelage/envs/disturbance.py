"""Disturbances: what makes the real world harder than the nominal model. Part of a task, seeded, at a named level.

They decide whether help is needed at all: see `tutelage.experiments.levels`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError


@dataclass(frozen=True)
class Disturbance:
    """How hard the world pushes back.

    Attributes:
        noise: standard deviation of Gaussian noise on each actuator command, as a fraction of half its range.
        push: force of a push on the torso in random horizontal direction, in body weights.
        push_seconds: how long a push lasts.
        push_interval: mean time between the starts of two pushes of a robot, seconds (memoryless).
        mass: each robot's masses are scaled by one number in [1 - mass, 1 + mass], drawn at each seeded reset.
        friction: likewise for sliding friction.
        wind: how far the wind carries a robot in a timestep where the task has a windy place, in the task's unit of length.
    """

    noise: float = 0.0
    push: float = 0.0
    push_seconds: float = 0.1
    push_interval: float = 2.0
    mass: float = 0.0
    friction: float = 0.0
    wind: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not np.isfinite(value) or value < 0:
                raise ConfigError(f"disturbance {name} must be a number >= 0, got {value}")
        if self.push and not (self.push_seconds and self.push_interval):
            raise ConfigError("pushes need push_seconds > 0 and push_interval > 0")
        if self.mass >= 1 or self.friction >= 1:
            raise ConfigError("disturbance mass and friction must be below 1")


LEVELS: dict[str, Disturbance] = {
    "none": Disturbance(),
    "mild": Disturbance(noise=0.1, push=0.1, mass=0.02, friction=0.1),
    "light": Disturbance(noise=0.15, push=0.15, mass=0.03, friction=0.15),
    "moderate": Disturbance(noise=0.2, push=0.2, mass=0.04, friction=0.2),
    "strong": Disturbance(noise=0.3, push=0.3, mass=0.06, friction=0.3),
    "severe": Disturbance(noise=0.4, push=0.4, mass=0.08, friction=0.4),
    "extreme": Disturbance(noise=0.5, push=0.5, mass=0.1, friction=0.5),
}


def parse(level: str) -> Disturbance:
    """The disturbance of a named level, or of a list such as "noise=0.3,push=0.5".

    Raises:
        ConfigError: unknown level or parameter, or a value that is no number.
    """
    if level in LEVELS:
        return LEVELS[level]
    known = [f.name for f in fields(Disturbance)]
    values: dict[str, float] = {}
    for part in level.split(","):
        name, _, value = part.partition("=")
        try:
            if name.strip() not in known:
                raise ValueError
            values[name.strip()] = float(value)
        except ValueError:
            raise ConfigError(
                f"unknown disturbance {part!r}; use one of {', '.join(LEVELS)}, or name=value with names {', '.join(known)}"
            ) from None
    return Disturbance(**values)


class Pusher:
    """Draws the pushes of a fleet: memoryless starts, random horizontal direction, constant force for `push_seconds`.

    Args:
        level: the disturbance.
        weight: force of one body weight, N.
        dt: seconds of a timestep.
        planar: push along x only (for models that live in a plane).
    """

    def __init__(self, level: Disturbance, weight: float, dt: float, num_robots: int, planar: bool) -> None:
        self._force = level.push * weight
        self._steps = max(1, round(level.push_seconds / dt))
        self._rate = min(1.0, dt / level.push_interval) if level.push else 0.0
        self._planar = planar
        self.left = np.zeros(num_robots, dtype=np.int64)
        self.wrench = np.zeros((num_robots, 6))

    def step(self, rng: np.random.Generator, moving: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Force (N) and torque (N m) on each robot during this timestep, (N, 6); time passes for `moving` robots only."""
        n = len(self.left)
        start = (rng.random(n) < self._rate) & moving
        angle = rng.random(n) * 2 * np.pi
        x, y = np.cos(angle), np.sin(angle)
        if self._planar:
            x, y = np.where(x >= 0, 1.0, -1.0), np.zeros(n)
        self.left = np.where(start, self._steps, np.maximum(self.left - moving, 0))
        self.wrench[start, 0], self.wrench[start, 1] = self._force * x[start], self._force * y[start]
        self.wrench[self.left == 0] = 0.0
        return self.wrench

    def calm(self, robots: NDArray[np.bool_]) -> None:
        """End the pushes on these robots (they were reset)."""
        self.left[robots], self.wrench[robots] = 0, 0.0
