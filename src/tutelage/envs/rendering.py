"""Pictures of robots without a window: a camera that follows, and settings that are fast on a CPU."""

from __future__ import annotations

import atexit
import contextlib
import ctypes.util
import math
import os
import sys
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, MissingExtraError, TutelageError

try:
    import mujoco
except ImportError as error:  # pragma: no cover - exercised in an environment without the extra
    raise MissingExtraError(error.name or "mujoco", "mujoco") from error

_AZIMUTH, _ELEVATION = 90.0, -15.0  # degrees: from the side, with forward (x) to the right, and a little from above
_MARGIN = 1.3  # of the robot's own radius
_SMALL = 128
"""Pictures of at most so many pixels a side show no corners: round things are drawn with few, four times as fast."""


def gl_backend() -> str:
    """The OpenGL backend that pictures are drawn with: `MUJOCO_GL` if set, else a window system, EGL or OSMesa.

    Raises:
        TutelageError: this machine has none of them.
    """
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wish in ("disable", "disabled", "off", "false", "0"):
        raise TutelageError(f"rendering is switched off by MUJOCO_GL={wish}; unset it to make pictures")
    if wish in ("egl", "osmesa"):
        return wish
    # A display that is set may still be of no use (a forwarded one without GLX), so EGL goes first on Linux.
    if sys.platform != "linux":
        return "native"
    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return name
    if os.environ.get("DISPLAY"):
        return "native"
    raise TutelageError(_advice("neither EGL nor OSMesa is installed"))


def _advice(reason: str) -> str:
    return (
        f"cannot draw pictures: {reason}; on Debian or Ubuntu run: "
        "apt-get install libegl1 libgl1-mesa-dri libosmesa6, and if EGL still fails set MUJOCO_GL=osmesa"
    )


def _context(width: int, height: int) -> Any:
    """A current OpenGL context.

    mujoco itself chooses when it is imported, from `MUJOCO_GL` alone, and its import fails on a machine without the
    library that the variable names. Choosing here, late, keeps simulation free of OpenGL.
    """
    backend = gl_backend()
    try:
        if backend == "egl":
            from mujoco.egl import GLContext
        elif backend == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.gl_context import GLContext
        context = GLContext(width, height)
        context.make_current()
        # At exit contexts must be freed before the display, whose own exit handler was registered just now.
        atexit.unregister(_close_all)
        atexit.register(_close_all)
    except Exception as error:  # PyOpenGL raises AttributeError, ImportError, GLError, ... for the same cause
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise TutelageError(_advice(f"{backend} does not work here ({reason[0].split('. ')[0]})")) from error
    return context


_open: weakref.WeakSet[Renderer] = weakref.WeakSet()


def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()


class Renderer:
    """Draws robots of one model, from the side, following the torso, or from a camera of the model.

    One renderer serves all robots that share a model, from one thread at a time and never during a step. The camera
    follows horizontally only, so that a fall is seen as one.

    Args:
        model: the `mjModel`.
        width, height: of the pictures, pixels.
        body: index of the body to follow.
        camera: name of a camera of the model to use instead.
    """

    def __init__(self, model: Any, width: int, height: int, body: int = 1, camera: str | None = None) -> None:
        if width < 1 or height < 1:
            raise ConfigError(f"a picture needs at least 1 x 1 pixels, got {width} x {height}")
        self._model, self._body = model, body
        gl = _context(width, height)
        with _quick(model, width, height):
            self._target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._target)
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), dtype=np.uint8)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth, self._camera.elevation = _AZIMUTH, _ELEVATION
        if camera is not None:
            self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
        self._gl = gl
        _open.add(self)
        self._offset, radius = _extent(model, body)
        half = math.radians(float(model.vis.global_.fovy)) / 2
        narrow = math.atan(math.tan(half) * min(1.0, width / height))
        self._camera.distance = _MARGIN * radius / math.sin(narrow)

    def picture(self, data: Any) -> NDArray[np.uint8]:
        """The robot as it is in the `mjData`: (height, width, 3) uint8."""
        if self._gl is None:
            raise TutelageError("this renderer is closed; make another one")
        self._gl.make_current()
        torso = data.xpos[self._body]
        self._camera.lookat[:] = torso[0] + self._offset[0], torso[1] + self._offset[1], self._offset[2]
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._camera, everything, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, self._target)
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._target)
        return self._pixels[::-1].copy()  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._gl is not None:
            self._gl.make_current()
            self._target.free()
            self._gl.free()
            self._gl = None

    def __del__(self) -> None:
        if getattr(self, "_gl", None) is not None:
            self.close()


@contextlib.contextmanager
def _quick(model: Any, width: int, height: int) -> Iterator[None]:
    """Within it, an OpenGL context made for the model has the right size, no multisampling and a tiny shadow map.

    The settings are part of the model, which is not ours: they are put back.
    """
    size, quality = model.vis.global_, model.vis.quality
    wanted = [(size, "offwidth", width), (size, "offheight", height), (quality, "shadowsize", 0), (quality, "offsamples", 0)]
    if max(width, height) <= _SMALL:
        wanted += [(quality, "numslices", 12), (quality, "numstacks", 6), (quality, "numquads", 2)]
    before = [(part, name, getattr(part, name)) for part, name, _ in wanted]
    try:
        for part, name, value in wanted:
            setattr(part, name, value)
        yield
    finally:
        for part, name, value in before:
            setattr(part, name, value)


def _extent(model: Any, body: int) -> tuple[NDArray[np.float64], float]:
    """The robot at its initial pose: where its middle is (x, y from the body, z from the ground) and its radius, m."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
    places, reach = data.geom_xpos[own], model.geom_rbound[own][:, None]
    low, high = (places - reach).min(axis=0), (places + reach).max(axis=0)
    middle = (low + high) / 2
    radius = float((np.linalg.norm(places - middle, axis=1) + reach[:, 0]).max())
    return middle - data.xpos[body] * [1, 1, 0], radius
