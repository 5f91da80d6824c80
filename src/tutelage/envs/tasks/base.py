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


class MujocoTask(ABC):
    """One task on the batched engine, vectorised over robots. Stateless: everything is in the frame.

    A frame maps the name of each `mjData` field in `fields` to its values for all robots, (N, *field shape).
    """

    name: ClassVar[str]
    xml: ClassVar[str]
    frame_skip: ClassVar[int]
    fields: ClassVar[tuple[str, ...]] = ("qpos", "qvel")
    contact_forces: ClassVar[bool] = False
    planar: ClassVar[bool] = False
    push_body: ClassVar[str | int] = 1
    horizon: ClassVar[int] = 1000
    disturbance: ClassVar[str] = "none"
    """The level at which the task is benchmarked (fixed by the rule in docs/tasks.md)."""
    offline_pairs: ClassVar[int] = 5000
    """State-action pairs of the human before a run (fixed by the same rule)."""
    initial_period: ClassVar[int] = 250
    """t_I of C.U.R., timesteps (table C.1)."""
    expert_features: ClassVar[int | None] = None
    """The expert sees only the first so many numbers of an observation; None: all."""
    symmetry: ClassVar[tuple[Array, Array] | None] = None
    summary: ClassVar[str]

    @property
    def xml_path(self) -> Path:
        """The MJCF file; Gymnasium ships those of its tasks."""
        return Path(str(files("gymnasium"))) / "envs" / "mujoco" / "assets" / self.xml

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
