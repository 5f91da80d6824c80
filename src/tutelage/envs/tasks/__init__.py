"""The built-in tasks."""

from tutelage.envs.tasks.allegro_hand import AllegroHand
from tutelage.envs.tasks.ant import Ant
from tutelage.envs.tasks.anymal import Anymal
from tutelage.envs.tasks.ball_balance import BallBalance
from tutelage.envs.tasks.base import ArrayTask, GoalTask, MujocoTask, Task
from tutelage.envs.tasks.block_pushing import BlockPushing, ObstaclePushing
from tutelage.envs.tasks.cable_routing import CableRouting
from tutelage.envs.tasks.franka_cube_stack import FrankaCubeStack
from tutelage.envs.tasks.half_cheetah import HalfCheetah
from tutelage.envs.tasks.humanoid import Humanoid
from tutelage.envs.tasks.navigation import Navigation
from tutelage.envs.tasks.peg_insertion import PegInsertion
from tutelage.envs.tasks.walker2d import Walker2d

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        HalfCheetah,
        Walker2d,
        Ant,
        Humanoid,
        Anymal,
        PegInsertion,
        CableRouting,
        Navigation,
        BlockPushing,
        ObstaclePushing,
        BallBalance,
        FrankaCubeStack,
        AllegroHand,
    )
}
MUJOCO: dict[str, type[MujocoTask]] = {name: task for name, task in TASKS.items() if issubclass(task, MujocoTask)}
"""Those that run on the batched MuJoCo engine."""

__all__ = ["MUJOCO", "TASKS", "ArrayTask", "GoalTask", "MujocoTask", "Task", *(task.__name__ for task in TASKS.values())]
