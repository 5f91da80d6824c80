"""The contracts as functions that users run on their own classes.

    from tutelage.checks import check_env

    check_env(MyFleet(num_envs=4))

Each returns nothing if all is well. Otherwise it raises a `ContractError` that names the clause.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import Priority
from tutelage.fleet.supervisor import Supervisor
from tutelage.fleet.view import FleetView
from tutelage.seeding import stream

Array = NDArray[Any]

_REACH = 10.0  # a human's command further from the middle of the bounds, in halves of their width, is a mistake of units
_RTOL, _ATOL = 1e-3, 1e-4  # of the action range: batched float32 products differ in the last digits with the batch


def _demand(clause: bool | np.bool_, message: str) -> None:
    if not clause:
        raise ContractError(message)


# -- fleets -----------------------------------------------------------------------------------------------------


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


def _actions(fleet: Fleet, rng: np.random.Generator) -> Array:
    low, high = fleet.action_low, fleet.action_high
    return rng.uniform(low, high, (fleet.num_envs, len(low))).astype(np.float32)


def _rows(x: Array) -> Array:
    """(N, ...) -> (N, D)."""
    return np.asarray(x).reshape(len(x), -1)


def _same(a: Array, b: Array) -> Array:
    """(N,) bool, whether each robot's row is the same number for number."""
    return np.asarray((_rows(a) == _rows(b)).all(axis=1))


def _check_declarations(fleet: Fleet, name: str) -> None:
    _demand(isinstance(fleet, Fleet), f"{name} is no Fleet; derive it from tutelage.fleet.fleet.Fleet")
    mode = fleet.metadata.get("autoreset_mode")
    _demand(mode is AutoresetMode.DISABLED, f"{name}: metadata['autoreset_mode'] must be AutoresetMode.DISABLED, got {mode}")
    n = fleet.num_envs
    _demand(isinstance(n, int) and n >= 1, f"{name}: num_envs must be an int >= 1, got {n!r}")
    horizon = getattr(fleet, "horizon", None)
    good = isinstance(horizon, int) and horizon >= 1
    _demand(good, f"{name}: horizon must be an int >= 1 (timesteps of an episode), got {horizon!r}")
    box, seen = fleet.single_action_space, fleet.single_observation_space
    good = isinstance(box, gym.spaces.Box) and len(box.shape) == 1
    _demand(good, f"{name}: single_action_space must be a Box of shape (A,), got {box}")
    finite = np.isfinite(fleet.action_low).all() and np.isfinite(fleet.action_high).all()
    _demand(
        finite and (fleet.action_low < fleet.action_high).all(), f"{name}: action bounds must be finite, with low < high"
    )
    _demand(isinstance(seen, gym.spaces.Box), f"{name}: single_observation_space must be a Box, got {seen}")
    for label, batch, single in (("action", fleet.action_space, box), ("observation", fleet.observation_space, seen)):
        expected = (n, *(single.shape or ()))
        _demand(batch.shape == expected, f"{name}: {label}_space must have shape {expected}, got {batch.shape}")


def _check_obs(fleet: Fleet, name: str, obs: Any, call: str) -> None:
    space = fleet.observation_space
    good = isinstance(obs, np.ndarray) and obs.shape == space.shape
    _demand(good, f"{name}.{call} must return observations of shape {space.shape}, got {getattr(obs, 'shape', type(obs))}")
    _demand(obs.dtype == space.dtype, f"{name}.{call} must return observations of type {space.dtype}, got {obs.dtype}")
    _demand(np.isfinite(obs).all(), f"{name}.{call} returned an observation that is not finite")


def _check_flag(n: int, value: Any, what: str) -> None:
    good = isinstance(value, np.ndarray) and value.shape == (n,) and value.dtype == bool
    got = f"{value.shape} {value.dtype}" if isinstance(value, np.ndarray) else repr(value)
    _demand(good, f"{what} must be an array ({n},) of bool, got {got}")


def _check_info(fleet: Fleet, name: str, info: dict[str, Any], call: str) -> None:
    for key in ("violation", "success"):
        _demand(key in info, f"info[{key!r}] is missing from {name}.{call}")
        _check_flag(fleet.num_envs, info[key], f"info[{key!r}] of {name}.{call}")
    _demand(not (info["violation"] & info["success"]).any(), f"{name}.{call}: a robot in violation cannot be a success")


def _check_tuples(fleet: Fleet, name: str, seed: int) -> None:
    """What `reset` and `step` return: shapes, types, and that it belongs to the caller."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    result: Any = fleet.reset(seed=seed)
    _demand(isinstance(result, tuple) and len(result) == 2, f"{name}.reset must return (obs, info)")
    obs, info = result
    _check_obs(fleet, name, obs, "reset")
    _check_info(fleet, name, info, "reset")
    _demand(not info["violation"].any(), f"{name}.reset must end every violation, but robots are still in violation")
    _demand(not info["success"].any(), f"{name}.reset: no robot completes its task by a reset, but info['success'] is set")
    for _ in range(3):
        actions = _actions(fleet, rng)
        kept, wanted = copy.deepcopy((obs, info["violation"])), actions.copy()
        result = fleet.step(actions)
        _demand(
            isinstance(result, tuple) and len(result) == 5,
            f"{name}.step must return (obs, reward, terminated, truncated, info)",
        )
        unchanged = np.array_equal(kept[0], obs) and np.array_equal(kept[1], info["violation"])
        _demand(unchanged, f"{name}.step overwrites what it returned before; return new arrays")
        _demand(np.array_equal(wanted, actions), f"{name}.step changes the actions that it is given; work on a copy")
        obs, reward, terminated, truncated, info = result
        _check_obs(fleet, name, obs, "step")
        _check_info(fleet, name, info, "step")
        good = isinstance(reward, np.ndarray) and reward.shape == (n,) and reward.dtype == np.float64
        got = getattr(reward, "shape", type(reward)), getattr(reward, "dtype", "")
        _demand(good, f"{name}.step must return rewards ({n},) float64, got {got[0]} {got[1]}")
        _demand(np.isfinite(reward).all(), f"{name}.step returned a reward that is not finite")
        _check_flag(n, terminated, f"terminated of {name}.step")
        _check_flag(n, truncated, f"truncated of {name}.step")


def _drive(fleet: Fleet, rng: np.random.Generator, steps: int, split: bool = False) -> list[Array]:
    """Step with random actions and reset, as the loop does, whom it is due and one violated robot in two."""
    record: list[Array] = []
    for t in range(steps):
        actions = _actions(fleet, rng)
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
    _demand(_alike(runs[0], runs[1]), message)
    _demand(_alike(runs[1], runs[2]), f"{name}: step_async followed by step_wait must do what step does")


def _check_pause(fleet: Fleet, name: str, seed: int) -> None:
    if not fleet.can_pause:
        return
    rng = np.random.default_rng(seed)
    obs, info = fleet.reset(seed=seed)
    for t in range(4):
        active = np.arange(fleet.num_envs) % 2 == t % 2
        before, violated = obs, info["violation"]
        obs, reward, _, truncated, info = fleet.step(_actions(fleet, rng), active=active)
        held = ~active
        _demand(_same(before, obs)[held].all(), f"{name}: a robot outside `active` is paused, but its observation changed")
        _demand((reward[held] == 0).all(), f"{name}: a robot outside `active` is paused, but its reward is not 0")
        quiet = not (truncated | info["success"] | (info["violation"] & ~violated))[held].any()
        _demand(quiet, f"{name}: a robot outside `active` is paused, but something happened to it")


def _check_mask(fleet: Fleet, name: str, seed: int) -> None:
    """`reset_mask` resets the robots of the mask and no other."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    start, _ = fleet.reset(seed=seed)
    for mask in (np.arange(n) % 2 == 0, np.arange(n) % 2 == 1, np.zeros(n, dtype=bool)):
        for _ in range(3):
            before, _, _, _, info = fleet.step(_actions(fleet, rng))
        given = mask.copy()
        after, fresh = fleet.reset(options={"reset_mask": given})
        _demand(np.array_equal(given, mask), f"{name}.reset changes the reset_mask that it is given; work on a copy")
        _check_obs(fleet, name, after, "reset")
        _check_info(fleet, name, fresh, "reset")
        others = _same(before, after)[~mask].all() and (fresh["violation"] == info["violation"])[~mask].all()
        _demand(others, f"{name}.reset resets robots that are not in reset_mask")
        _demand(not fresh["violation"][mask].any(), f"{name}.reset must end the violations of the robots in reset_mask")
        stuck = mask & _same(before, after) & ~_same(before, start)
        _demand(not stuck.any(), f"{name}.reset does not reset the robots in reset_mask")


def _check_episodes(fleet: Fleet, name: str, seed: int, steps: int) -> None:
    """Violated robots stand still until they are reset; no episode outlasts the horizon."""
    n, rng = fleet.num_envs, np.random.default_rng(seed)
    obs, info = fleet.reset(seed=seed)
    age, waited = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
    fell = False
    for _ in range(steps):
        before, down = obs, info["violation"]
        obs, reward, _, truncated, info = fleet.step(_actions(fleet, rng))
        age += ~down
        _check_info(fleet, name, info, "step")
        _demand(info["violation"][down].all(), f"{name}: a violation must last until the robot is reset")
        _demand(
            _same(before, obs)[down].all(), f"{name}: a robot in violation must stand still, but its observation changed"
        )
        _demand((reward[down] == 0).all(), f"{name}: a robot in violation must stand still, but its reward is not 0")
        ended = info["success"] | truncated
        _demand(not (ended & down).any(), f"{name}: a robot in violation must stand still, but its episode ended once more")
        late = (age >= fleet.horizon) & ~ended & ~info["violation"]
        _demand(not late.any(), f"{name}: after {fleet.horizon} timesteps (the horizon) an episode must be truncated")
        fell |= bool(info["violation"].any())
        waited = np.where(info["violation"], waited + 1, 0)
        again = (ended & ~info["violation"]) | (waited > 3)
        if again.any():
            obs, info = fleet.reset(options={"reset_mask": again})
            _demand(not info["violation"][again].any(), f"{name}.reset must end the violations of the robots in reset_mask")
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
    _check_tree(state, f"{name}.state_dict()")
    first = _drive(fleet, np.random.default_rng(seed), 20)
    fleet.load_state_dict(state)
    second = _drive(fleet, np.random.default_rng(seed), 20)
    message = f"{name}.load_state_dict(state_dict()) must continue bit for bit; something is not saved, or saved as a view"
    _demand(_alike(first, second), message)


def _check_tree(tree: Any, path: str) -> None:
    if isinstance(tree, dict):
        for key, value in tree.items():
            _demand(isinstance(key, str) and "/" not in key, f"{path}: keys must be strings without '/', got {key!r}")
            _check_tree(value, f"{path}[{key!r}]")
    elif isinstance(tree, list | tuple):
        for k, value in enumerate(tree):
            _check_tree(value, f"{path}[{k}]")
    else:
        plain = tree is None or isinstance(tree, bool | int | float | str)
        array = isinstance(tree, np.ndarray) and tree.dtype != object
        _demand(plain or array, f"{path} must hold arrays and JSON values only, got {type(tree).__name__}")


# -- policies ---------------------------------------------------------------------------------------------------


def _observations(fleet: Fleet, seed: int, steps: int = 5) -> Array:
    """Some that the fleet shows under random actions, (N, ...)."""
    rng = np.random.default_rng(seed)
    obs, _ = fleet.reset(seed=seed)
    for _ in range(steps):
        obs = fleet.step(_actions(fleet, rng))[0]
    return np.array(obs)


def check_policy(policy: Policy, fleet: Fleet, *, seed: int = 0) -> None:
    """Check that a policy keeps the promises of `Policy`, and of `UncertainPolicy` if it has `uncertainty`.

    Args:
        policy: asked about observations of the fleet.
        fleet: it is reset and stepped.
        seed: of the fleet's reset and of the permutations.

    Raises:
        ContractError: naming the broken clause.
    """
    name = type(policy).__name__
    _demand(isinstance(policy, Policy), f"{name} is no policy; it needs act(obs)")
    obs = _observations(fleet, seed)
    width, scale = len(fleet.action_low), float((fleet.action_high - fleet.action_low).max())
    _check_rowwise(policy.act, f"{name}.act", obs, (width,), scale, seed)
    uncertainty = getattr(policy, "uncertainty", None)
    if uncertainty is not None:
        value = _check_rowwise(uncertainty, f"{name}.uncertainty", obs, (), None, seed)
        _demand((value >= 0).all(), f"{name}.uncertainty must be >= 0, got {value.min()}")


def _check_rowwise(
    ask: Callable[[Array], Array], name: str, obs: Array, row: tuple[int, ...], scale: float | None, seed: int
) -> Array:
    """A function of each robot's observation alone: right shape, finite, repeatable, whatever stands in the other rows."""
    n = len(obs)
    given = obs.copy()
    raw = ask(given)
    _demand(isinstance(raw, np.ndarray), f"{name} must return a numpy array, got {type(raw).__name__}")
    _demand(raw.shape == (n, *row), f"{name} must return shape {(n, *row)}, got {raw.shape}")
    _demand(raw.dtype.kind == "f", f"{name} must return floats, got {raw.dtype}")
    _demand(np.isfinite(raw).all(), f"{name} returned a number that is not finite")
    _demand(np.array_equal(given, obs), f"{name} changes the observations that it is given; work on a copy")
    value = raw.copy()
    repeated = np.array_equal(ask(obs.copy()), value)
    _demand(repeated, f"{name} must be deterministic: the same observations gave other numbers the second time")
    atol = _ATOL * (scale if scale is not None else max(1.0, float(np.abs(value).max())))
    shuffled = np.random.default_rng(seed).permutation(n)[::-1]
    for rows, what in ((shuffled, "in another order"), (np.arange(1), "alone"), (np.repeat(np.arange(n), 2), "twice")):
        answer = ask(obs[rows])
        good = answer.shape == (len(rows), *row) and np.allclose(answer, value[rows], rtol=_RTOL, atol=atol)
        _demand(good, f"{name} must look at each robot's observation alone: robots presented {what} got other answers")
    _demand(np.array_equal(raw, value), f"{name} overwrites what it returned before; return a new array")
    return value


# -- priorities -------------------------------------------------------------------------------------------------


def check_priority(priority: Priority, fleet: Fleet | int, *, seed: int = 0) -> None:
    """Check that a priority function keeps the promises of `Priority`.

    It is shown made-up views in which robots are in violation, supervised, certain and uncertain.

    Args:
        priority: what it remembers is restored afterwards if it has `state_dict`.
        fleet: the fleet that it is for, or N.
        seed: of the views.

    Raises:
        ContractError: naming the broken clause.
    """
    name = getattr(priority, "name", type(priority).__name__)
    before = _state(priority, name)
    columns = 0
    for t in (0, 1, 1000):
        view, again = _view(fleet, t, seed), _view(fleet, t, seed)
        state = _state(priority, name)
        raw = priority(view)
        n = view.num_robots
        _demand(isinstance(raw, np.ndarray), f"{name} must return a numpy array, got {type(raw).__name__}")
        good = raw.ndim == 2 and len(raw) == n and raw.shape[1] >= 1
        _demand(good, f"{name} must return shape ({n}, K) with K >= 1, got {raw.shape}")
        _demand(raw.dtype == np.float64, f"{name} must return float64, got {raw.dtype}")
        _demand(not np.isnan(raw).any(), f"{name} returned NaN; a robot that needs nobody has priority 0")
        _demand(columns in (0, raw.shape[1]), f"{name} must always return the same number of columns")
        columns = raw.shape[1]
        for part in ("obs", "actions", "violation", "supervised", "duration", "human_action", "discrepancy", "fresh"):
            nan = part in ("human_action", "discrepancy")  # where no human acted
            same = np.array_equal(getattr(view, part), getattr(again, part), equal_nan=nan)
            _demand(same, f"{name} changes view.{part}; a priority only looks")
        for signal, value in view.computed.items():
            _demand(
                np.array_equal(value, again.signal(signal)), f"{name} changes the signal {signal!r}; a priority only looks"
            )
        value = raw.copy()
        priority.load_state_dict(state)
        answer = priority(_view(fleet, t, seed))
        reason = "draw random numbers from view.rng, and save all that it remembers in state_dict"
        _demand(np.array_equal(answer, value), f"{name} must give the same ranks for the same view and state; {reason}")
        _demand(np.array_equal(raw, value), f"{name} overwrites what it returned before; return a new array")
    priority.load_state_dict(before)


def _state(owner: Any, name: str) -> dict[str, Any]:
    for method in ("state_dict", "load_state_dict"):
        _demand(hasattr(owner, method), f"{name} must have {method}; one that remembers nothing has an empty state")
    state = owner.state_dict()
    _demand(isinstance(state, dict), f"{name}.state_dict must return a dictionary, got {type(state).__name__}")
    _check_tree(state, f"{name}.state_dict()")
    return copy.deepcopy(state)


def _view(fleet: Fleet | int, t: int, seed: int) -> FleetView:
    """A fleet in the middle of work, (N,) robots in all sorts of trouble; the same for the same arguments."""
    rng = stream(seed, f"checks/view/{t}")
    n = fleet if isinstance(fleet, int) else fleet.num_envs
    obs_shape: tuple[int, ...] = (8,) if isinstance(fleet, int) else fleet.single_observation_space.shape or ()
    low, high = (np.full(2, -1.0), np.ones(2)) if isinstance(fleet, int) else (fleet.action_low, fleet.action_high)
    obs = rng.standard_normal((n, *obs_shape))
    if not isinstance(fleet, int):
        obs = obs.astype(fleet.single_observation_space.dtype)
    human = rng.uniform(low, high, (n, len(low))).astype(np.float32)
    human[rng.random(n) < 0.5] = np.nan
    names = ("uncertainty", "risk", "goal", "predicted_discrepancy", "judgement")
    numbers = {signal: np.where(rng.random(n) < 0.2, 0.0, rng.random(n)) for signal in names}
    supervised = rng.random(n) < 0.3
    return FleetView(
        t=t,
        obs=obs,
        actions=rng.uniform(low, high, (n, len(low))).astype(np.float32),
        violation=rng.random(n) < 0.3,
        supervised=supervised,
        duration=rng.integers(0, 10, n),
        human_action=human,
        discrepancy=np.where(supervised, rng.random(n), np.nan),
        fresh=rng.random(n) < 0.1,
        num_humans=max(1, n // 3),
        rng=stream(seed, f"checks/priority/{t}"),
        signals={signal: lambda view, value=value: value for signal, value in numbers.items()},  # type: ignore[misc]
    )


# -- supervisors ------------------------------------------------------------------------------------------------


def check_supervisor(supervisor: Supervisor, fleet: Fleet, *, seed: int = 0) -> None:
    """Check that a supervisor keeps the promises of `Supervisor`.

    Args:
        supervisor: asked to act for all robots, for some, and for one.
        fleet: it is reset and stepped.
        seed: of the fleet's reset.

    Raises:
        ContractError: naming the broken clause.
    """
    name = type(supervisor).__name__
    _demand(isinstance(supervisor, Supervisor), f"{name} is no supervisor; it needs act(obs, robots)")
    obs = _observations(fleet, seed)
    n, low, high = fleet.num_envs, fleet.action_low, fleet.action_high
    middle, half = (low + high) / 2, (high - low) / 2
    for robots in (np.arange(n), np.arange(n)[::2], np.arange(n)[-1:]):
        seen, asked = obs[robots], robots.copy()
        given = seen.copy()
        raw = supervisor.act(given, asked)
        expected = (len(robots), len(low))
        _demand(isinstance(raw, np.ndarray), f"{name}.act must return a numpy array, got {type(raw).__name__}")
        _demand(raw.shape == expected, f"{name}.act must return shape {expected} for {len(robots)} robots, got {raw.shape}")
        _demand(np.isfinite(raw).all(), f"{name}.act returned a number that is not finite")
        _demand(np.array_equal(given, seen), f"{name}.act changes the observations that it is given; work on a copy")
        _demand(np.array_equal(asked, robots), f"{name}.act changes the indices that it is given; work on a copy")
        far = float((np.abs(raw - middle) / half).max())
        message = f"{name}.act commands {far:.0f} times half the action range; commands are in the units of the action space"
        _demand(far <= _REACH, message)
    if hasattr(supervisor, "state_dict"):
        state = _state(supervisor, name)
        first = np.array(supervisor.act(obs, np.arange(n)))
        supervisor.load_state_dict(state)  # type: ignore[attr-defined]
        second = supervisor.act(obs, np.arange(n))
        _demand(np.array_equal(first, second), f"{name}.load_state_dict(state_dict()) must give the same actions again")
        supervisor.load_state_dict(state)  # type: ignore[attr-defined]
