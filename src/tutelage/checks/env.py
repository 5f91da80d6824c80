"""The contract of a fleet."""

from __future__ import annotations

import copy
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tutelage.checks.shared import check_tree, demand, random_actions
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet

Array = NDArray[Any]


def check_env(fleet: Fleet, *, seed: int = 0, steps: int = 200) -> None:
    """Check that a fleet keeps the promises of `Fleet`.

    Args:
        fleet: it is reset, and stepped with random actions.
        seed: of its resets and of the actions.
        steps: timesteps to look for a violation and for the horizon. Clauses about what did not occur cannot be
            checked; a warning says so.

    Raises:
        ContractError: naming the broken clause.
    """
    name = type(fleet).__name__
    _check_declarations(fleet, name)
    _check_tuples(fleet, name, seed)
    _check_seed(fleet, name, seed)
    _check_pause(fleet, name, seed)
    _check_mask(fleet, name, seed)
    _check_episodes(fleet, name, seed, steps)
    _check_state(fleet, name, seed)


def _rows(x: Array) -> Array:
    """(N, ...) -> (N, D)."""
    return np.asarray(x).reshape(len(x), -1)


def _same(a: Array, b: Array) -> Array:
    """(N,) bool, whether each robot's row is the same number for number."""
    return np.asarray((_rows(a) == _rows(b)).all(axis=1))


def _check_declarations(fleet: Fleet, name: str) -> None:
    demand(isinstance(fleet, Fleet), f"{name} is no Fleet; derive it from tutelage.fleet.fleet.Fleet")
    mode = fleet.metadata.get("autoreset_mode")
    demand(mode is AutoresetMode.DISABLED, f"{name}: metadata['autoreset_mode'] must be AutoresetMode.DISABLED, got {mode}")
    n = fleet.num_envs
    demand(isinstance(n, int) and n >= 1, f"{name}: num_envs must be an int >= 1, got {n!r}")
    horizon = getattr(fleet, "horizon", None)
    good = isinstance(horizon, int) and horizon >= 1
    demand(good, f"{name}: horizon must be an int >= 1 (timesteps of an episode), got {horizon!r}")
    box, seen = fleet.single_action_space, fleet.single_observation_space
    good = isinstance(box, gym.spaces.Box) and len(box.shape) == 1
    demand(good, f"{name}: single_action_space must be a Box of shape (A,), got {box}")
    finite = np.isfinite(fleet.action_low).all() and np.isfinite(fleet.action_high).all()
    demand(finite and (fleet.action_low < fleet.action_high).all(), f"{name}: action bounds must be finite, with low < high")
    demand(isinstance(seen, gym.spaces.Box), f"{name}: single_observation_space must be a Box, got {seen}")
    for label, batch, single in (("action", fleet.action_space, box), ("observation", fleet.observation_space, seen)):
        expected = (n, *(single.shape or ()))
        demand(batch.shape == expected, f"{name}: {label}_space must have shape {expected}, got {batch.shape}")


def _check_obs(fleet: Fleet, name: str, obs: Any, call: str) -> None:
    space = fleet.observation_space
    good = isinstance(obs, np.ndarray) and obs.shape == space.shape
    demand(good, f"{name}.{call} must return observations of shape {space.shape}, got {getattr(obs, 'shape', type(obs))}")
    demand(obs.dtype == space.dtype, f"{name}.{call} must return observations of type {space.dtype}, got {obs.dtype}")
    demand(np.isfinite(obs).all(), f"{name}.{call} returned an observation that is not finite")


def _check_flag(n: int, value: Any, what: str) -> None:
    good = isinstance(value, np.ndarray) and value.shape == (n,) and value.dtype == bool
    got = f"{value.shape} {value.dtype}" if isinstance(value, np.ndarray) else repr(value)
    demand(good, f"{what} must be an array ({n},) of bool, got {got}")


def _check_info(fleet: Fleet, name: str, info: dict[str, Any], call: str) -> None:
    for key in ("violation", "success"):
        demand(key in info, f"info[{key!r}] is missing from {name}.{call}")
        _check_flag(fleet.num_envs, info[key], f"info[{key!r}] of {name}.{call}")
    demand(not (info["violation"] & info["success"]).any(), f"{name}.{call}: a robot in violation cannot be a success")


def _check_tuples(fleet: Fleet, name: str, seed: int) -> None:
    """What `reset` and `step` return: shapes, types, and that it belongs to the caller."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    result: Any = fleet.reset(seed=seed)
    demand(isinstance(result, tuple) and len(result) == 2, f"{name}.reset must return (obs, info)")
    obs, info = result
    _check_obs(fleet, name, obs, "reset")
    _check_info(fleet, name, info, "reset")
    demand(not info["violation"].any(), f"{name}.reset must end every violation, but robots are still in violation")
    demand(not info["success"].any(), f"{name}.reset: no robot completes its task by a reset, but info['success'] is set")
    for _ in range(3):
        actions = random_actions(fleet, rng)
        kept, wanted = copy.deepcopy((obs, info["violation"])), actions.copy()
        result = fleet.step(actions)
        demand(
            isinstance(result, tuple) and len(result) == 5,
            f"{name}.step must return (obs, reward, terminated, truncated, info)",
        )
        unchanged = np.array_equal(kept[0], obs) and np.array_equal(kept[1], info["violation"])
        demand(unchanged, f"{name}.step overwrites what it returned before; return new arrays")
        demand(np.array_equal(wanted, actions), f"{name}.step changes the actions that it is given; work on a copy")
        obs, reward, terminated, truncated, info = result
        _check_obs(fleet, name, obs, "step")
        _check_info(fleet, name, info, "step")
        good = isinstance(reward, np.ndarray) and reward.shape == (n,) and reward.dtype == np.float64
        got = getattr(reward, "shape", type(reward)), getattr(reward, "dtype", "")
        demand(good, f"{name}.step must return rewards ({n},) float64, got {got[0]} {got[1]}")
        demand(np.isfinite(reward).all(), f"{name}.step returned a reward that is not finite")
        _check_flag(n, terminated, f"terminated of {name}.step")
        _check_flag(n, truncated, f"truncated of {name}.step")


def _drive(fleet: Fleet, rng: np.random.Generator, steps: int, split: bool = False) -> list[Array]:
    """Step with random actions and reset, as the loop does, whom it is due and one violated robot in two."""
    record: list[Array] = []
    for t in range(steps):
        actions = random_actions(fleet, rng)
        if split:
            fleet.step_async(actions)
            result = fleet.step_wait()
        else:
            result = fleet.step(actions)
        obs, reward, terminated, truncated, info = result
        record += [obs, reward, terminated, truncated, info["violation"], info["success"]]
        again = info["success"] | truncated
        again[t % 2 :: 2] |= info["violation"][t % 2 :: 2]
        if again.any():
            obs, info = fleet.reset(options={"reset_mask": again})
            record += [obs, info["violation"]]
    return record


def _alike(first: list[Array], second: list[Array]) -> bool:
    return len(first) == len(second) and all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def _check_seed(fleet: Fleet, name: str, seed: int) -> None:
    runs = []
    for split in (False, False, True):
        obs, _ = fleet.reset(seed=seed)
        runs.append([obs, *_drive(fleet, np.random.default_rng(seed), 20, split)])
    message = (
        f"{name}: the same seed must give the same run; draw every random number from streams that reset(seed=) restarts"
    )
    demand(_alike(runs[0], runs[1]), message)
    demand(_alike(runs[1], runs[2]), f"{name}: step_async followed by step_wait must do what step does")


def _check_pause(fleet: Fleet, name: str, seed: int) -> None:
    if not fleet.can_pause:
        return
    rng = np.random.default_rng(seed)
    obs, info = fleet.reset(seed=seed)
    for t in range(4):
        active = np.arange(fleet.num_envs) % 2 == t % 2
        before, violated = obs, info["violation"]
        obs, reward, _, truncated, info = fleet.step(random_actions(fleet, rng), active=active)
        held = ~active
        demand(_same(before, obs)[held].all(), f"{name}: a robot outside `active` is paused, but its observation changed")
        demand((reward[held] == 0).all(), f"{name}: a robot outside `active` is paused, but its reward is not 0")
        quiet = not (truncated | info["success"] | (info["violation"] & ~violated))[held].any()
        demand(quiet, f"{name}: a robot outside `active` is paused, but something happened to it")


def _check_mask(fleet: Fleet, name: str, seed: int) -> None:
    """`reset_mask` resets the robots of the mask and no other."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    start, _ = fleet.reset(seed=seed)
    for mask in (np.arange(n) % 2 == 0, np.arange(n) % 2 == 1, np.zeros(n, dtype=bool)):
        for _ in range(3):
            before, _, _, _, info = fleet.step(random_actions(fleet, rng))
        given = mask.copy()
        after, fresh = fleet.reset(options={"reset_mask": given})
        demand(np.array_equal(given, mask), f"{name}.reset changes the reset_mask that it is given; work on a copy")
        _check_obs(fleet, name, after, "reset")
        _check_info(fleet, name, fresh, "reset")
        others = _same(before, after)[~mask].all() and (fresh["violation"] == info["violation"])[~mask].all()
        demand(others, f"{name}.reset resets robots that are not in reset_mask")
        demand(not fresh["violation"][mask].any(), f"{name}.reset must end the violations of the robots in reset_mask")
        stuck = mask & _same(before, after) & ~_same(before, start)
        demand(not stuck.any(), f"{name}.reset does not reset the robots in reset_mask")


def _check_episodes(fleet: Fleet, name: str, seed: int, steps: int) -> None:
    """Violated robots stand still until they are reset; no episode outlasts the horizon."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    obs, info = fleet.reset(seed=seed)
    age, waited = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
    fell = False
    for _ in range(steps):
        before, down = obs, info["violation"]
        obs, reward, _, truncated, info = fleet.step(random_actions(fleet, rng))
        age += ~down
        _check_info(fleet, name, info, "step")
        demand(info["violation"][down].all(), f"{name}: a violation must last until the robot is reset")
        demand(_same(before, obs)[down].all(), f"{name}: a robot in violation must stand still, but its observation changed")
        demand((reward[down] == 0).all(), f"{name}: a robot in violation must stand still, but its reward is not 0")
        ended = info["success"] | truncated
        demand(not (ended & down).any(), f"{name}: a robot in violation must stand still, but its episode ended once more")
        late = (age >= fleet.horizon) & ~ended & ~info["violation"]
        demand(not late.any(), f"{name}: after {fleet.horizon} timesteps (the horizon) an episode must be truncated")
        fell |= bool(info["violation"].any())
        waited = np.where(info["violation"], waited + 1, 0)
        again = (ended & ~info["violation"]) | (waited > 3)
        if again.any():
            obs, info = fleet.reset(options={"reset_mask": again})
            demand(not info["violation"][again].any(), f"{name}.reset must end the violations of the robots in reset_mask")
            age[again], waited[again] = 0, 0
    if not fell:
        warnings.warn(f"check_env: no robot of {name} violated its constraint in {steps} timesteps; try more", stacklevel=3)


def _check_state(fleet: Fleet, name: str, seed: int) -> None:
    fleet.reset(seed=seed)
    if not fleet.can_checkpoint:
        try:
            fleet.state_dict()
        except ConfigError:
            return
        raise ContractError(f"{name} says can_checkpoint = False: state_dict must raise ConfigError")
    rng = np.random.default_rng(seed)
    _drive(fleet, rng, 10)
    state = fleet.state_dict()
    check_tree(state, f"{name}.state_dict()")
    first = _drive(fleet, np.random.default_rng(seed), 20)
    fleet.load_state_dict(state)
    second = _drive(fleet, np.random.default_rng(seed), 20)
    message = f"{name}.load_state_dict(state_dict()) must continue bit for bit; something is not saved, or saved as a view"
    demand(_alike(first, second), message)
