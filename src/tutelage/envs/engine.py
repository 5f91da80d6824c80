"""Batched MuJoCo: one `mjData` a robot, stepped by threads that never hold the interpreter lock.

The loop over robots is compiled (numba) and calls the MuJoCo library directly, so the Python work of a step is a few
calls a thread, whatever the number of robots. Results do not depend on the number of threads.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from tutelage.claims import claim
from tutelage.cores import Together, available_cores, share
from tutelage.errors import MissingExtraError

try:
    import mujoco
except ImportError as error:  # pragma: no cover - exercised in an environment without the extra
    raise MissingExtraError("mujoco", "mujoco") from error

Array = NDArray[Any]


def _load_library() -> None:
    """Make the symbols of the MuJoCo library that the Python package already loaded visible to compiled code."""
    folder = Path(mujoco.__file__).parent
    found = [p for p in folder.iterdir() if p.name.startswith(("libmujoco", "mujoco.dll")) and p.is_file()]
    if not found:
        raise MissingExtraError("the MuJoCo shared library", "mujoco")
    llvmlite.binding.load_library_permanently(str(found[0]))


_load_library()
_P = types.intp
_mj_step = types.ExternalFunction("mj_step", types.void(_P, _P))
_mj_forward = types.ExternalFunction("mj_forward", types.void(_P, _P))
_mj_reset = types.ExternalFunction("mj_resetData", types.void(_P, _P))
_mj_contact_forces = types.ExternalFunction("mj_rnePostConstraint", types.void(_P, _P))
_memmove = types.ExternalFunction("memmove", _P(_P, _P, types.uintp))


@intrinsic
def _float_at(typing, address):  # type: ignore[no-untyped-def]
    """The float64 at an address."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kind = context.get_value_type(types.float64)
        return builder.load(builder.inttoptr(arguments[0], kind.as_pointer()))

    return types.float64(types.intp), generate


STABLE, BAD_POSITION, BAD_VELOCITY = 0, 1, 2
"""Values of `Physics.unstable`."""
POSITION_LIMIT, SPEED_LIMIT = 1e6, 1e4
"""Beyond these (m or rad, m/s or rad/s) a simulation is taken to have diverged: no robot is so far away or so fast."""


@numba.njit(nogil=True, cache=True)
def _health(qpos, nq, qvel, nv):  # type: ignore[no-untyped-def]
    """Whether the state at these addresses is one that a robot can be in. NaN compares false, so it is not."""
    for k in range(nv):
        if not abs(_float_at(qvel + 8 * k)) < SPEED_LIMIT:
            return BAD_VELOCITY
    for k in range(nq):
        if not abs(_float_at(qpos + 8 * k)) < POSITION_LIMIT:
            return BAD_POSITION
    return STABLE


@numba.njit(nogil=True, cache=True)
def _gather(i, sources, sizes, frame_address, frame_width):  # type: ignore[no-untyped-def]
    """Copy robot i's fields, one behind the other, into row i of the frame (float64)."""
    destination = frame_address + i * frame_width * 8
    for k in range(sizes.shape[0]):
        _memmove(destination, sources[i, k], sizes[k] * 8)
        destination += sizes[k] * 8


@numba.njit(nogil=True, cache=True)
def _advance(  # type: ignore[no-untyped-def]
    counter, robots, models, datas, substeps, forces, unstable, qpos_at, nq, qvel_at, nv,
    ctrl_at, ctrl_address, ctrl_width, push_at, push_address, sources, sizes, frame_address, frame_width,
):  # fmt: skip
    while True:
        claimed = claim(counter)
        if claimed >= len(robots):
            return
        i = robots[claimed]
        _memmove(ctrl_at[i], ctrl_address + i * ctrl_width * 8, ctrl_width * 8)
        _memmove(push_at[i], push_address + i * 48, 48)
        health = _health(qpos_at[i], nq, qvel_at[i], nv)
        for _ in range(substeps):
            if health != STABLE:
                break
            _mj_step(models[i], datas[i])
            health = _health(qpos_at[i], nq, qvel_at[i], nv)
        unstable[i] = health
        if health != STABLE:
            # Its numbers are nobody's: the frame keeps the last good ones, and nothing that is not finite stays behind.
            _mj_reset(models[i], datas[i])
            continue
        if forces:
            _mj_contact_forces(models[i], datas[i])
        _gather(i, sources, sizes, frame_address, frame_width)


@numba.njit(nogil=True, cache=True)
def _restart(  # type: ignore[no-untyped-def]
    counter, robots, models, datas, unstable,
    qpos_at, qpos_address, nq, qvel_at, qvel_address, nv, sources, sizes, frame_address, frame_width,
):  # fmt: skip
    while True:
        claimed = claim(counter)
        if claimed >= len(robots):
            return
        i = robots[claimed]
        _mj_reset(models[i], datas[i])
        _memmove(qpos_at[i], qpos_address + i * nq * 8, nq * 8)
        _memmove(qvel_at[i], qvel_address + i * nv * 8, nv * 8)
        _mj_forward(models[i], datas[i])
        unstable[i] = STABLE
        _gather(i, sources, sizes, frame_address, frame_width)


def _address(array: Array) -> int:
    return int(array.__array_interface__["data"][0])


class Physics:
    """N independent MuJoCo simulations of one model, advanced together.

    Args:
        xml: path of the MJCF file.
        num_robots: N.
        fields: names of float64 `mjData` arrays to bring back after each step, such as ("qpos", "qvel", "cfrc_ext").
        push_body: name or index of the body on which `advance(push=...)` acts.
        contact_forces: also compute `cfrc_ext` after each step (`mj_rnePostConstraint`).
        threads: threads that step robots, see `Together`; default: one per core this process may use.

    `frame[name]` is the field of all robots, shape (N, *field shape), a view that the next step overwrites.

    A simulation that diverges ends in the substep in which it does: `unstable` (N,) int8 says so (`BAD_POSITION`,
    `BAD_VELOCITY`), the robot's frame stays that before the step, and it waits for `restart`. The others do not notice.
    """

    def __init__(
        self,
        xml: str | Path,
        num_robots: int,
        fields: Sequence[str],
        *,
        push_body: str | int = 1,
        contact_forces: bool = False,
        threads: int | None = None,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(xml))
        # MuJoCo would put a diverged robot back to its initial state and go on, as if nothing had happened.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.num_robots = num_robots
        self.threads = max(1, min(threads or available_cores(), num_robots))
        self.models = [self.model] * num_robots
        self.datas = [mujoco.MjData(self.model) for _ in range(num_robots)]
        self.qpos0, self.qvel0 = self.datas[0].qpos.copy(), self.datas[0].qvel.copy()
        self.unstable = np.zeros(num_robots, dtype=np.int8)
        self._forces = contact_forces
        self._push_body = self.model.body(push_body).id

        shapes = {name: getattr(self.datas[0], name).shape for name in fields}
        self._sizes = np.array([int(np.prod(s)) for s in shapes.values()], dtype=np.intp)
        self._width = int(self._sizes.sum())
        self._frame = np.zeros((num_robots, self._width))
        offsets = np.cumsum([0, *self._sizes])
        self.frame: dict[str, Array] = {
            name: self._frame[:, offsets[k] : offsets[k + 1]].reshape(num_robots, *shape)
            for k, (name, shape) in enumerate(shapes.items())
        }
        self._fields = tuple(fields)
        self._ctrl = np.zeros((num_robots, self.model.nu))
        self._push = np.zeros((num_robots, 6))
        self._qpos = np.zeros((num_robots, self.model.nq))
        self._qvel = np.zeros((num_robots, self.model.nv))
        self._point()

    def _point(self) -> None:
        """Note where each robot's arrays live, once: MuJoCo never moves them."""

        def at(name: str) -> Array:
            return np.array([_address(getattr(d, name)) for d in self.datas], dtype=np.intp)

        self._models_at = np.array([m._address for m in self.models], dtype=np.intp)
        self._datas_at = np.array([d._address for d in self.datas], dtype=np.intp)
        self._ctrl_at, self._qpos_at, self._qvel_at = at("ctrl"), at("qpos"), at("qvel")
        self._push_at = at("xfrc_applied") + self._push_body * 48
        self._sources = np.ascontiguousarray(np.stack([at(name) for name in self._fields], axis=1))

    def vary(self, mass: Array, friction: Array) -> None:
        """Give each robot its own model: masses and inertias scaled by `mass` (N,), sliding friction by `friction` (N,)."""
        scratch = mujoco.MjData(self.model)
        self.models = []
        for scale_mass, scale_friction in zip(mass, friction, strict=True):
            model = copy.copy(self.model)
            model.body_mass[:] *= scale_mass
            model.body_inertia[:] *= scale_mass
            model.geom_friction[:, 0] *= scale_friction
            # Constants that the compiler derived from the masses: without this, centres of mass (and with them Humanoid's
            # observations) are wrong by scale_mass times the distance from the origin.
            mujoco.mj_setConst(model, scratch)
            self.models.append(model)
        self._point()

    def advance_async(self, robots: Array, ctrl: Array, push: Array | None, substeps: int) -> Together:
        """Start `substeps` physics steps of the given robots (indices) in the background; ask for its `results`.

        ctrl: (N, nu) actuator commands; push: (N, 6) force (N) and torque (N m) on the push body, or None.
        """
        self._ctrl[:] = ctrl
        self._push[:] = 0.0 if push is None else push
        robots = np.ascontiguousarray(robots, dtype=np.intp)
        # Falls and contacts take longer, so robots are claimed one by one.
        return share(
            _advance, len(robots), self.threads, robots,
            self._models_at, self._datas_at, substeps, self._forces, self.unstable,
            self._qpos_at, self.model.nq, self._qvel_at, self.model.nv,
            self._ctrl_at, _address(self._ctrl), self.model.nu, self._push_at, _address(self._push),
            self._sources, self._sizes, _address(self._frame), self._width,
        )  # fmt: skip

    def restart(self, robots: Array, qpos: Array, qvel: Array) -> None:
        """Put the given robots (n indices) at qpos (n, nq) and qvel (n, nv), everything else at its initial value."""
        self._qpos[robots], self._qvel[robots] = qpos, qvel
        robots = np.ascontiguousarray(robots, dtype=np.intp)
        share(
            _restart, len(robots), self.threads, robots,
            self._models_at, self._datas_at, self.unstable,
            self._qpos_at, _address(self._qpos), self.model.nq, self._qvel_at, _address(self._qvel), self.model.nv,
            self._sources, self._sizes, _address(self._frame), self._width,
        ).results()  # fmt: skip

    def place(self, robots: Array, qpos: Array) -> None:
        """Move the given robots (n indices) to qpos (n, nq) in the middle of what they do: all else goes on."""
        for robot, row in zip(robots, qpos, strict=True):
            self.datas[robot].qpos[:] = row
        if "qpos" in self.frame:
            self.frame["qpos"][robots] = qpos

    def get_state(self) -> Array:
        """Full integration state of every robot, (N, S) float64: what is needed to continue bit for bit."""
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.zeros((self.num_robots, mujoco.mj_stateSize(self.model, spec)))
        for model, data, row in zip(self.models, self.datas, state, strict=True):
            mujoco.mj_getState(model, data, row, spec)
        return state

    def set_state(self, state: Array) -> None:
        """Restore what `get_state` returned. `frame` is not refreshed: restore `raw_frame` too."""
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        for model, data, row in zip(self.models, self.datas, state, strict=True):
            mujoco.mj_setState(model, data, row, spec)
            mujoco.mj_forward(model, data)
            mujoco.mj_setState(model, data, row, spec)

    @property
    def raw_frame(self) -> Array:
        """All fields of all robots, (N, width) float64, in one array."""
        return self._frame
