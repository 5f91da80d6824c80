"""Robots of MuJoCo Playground on EnvPool's C++ physics, as fleets by name: two quadrupeds, a hand and an arm.

Observations, actions, rewards and where an episode ends are EnvPool's own; what counts as a violation and as a success is
said here, for EnvPool knows neither. They have no expert, and cannot be checkpointed: they run in a `Loop` of yours.
"""

from __future__ import annotations

from typing import Any

from tutelage.envs.adapter import Outcome
from tutelage.envs.envpool_fleet import Array, EnvPoolFleet

TRACKED = 0.5
"""A quadruped that gets this part of the largest reward for following its commands, costs taken off, has done its task."""


def _ended(outcome: Outcome) -> Array:
    """EnvPool ends an episode early where a robot lies on its back, or has dropped what it held, or its physics diverged."""
    return outcome.terminated


class _Quadruped(EnvPoolFleet):
    """A quadruped that follows velocity commands; see `EnvPoolFleet` for the arguments.

    Violation: it has fallen over. Success: the horizon is reached with a return of `success_return` or more.

    Args:
        success_return: default: `TRACKED` of the largest return for following commands, from the task's own scales.
    """

    task_id: str

    def __init__(
        self, num_envs: int, *, success_return: float | None = None, threads: int | None = None, **kwargs: Any
    ) -> None:
        super().__init__(
            self.task_id, num_envs, violation=_ended, success=self._followed, observe="state", threads=threads, **kwargs
        )
        settings = self.settings
        scales = settings["tracking_lin_vel_scale"] + settings["tracking_ang_vel_scale"]
        best = scales * settings["ctrl_dt"] * self.horizon
        self.success_return = TRACKED * best if success_return is None else success_return

    def _followed(self, outcome: Outcome) -> Array:
        return outcome.truncated & ~outcome.terminated & (outcome.episode_return >= self.success_return)


class Go1Joystick(_Quadruped):
    """Unitree Go1 on flat ground, 48 observations and 12 actions, episodes of 20 s."""

    task_id = "Go1JoystickFlatTerrain-v1"


class SpotJoystick(_Quadruped):
    """Boston Dynamics Spot on flat ground, 81 observations and 12 actions, episodes of 20 s."""

    task_id = "SpotFlatTerrainJoystick-v1"


class LeapCubeReorient(EnvPoolFleet):
    """A LEAP hand that turns a cube to a goal orientation, 57 observations and 16 actions; see `EnvPoolFleet`.

    Violation: the cube is dropped. Success: the goal is reached, which ends the episode.
    """

    goal_conditioned = True

    def __init__(self, num_envs: int, *, threads: int | None = None, **kwargs: Any) -> None:
        super().__init__(
            "LeapCubeReorient-v1", num_envs, violation=_ended, success=lambda o: o.info["success"] > 0,
            observe="state", threads=threads, **kwargs,
        )  # fmt: skip


class PandaPickCube(EnvPoolFleet):
    """A Franka Panda that lifts a cube to a target, 66 observations and 8 actions; see `EnvPoolFleet`.

    Violation: the cube is out of bounds. Success: the cube is at its target, which ends the episode.
    """

    goal_conditioned = True

    def __init__(self, num_envs: int, *, threads: int | None = None, **kwargs: Any) -> None:
        super().__init__(
            "PandaPickCube-v1", num_envs, violation=lambda o: o.info["out_of_bounds"] > 0,
            success=lambda o: o.info["reward_success"] > 0, threads=threads, **kwargs,
        )  # fmt: skip
