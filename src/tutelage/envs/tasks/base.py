"""What a MuJoCo task declares; the engine does the rest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Frame = dict[str, Array]

GYMNASIUM = Path(str(files("gymnasium"))) / "envs" / "mujoco" / "assets"
"""The MJCF files that Gymnasium ships."""


class MujocoTask(ABC):
    """One task on the batched engine, vectorised over robots. Stateless: everything is in the frame.

    A frame maps the name of each `mjData` field in `fields` to its values for all robots, (N, *field shape).
    """

    name: ClassVar[str]
    xml: ClassVar[str]
    assets: ClassVar[Path] = GYMNASIUM
    """The folder of `xml`."""
    frame_skip: ClassVar[int]
    fields: ClassVar[tuple[str, ...]] = ("qpos", "qvel")
    contact_forces: ClassVar[bool] = False
    planar: ClassVar[bool] = False
    push_body: ClassVar[str | int] = 1
    """What pushes act on; a body weight is the weight of all that hangs together with it."""
    camera: ClassVar[str | None] = None
    """Name of a camera of the model for pictures; None: one that follows `push_body`."""
    horizon: ClassVar[int] = 1000
    disturbance: ClassVar[str] = "none"
    """The level at which the task is benchmarked (fixed by the rule in docs/tasks.md)."""
    offline_pairs: ClassVar[int] = 5000
    """State-action pairs of the human before a run (fixed by the same rule)."""
    initial_period: ClassVar[int] = 250
    """t_I of C.U.R., timesteps (table C.1)."""
    expert: ClassVar[str | None] = None
    """The algorithmic human, where it is a program: "module:callable" of a policy. None: trained weights."""
    expert_features: ClassVar[int | None] = None
    """The expert sees only the first so many numbers of an observation; None: all."""
    symmetry: ClassVar[tuple[Array, Array] | None] = None
    action_low: ClassVar[Array | None] = None
    action_high: ClassVar[Array | None] = None
    """(A,) bounds of the actions; None: those of the actuators. Set them together with `control`."""
    summary: ClassVar[str]

    @property
    def xml_path(self) -> Path:
        """The MJCF file."""
        return self.assets / self.xml

    def control(self, frame: Frame, actions: Array) -> Array:
        """Actuator commands (N, nu) from the frame before the step and the actions (N, A): by default the same thing.

        Rows of robots that are not to move are computed too, for actions that are 0, and not used.
        """
        return actions

    @abstractmethod
    def observe(self, frame: Frame) -> Array:
        """(N, D) float64."""

    @abstractmethod
    def forward(self, frame: Frame, body_mass: Array) -> Array:
        """Position along the direction of travel, m, (N,). Forward velocity is its difference over dt."""

    @abstractmethod
    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        """(N,) from the frame after the step, the forward velocity (m/s) and the actions as commanded."""

    @abstractmethod
    def violation(self, frame: Frame) -> NDArray[np.bool_]:
        """The constraint c(s): whether each robot has fallen, (N,)."""

    @abstractmethod
    def initial(self, rng: np.random.Generator, n: int, qpos0: Array, qvel0: Array) -> tuple[Array, Array]:
        """Draw n initial states: qpos (n, nq), qvel (n, nv)."""


class GoalTask(MujocoTask):
    """A task that is complete as soon as the robot reaches a goal state, where its episode ends."""

    @abstractmethod
    def success(self, frame: Frame) -> NDArray[np.bool_]:
        """Whether each robot is in the goal set, (N,)."""

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        """Nothing travels."""
        return np.zeros(len(body_mass))

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        """1 on reaching the goal, 0 before."""
        return self.success(frame).astype(np.float64)
