"""What a fleet of MuJoCo robots promises: seeds, resets of some, standing still, pausing, exact resume, disturbances."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env
from tutelage.envs.engine import BAD_VELOCITY
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import MUJOCO, Walker2d
from tutelage.errors import ConfigError, ContractError
from tutelage.store import load_tree, save_tree


def drive(fleet: MujocoFleet, steps: int, seed: int = 0) -> list[Any]:
    """Random actions; robots that fell lie for a few steps and are then reset."""
    rng, out = np.random.default_rng(seed), []
    for t in range(steps):
        obs, reward, terminated, truncated, info = fleet.step(rng.uniform(-1, 1, fleet.action_space.shape or ()))
        out += [obs, reward, terminated, truncated, info["success"], info["return"], info["elapsed"]]
        if t % 5 == 4 and info["violation"].any():
            obs, _ = fleet.reset(options={"reset_mask": info["violation"]})
            out.append(obs)
    return out


def alike(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.fixture
def walkers() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("Walker2d", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def topple(fleet: MujocoFleet, robot: int) -> np.ndarray:
    """Step until that robot falls; the last observation."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        obs, _, _, _, info = fleet.step(rng.uniform(-1, 1, fleet.action_space.shape or ()))
        if info["violation"][robot]:
            return obs
    raise AssertionError("it never fell")


@pytest.mark.parametrize("level", ["none", "severe"])
@pytest.mark.parametrize("name", MUJOCO)
@pytest.mark.filterwarnings("ignore:check_env")
def test_fleets_keep_the_contract(name: str, level: str) -> None:
    fleet = MujocoFleet(name, 5, disturbance=level, threads=2)
    check_env(fleet)
    fleet.close()


@pytest.mark.parametrize("name", MUJOCO)
def test_results_do_not_depend_on_the_number_of_threads(name: str) -> None:
    runs = []
    for threads in (1, 3):
        fleet = MujocoFleet(name, 13, disturbance="severe", threads=threads)
        obs, _ = fleet.reset(seed=3)
        runs.append([obs, *drive(fleet, 40)])
        fleet.close()
    assert alike(*runs)


@pytest.mark.parametrize("name", MUJOCO)
def test_a_saved_fleet_continues_bit_for_bit_in_a_new_one(name: str, tmp_path: Path) -> None:
    fleet, other = (MujocoFleet(name, 6, disturbance="severe", threads=1) for _ in range(2))
    fleet.reset(seed=7)
    drive(fleet, 33)
    save_tree(tmp_path / "fleet", fleet.state_dict())
    other.load_state_dict(load_tree(tmp_path / "fleet"))
    assert alike(drive(fleet, 40, seed=1), drive(other, 40, seed=1))
    fleet.close()
    other.close()


def test_a_violated_robot_stands_still_whatever_its_action_until_it_is_reset(walkers: MujocoFleet) -> None:
    fallen = topple(walkers, 1)
    for k in range(3):
        actions = np.full((4, 6), (1.0, -1.0, np.nan)[k])
        actions[[0, 2, 3]] = 0.0
        obs, reward, terminated, truncated, info = walkers.step(actions)
        assert np.array_equal(obs[1], fallen[1])
        assert reward[1] == 0
        assert info["violation"][1]
        assert terminated[1]
        assert not truncated[1]
    obs, info = walkers.reset(options={"reset_mask": np.array([False, True, False, False])})
    assert not info["violation"][1]
    assert obs[1, 0] == pytest.approx(1.25, abs=0.01)


def test_time_stops_for_a_paused_robot() -> None:
    runs = []
    for pauses in (False, True):
        fleet = MujocoFleet("Ant", 2, disturbance="none", threads=1)
        fleet.reset(seed=0)
        rng, seen = np.random.default_rng(0), []
        for _ in range(30):
            actions = rng.uniform(-1, 1, (2, 8))
            if pauses:
                before = fleet.step(np.full((2, 8), np.nan), active=np.array([False, False]))
                assert (before[1] == 0).all()
            seen.append(fleet.step(actions)[0])
        runs.append(seen)
        fleet.close()
    assert alike(*runs)


def test_resetting_some_leaves_the_others_and_a_seeded_reset_leaves_their_masses() -> None:
    fleet = MujocoFleet("Walker2d", 4, disturbance="severe", threads=1)
    fleet.reset(seed=0)
    masses = [m.body_mass.copy() for m in fleet.physics.models]
    before = fleet.step(np.zeros((4, 6)))[0]
    mask = np.array([True, False, True, False])
    after, _ = fleet.reset(seed=5, options={"reset_mask": mask})
    changed = [not np.array_equal(old, m.body_mass) for old, m in zip(masses, fleet.physics.models, strict=True)]
    assert changed == mask.tolist()
    assert ((before == after).all(axis=1) == ~mask).all()
    fleet.close()


def test_no_reset_of_nobody(walkers: MujocoFleet) -> None:
    before = walkers.step(np.zeros((4, 6)))[0]
    after, _ = walkers.reset(options={"reset_mask": np.zeros(4, dtype=bool)})
    assert np.array_equal(before, after)


class Short(Walker2d):
    """Five steps are enough."""

    horizon = 5


@pytest.mark.parametrize(("factor", "succeeds"), [(None, True), (0.999, True), (1.001, False)])
def test_success_is_reaching_the_horizon_with_the_return_asked_for(factor: float | None, succeeds: bool) -> None:
    fleet = MujocoFleet(Short(), 3, disturbance="none", threads=1)
    fleet.reset(seed=0)
    total = sum(fleet.step(np.zeros((3, 6)))[1] for _ in range(5))
    assert isinstance(total, np.ndarray)
    fleet.success_return = -math.inf if factor is None else total.min() * factor
    fleet.reset(seed=0)
    for t in range(5):
        _, _, terminated, truncated, info = fleet.step(np.zeros((3, 6)))
        assert (truncated == (t == 4)).all()
        assert not terminated.any()
    assert info["success"][total.argmin()] == succeeds
    np.testing.assert_allclose(info["return"], total)
    assert not fleet.step(np.zeros((3, 6)))[4]["success"].any(), "a task is completed once"
    fleet.close()


def test_a_robot_that_fell_cannot_be_truncated_or_succeed() -> None:
    fleet = MujocoFleet(type("Soon", (Walker2d,), {"horizon": 60})(), 6, disturbance="none", threads=1)
    fleet.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        _, _, _, truncated, info = fleet.step(rng.uniform(-1, 1, (6, 6)))
        assert not (info["violation"] & (truncated | info["success"])).any()
    assert info["violation"].any()
    fleet.close()


class Diverging(Walker2d):
    """Observations that are not finite as soon as the robot moved half a millimetre down."""

    def observe(self, frame: Any) -> Any:
        obs = super().observe(frame)
        return np.where(obs[:, :1] < 1.2495, np.nan, obs)


def test_a_simulation_that_diverges_is_a_violation_and_its_numbers_are_kept_from_the_policy() -> None:
    fleet = MujocoFleet(Diverging(), 3, disturbance="none", threads=1)
    fleet.reset(seed=0)
    fleet._obs = np.nan_to_num(fleet._obs)
    for _ in range(60):
        obs, reward, _, _, info = fleet.step(np.zeros((3, 6)))
        assert np.isfinite(obs).all()
        assert np.isfinite(reward).all()
    assert info["violation"].all()
    fleet.close()


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("qvel", np.nan, "velocity"),
        ("qvel", 1e5, "velocity"),
        ("qvel", 1e12, "velocity"),
        ("qpos", np.nan, "position"),
        ("qpos", -np.inf, "position"),
        ("qpos", 1e7, "position"),
    ],
)
@pytest.mark.parametrize("name", ["Walker2d", "Humanoid", "PegInsertion"])
def test_unstable_physics_is_a_violation_of_that_robot_alone(name: str, field: str, value: float, reason: str) -> None:
    fleet, calm = (MujocoFleet(name, 4, disturbance="none", threads=2) for _ in range(2))
    before, actions = fleet.reset(seed=0)[0], np.zeros(fleet.action_space.shape or ())
    calm.reset(seed=0)
    getattr(fleet.physics.datas[1], field)[:] = value
    others = np.arange(4) != 1
    for t in range(3):
        obs, reward, terminated, truncated, info = fleet.step(actions)
        expected = calm.step(actions)
        assert info["violation"].tolist() == terminated.tolist() == [False, True, False, False]
        assert info["unstable"].tolist() == ["", reason if t == 0 else "", "", ""]
        assert not (truncated | info["success"])[1]
        assert np.array_equal(obs[1], before[1]), "the last good observation"
        assert reward[1] == 0
        for ours, theirs in ((obs, expected[0]), (reward, expected[1])):
            assert np.array_equal(ours[others], theirs[others]), "the rest of the fleet goes on as if nothing had happened"
        assert all(np.isfinite(part).all() for part in (obs, reward, info["return"], fleet.physics.get_state()))
    obs, info = fleet.reset(options={"reset_mask": ~others})
    assert not info["violation"].any()
    assert np.isfinite(obs).all()
    info = fleet.step(actions)[4]
    assert not info["violation"].any(), "a hard reset mends it"
    fleet.close()
    calm.close()


@pytest.mark.parametrize("name", MUJOCO)
def test_physics_that_diverges_within_a_timestep_is_noticed_there(name: str) -> None:
    fleet = MujocoFleet(name, 3, disturbance="none", threads=1)
    fleet.reset(seed=0)
    physics, blow = fleet.physics, np.zeros((3, 6))
    before, blow[2] = physics.raw_frame.copy(), 1e15
    ctrl = np.zeros((3, physics.model.nu))
    physics.advance_async(np.arange(3), ctrl, blow, fleet.task.frame_skip).results()
    assert physics.unstable.tolist() == [0, 0, BAD_VELOCITY]
    assert ((physics.raw_frame == before).all(axis=1)).tolist() == [False, False, True], "the last good frame"
    assert np.isfinite(physics.get_state()).all()
    physics.restart(np.array([2]), physics.qpos0[None], physics.qvel0[None])
    physics.advance_async(np.arange(3), ctrl, None, 1).results()
    assert not physics.unstable.any()
    fleet.close()


@pytest.mark.parametrize(
    ("actions", "message"),
    [(np.zeros((4, 5)), "shape"), (np.zeros(24), "shape"), (np.full((4, 6), np.nan), "robots .0, 1, 2, 3. are not finite")],
)
def test_bad_actions_are_refused(walkers: MujocoFleet, actions: np.ndarray, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        walkers.step(actions)


@pytest.mark.parametrize("mask", [np.ones(3, dtype=bool), np.ones(4), [1, 0, 0, 0]])
def test_bad_masks_are_refused(walkers: MujocoFleet, mask: Any) -> None:
    with pytest.raises(ContractError, match="reset_mask"):
        walkers.reset(options={"reset_mask": mask})


def test_a_fleet_must_be_reset_as_a_whole_before_it_steps() -> None:
    fleet = MujocoFleet("Walker2d", 2, threads=1)
    with pytest.raises(ContractError, match="reset the fleet"):
        fleet.step(np.zeros((2, 6)))
    with pytest.raises(ContractError, match="first reset"):
        fleet.reset(options={"reset_mask": np.array([True, False])})
    fleet.close()


@pytest.mark.parametrize(
    ("task", "robots", "level", "message"),
    [
        ("Walker", 2, "none", "unknown task 'Walker'; known tasks: HalfCheetah"),
        ("Walker2d", 0, "none", "at least one robot"),
        ("Walker2d", 2, "brutal", "unknown disturbance 'brutal'; use one of none, mild"),
        ("Walker2d", 2, "mass=1", "below 1"),
    ],
)
def test_bad_settings_are_refused(task: str, robots: int, level: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        MujocoFleet(task, robots, disturbance=level, threads=1)


# -- disturbances -----------------------------------------------------------------------------------------------


def test_noise_has_the_asked_for_size_and_respects_the_bounds() -> None:
    fleet = MujocoFleet("Humanoid", 40, disturbance="noise=0.25", threads=1)  # bounds are -0.4 to 0.4
    fleet.reset(seed=0)
    commands = []
    for _ in range(5):
        fleet.step(np.zeros((40, 17)))
        commands.append([d.ctrl.copy() for d in fleet.physics.datas])
    noise = np.array(commands).ravel()
    assert noise.std() == pytest.approx(0.25 * 0.4, rel=0.05)
    assert abs(noise.mean()) < 0.01
    fleet.step(np.full((40, 17), 0.4))
    assert max(d.ctrl.max() for d in fleet.physics.datas) == pytest.approx(0.4)
    fleet.close()


def test_masses_and_friction_are_scaled_robot_by_robot_and_drawn_anew_by_a_seed() -> None:
    fleet = MujocoFleet("Walker2d", 200, disturbance="mass=0.1,friction=0.4", threads=1)
    nominal = fleet.physics.model

    def scales() -> tuple[np.ndarray, np.ndarray]:
        mass = np.array([m.body_mass[1:] / nominal.body_mass[1:] for m in fleet.physics.models])
        friction = np.array([m.geom_friction[:, 0] / nominal.geom_friction[:, 0] for m in fleet.physics.models])
        assert np.ptp(mass, axis=1).max() < 1e-12, "one number a robot"
        assert np.ptp(friction, axis=1).max() < 1e-12
        return mass[:, 0], friction[:, 0]

    fleet.reset(seed=1)
    mass, friction = scales()
    for scale, half in ((mass, 0.1), (friction, 0.4)):
        assert np.abs(scale - 1).max() <= half
        assert scale.std() == pytest.approx(half / math.sqrt(3), rel=0.15)
        assert scale.mean() == pytest.approx(1, abs=half / 5)
    fleet.reset()
    assert np.array_equal(scales()[0], mass), "a reset without a seed keeps the robots that they are"
    fleet.reset(seed=2)
    assert not np.array_equal(scales()[0], mass)
    fleet.reset(seed=1)
    assert np.array_equal(scales()[0], mass)
    assert np.array_equal(scales()[1], friction)
    fleet.close()


def test_a_heavier_robot_has_its_centre_of_mass_where_its_parts_are() -> None:
    fleet = MujocoFleet("Humanoid", 3, disturbance="mass=0.2", threads=1)
    fleet.reset(seed=0)
    for data in fleet.physics.datas:
        data.qpos[0] += 100.0  # errors of the derived constants grow with the distance from the origin
    fleet.step(np.zeros((3, 17)))
    for model, data in zip(fleet.physics.models, fleet.physics.datas, strict=True):
        centre = (data.xipos * model.body_mass[:, None]).sum(axis=0) / model.body_mass.sum()
        np.testing.assert_allclose(data.subtree_com[1], centre, rtol=0, atol=1e-9)
    fleet.close()


def test_a_push_acts_on_the_torso() -> None:
    quiet = MujocoFleet("Walker2d", 2, disturbance="none", threads=1)
    pushed = MujocoFleet("Walker2d", 2, disturbance="push=5,push_interval=0.008", threads=1)  # at every step
    quiet.reset(seed=0)
    pushed.reset(seed=0)
    shift = pushed.step(np.zeros((2, 6)))[0][:, 8] - quiet.step(np.zeros((2, 6)))[0][:, 8]
    weight = quiet.physics.model.body_mass.sum() * 9.81
    for data, faster in zip(pushed.physics.datas, shift, strict=True):
        assert abs(data.xfrc_applied[1, 0]) == pytest.approx(5 * weight)
        assert (np.delete(data.xfrc_applied, 1, axis=0) == 0).all()
        assert faster * np.sign(data.xfrc_applied[1, 0]) > 0.5, "the torso's forward velocity, m/s"
    quiet.close()
    pushed.close()


def test_every_level_disturbs_and_is_seeded() -> None:
    runs = {}
    for level in ("none", "mild", "extreme"):
        for seed in (0, 0, 1):
            fleet = MujocoFleet("Walker2d", 3, disturbance=level, threads=1)
            obs, _ = fleet.reset(seed=seed)
            run = [obs, *drive(fleet, 15)]
            assert alike(runs.setdefault((level, seed), run), run)
            fleet.close()
    assert not alike(runs["none", 0], runs["mild", 0])
    assert not alike(runs["mild", 0], runs["extreme", 0])
    assert not alike(runs["mild", 0], runs["mild", 1])
