"""The contract of a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.checks.shared import demand, observations
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy

Array = NDArray[Any]

_RTOL, _ATOL = 1e-3, 1e-4  # of the action range: batched float32 products differ in the last digits with the batch


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
    demand(isinstance(policy, Policy), f"{name} is no policy; it needs act(obs)")
    obs = observations(fleet, seed)
    width, scale = len(fleet.action_low), float((fleet.action_high - fleet.action_low).max())
    _check_rowwise(policy.act, f"{name}.act", obs, (width,), scale, seed)
    uncertainty = getattr(policy, "uncertainty", None)
    if uncertainty is not None:
        value = _check_rowwise(uncertainty, f"{name}.uncertainty", obs, (), None, seed)
        demand((value >= 0).all(), f"{name}.uncertainty must be >= 0, got {value.min()}")


def _check_rowwise(
    ask: Callable[[Array], Array], name: str, obs: Array, row: tuple[int, ...], scale: float | None, seed: int
) -> Array:
    """A function of each robot's observation alone: right shape, finite, repeatable, whatever stands in the other rows."""
    n = len(obs)
    given = obs.copy()
    raw = ask(given)
    demand(isinstance(raw, np.ndarray), f"{name} must return a numpy array, got {type(raw).__name__}")
    demand(raw.shape == (n, *row), f"{name} must return shape {(n, *row)}, got {raw.shape}")
    demand(raw.dtype.kind == "f", f"{name} must return floats, got {raw.dtype}")
    demand(np.isfinite(raw).all(), f"{name} returned a number that is not finite")
    demand(np.array_equal(given, obs), f"{name} changes the observations that it is given; work on a copy")
    value = raw.copy()
    repeated = np.array_equal(ask(obs.copy()), value)
    demand(repeated, f"{name} must be deterministic: the same observations gave other numbers the second time")
    atol = _ATOL * (scale if scale is not None else max(1.0, float(np.abs(value).max())))
    shuffled = np.random.default_rng(seed).permutation(n)[::-1]
    for rows, what in ((shuffled, "in another order"), (np.arange(1), "alone"), (np.repeat(np.arange(n), 2), "twice")):
        answer = ask(obs[rows])
        good = answer.shape == (len(rows), *row) and np.allclose(answer, value[rows], rtol=_RTOL, atol=atol)
        demand(good, f"{name} must look at each robot's observation alone: robots presented {what} got other answers")
    demand(np.array_equal(raw, value), f"{name} overwrites what it returned before; return a new array")
    return value
