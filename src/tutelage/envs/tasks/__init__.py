"""The tasks of the batched MuJoCo engine."""

from tutelage.envs.tasks.ant import Ant
from tutelage.envs.tasks.anymal import Anymal
from tutelage.envs.tasks.base import GoalTask, MujocoTask
from tutelage.envs.tasks.cable_routing import CableRouting
from tutelage.envs.tasks.half_cheetah import HalfCheetah
from tutelage.envs.tasks.humanoid import Humanoid
from tutelage.envs.tasks.peg_insertion import PegInsertion
from tutelage.envs.tasks.walker2d import Walker2d

TASKS: dict[str, type[MujocoTask]] = {
    task.name: task for task in (HalfCheetah, Walker2d, Ant, Humanoid, Anymal, PegInsertion, CableRouting)
}

__all__ = [
    "TASKS",
    "Ant",
    "Anymal",
    "CableRouting",
    "GoalTask",
    "HalfCheetah",
    "Humanoid",
    "MujocoTask",
    "PegInsertion",
    "Walker2d",
]
