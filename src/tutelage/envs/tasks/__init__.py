"""The tasks of the batched MuJoCo engine."""

from tutelage.envs.tasks.ant import Ant
from tutelage.envs.tasks.base import MujocoTask
from tutelage.envs.tasks.half_cheetah import HalfCheetah
from tutelage.envs.tasks.humanoid import Humanoid
from tutelage.envs.tasks.walker2d import Walker2d

TASKS: dict[str, type[MujocoTask]] = {task.name: task for task in (HalfCheetah, Walker2d, Ant, Humanoid)}

__all__ = ["TASKS", "Ant", "HalfCheetah", "Humanoid", "MujocoTask", "Walker2d"]
