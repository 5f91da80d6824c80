"""What all tests share: one thread, and random examples that are the same in every run."""

from __future__ import annotations

import os

import pytest
import torch
from hypothesis import settings

from tutelage.errors import TutelageError

torch.set_num_threads(1)
settings.register_profile("tutelage", derandomize=True, deadline=None, database=None, max_examples=60)
settings.load_profile("tutelage")


@pytest.fixture
def opengl() -> None:
    """Skips a test where no picture can be drawn; in CI that is a failure."""
    from tutelage.envs.mujoco_fleet import MujocoFleet

    fleet = MujocoFleet("CableRouting", 1, threads=1)
    try:
        fleet.images()
    except TutelageError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    finally:
        fleet.close()
