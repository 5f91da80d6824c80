"""What a task declares; its fleet does the rest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tutelage.envs.task_fleet import TaskFleet

Array = NDArray[Any]
Frame = dict[str, Array]

GYMNASIUM = Path(str(files("gymnasium"))) / "envs" / "mujoco" / "assets"
"""The MJCF files that Gymnasium ships."""


class Task(ABC):
    """One task, vectorised over robots, whatever simulates it."""

    name: ClassVar[str]
    horizon: ClassVar[int] = 1000
    goal: ClassVar[bool] = False
    """Whether success means reaching a goal state; else it is an episode without violation and with the return asked for."""
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
    action_low: ClassVar[Array | None] = None
    action_high: ClassVar[Array | None] = None
    """(A,) bounds of the actions; None, for a MuJoCo task: those of the actuators. Set them together with `control`."""
    summary: ClassVar[str]

    @staticmethod
    @abstractmethod
    def fleet_type() -> type[TaskFleet]:
        """The fleet that runs such tasks. Imported here, so that what one simulator needs is no burden on the others."""


@dataclass(frozen=True)
class World:
    """What the level of disturbance does to the robots of an `ArrayTask` in a timestep.

    Attributes:
        noise: (N, `noise_size`) standard normal numbers, times the level's noise.
        friction: (N,) what to scale friction by.
        wind: the level's.
    """

    noise: Array
    friction: Array
    wind: float


@dataclass(frozen=True)
class View:
    """The part of a task's plane that pictures of any shape show: whole, in their middle, as large as it fits.

    Attributes:
        x, y: its middle, in the plane's unit. +x is to the right in the picture, +y is up.
        width, height: its sides, in the plane's unit.
    """

    x: float
    y: float
    width: float
    height: float

    def scale(self, width: int, height: int) -> float:
        """Pixels for a unit of the plane, along x as along y, in a picture of so many pixels."""
        return min(width / self.width, height / self.height)

    def points(self, width: int, height: int) -> tuple[Array, Array]:
        """Where a picture's pixels are on the plane: the x of its columns (width,), the y of its rows (height,)."""
        scale = self.scale(width, height)
        x = self.x + (np.arange(width) + 0.5 - width / 2) / scale
        return x, self.y - (np.arange(height) + 0.5 - height / 2) / scale


class ArrayTask(Task):
    """A task with a goal whose physics is written as array operations. Stateless: everything is in the state (N, S) float64.

    Of a level of disturbance it knows what is in `World`; pushes and masses mean nothing to it.
    """

    goal = True
    dt: ClassVar[float]
    """Seconds of a timestep."""
    noise_size: ClassVar[int]
    """How many random numbers a robot's timestep needs."""

    @staticmethod
    def fleet_type() -> type[TaskFleet]:
        from tutelage.envs.array_fleet import ArrayFleet

        return ArrayFleet

    @abstractmethod
    def initial(self, rng: np.random.Generator, n: int) -> Array:
        """Draw n initial states, (n, S)."""

    def onward(self, rng: np.random.Generator, state: Array) -> Array:
        """Initial states for robots that completed the task in the states (n, S): by default any others."""
        return self.initial(rng, len(state))

    @abstractmethod
    def advance(self, state: Array, actions: Array, world: World) -> Array:
        """The states (N, S) one timestep after the states (N, S), for actions (N, A). A new array."""

    @abstractmethod
    def observe(self, state: Array) -> Array:
        """(N, D) float64."""

    @abstractmethod
    def violation(self, state: Array) -> NDArray[np.bool_]:
        """The constraint c(s), (N,)."""

    @abstractmethod
    def success(self, state: Array) -> NDArray[np.bool_]:
        """Whether each robot is in the goal set, (N,)."""

    @abstractmethod
    def draw(self, state: Array, width: int, height: int) -> NDArray[np.uint8]:
        """What the robots in the states (n, S) look like from above, (n, height, width, 3)."""


class MujocoTask(Task):
    """One task on the batched engine, vectorised over robots. Stateless: everything is in the frame.

    A frame maps the name of each `mjData` field in `fields` to its values for all robots, (N, *field shape).
    """

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

    @staticmethod
    def fleet_type() -> type[TaskFleet]:
        from tutelage.envs.mujoco_fleet import MujocoFleet

        return MujocoFleet

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

    goal = True
    goes_on: ClassVar[bool] = False
    """Whether a robot that reached its goal gets the next one where it is (`onward`), instead of an initial state."""

    @abstractmethod
    def success(self, frame: Frame) -> NDArray[np.bool_]:
        """Whether each robot is in the goal set, (N,)."""

    def onward(self, rng: np.random.Generator, qpos: Array) -> Array:
        """Of a task that goes on: qpos (n, nq) with new goals for robots that completed it in the states qpos (n, nq)."""
        raise NotImplementedError

    def forward(self, frame: Frame, body_mass: Array) -> Array:
        """Nothing travels."""
        return np.zeros(len(body_mass))

    def reward(self, frame: Frame, velocity: Array, actions: Array) -> Array:
        """1 on reaching the goal, 0 before."""
        return self.success(frame).astype(np.float64)
