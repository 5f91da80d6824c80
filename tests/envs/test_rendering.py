"""Pictures: the robot is in them, whole and in the middle, wherever it went; and good advice where there is no OpenGL."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tutelage.envs import rendering
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.rendering import Renderer, gl_backend
from tutelage.envs.tasks import MUJOCO
from tutelage.errors import ConfigError, TutelageError


@pytest.fixture
def fleet_of() -> Iterator[Callable[[str], MujocoFleet]]:
    fleets: list[MujocoFleet] = []

    def make(name: str) -> MujocoFleet:
        fleets.append(MujocoFleet(name, 2, disturbance="none", threads=1, render_mode="rgb_array"))
        fleets[-1].reset(seed=0)
        try:
            fleets[-1].render_robot(0, 8, 8)
        except TutelageError as error:
            if os.environ.get("CI"):
                raise
            pytest.skip(str(error))
        return fleets[-1]

    yield make
    for fleet in fleets:
        fleet.close()


def robot_pixels(picture: Any) -> Any:
    """(H, W) bool: skin is warm, floor and sky are grey, green or blue."""
    return picture[..., 0].astype(int) > picture[..., 2].astype(int) + 20


@pytest.mark.render
@pytest.mark.parametrize("size", [(320, 240), (100, 100), (90, 160)])
@pytest.mark.parametrize("name", [name for name, task in MUJOCO.items() if task.camera is None])
def test_the_robot_is_in_the_picture_wherever_it_went(fleet_of: Any, name: str, size: tuple[int, int]) -> None:
    fleet = fleet_of(name)
    width, height = size
    for distance in (0.0, 50.0):
        data = fleet.physics.datas[0]
        fleet.reset(seed=0)
        data.qpos[0] += distance
        fleet.step(np.zeros(fleet.action_space.shape or ()))
        picture = fleet.render_robot(0, width, height)
        assert picture.shape == (height, width, 3)
        assert picture.dtype == np.uint8
        body = robot_pixels(picture)
        rows, columns = np.nonzero(body)
        assert 0.002 < body.mean() < 0.4
        assert min(rows.min(), columns.min()) > 0, "cut off"
        assert rows.max() < height - 1, "cut off"
        assert columns.max() < width - 1, "cut off"
        assert max(np.ptp(rows), np.ptp(columns)) > 0.25 * min(size), "too small"
        assert abs(columns.mean() - width / 2) < 0.15 * width


@pytest.mark.render
def test_robots_have_their_own_pictures(fleet_of: Any) -> None:
    fleet = fleet_of("Walker2d")
    rng = np.random.default_rng(0)
    for _ in range(20):
        fleet.step(rng.uniform(-1, 1, (2, 6)))
    pictures = fleet.render()
    assert len(pictures) == 2
    assert not np.array_equal(*pictures)
    assert np.array_equal(pictures[0], fleet.render_robot(0)), "a picture does not depend on those before it"


@pytest.mark.render
def test_rendering_leaves_the_model_and_the_simulation_alone(fleet_of: Any) -> None:
    fleet = fleet_of("Ant")
    state, quality = fleet.physics.get_state(), fleet.physics.model.vis.quality.offsamples
    fleet.render_robot(0, 1000, 700)
    assert np.array_equal(fleet.physics.get_state(), state)
    assert fleet.physics.model.vis.quality.offsamples == quality > 0


@pytest.mark.render
def test_a_closed_renderer_says_so_and_closes_once(fleet_of: Any) -> None:
    fleet = fleet_of("Ant")
    renderer = Renderer(fleet.physics.model, 20, 20)
    renderer.close()
    renderer.close()
    with pytest.raises(TutelageError, match="closed"):
        renderer.picture(fleet.physics.datas[0])
    with pytest.raises(ConfigError, match="1 x 1"):
        Renderer(fleet.physics.model, 0, 20)


@pytest.mark.skipif(rendering.sys.platform != "linux", reason="other systems bring OpenGL")
def test_without_opengl_the_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(rendering.ctypes.util, "find_library", lambda name: None)
    with pytest.raises(TutelageError, match="apt-get install libegl1 libgl1-mesa-dri libosmesa6"):
        gl_backend()


@pytest.mark.skipif(rendering.sys.platform != "linux", reason="EGL is for Linux")
def test_a_backend_that_does_not_work_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(width: int, height: int) -> None:
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    egl = type(os)("mujoco.egl")
    egl.GLContext = broken  # type: ignore[attr-defined]
    monkeypatch.setitem(rendering.sys.modules, "mujoco.egl", egl)
    with pytest.raises(TutelageError, match=r"egl does not work here \('NoneType'.*apt-get install libegl1"):
        rendering._context(8, 8)


def test_the_users_choice_of_backend_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "OSMesa")
    assert gl_backend() == "osmesa"
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(TutelageError, match="MUJOCO_GL=off"):
        gl_backend()
