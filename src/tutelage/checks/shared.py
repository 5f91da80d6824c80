"""What the checks have in common."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ContractError
from tutelage.fleet.fleet import Fleet

Array = NDArray[Any]


def demand(clause: bool | np.bool_, message: str) -> None:
    """Refuse what does not keep the clause.

    Raises:
        ContractError: with the message.
    """
    if not clause:
        raise ContractError(message)


def random_actions(fleet: Fleet, rng: np.random.Generator) -> Array:
    """Within the bounds, (N, A) float32."""
    low, high = fleet.action_low, fleet.action_high
    return rng.uniform(low, high, (fleet.num_envs, len(low))).astype(np.float32)


def observations(fleet: Fleet, seed: int, steps: int = 5) -> Array:
    """Some that the fleet shows under random actions, (N, ...)."""
    rng = np.random.default_rng(seed)
    obs, _ = fleet.reset(seed=seed)
    for _ in range(steps):
        obs = fleet.step(random_actions(fleet, rng))[0]
    return np.array(obs)


def check_tree(tree: Any, path: str) -> None:
    """Demand that a state, which is called `path` in messages, holds nothing but arrays and JSON values."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            demand(isinstance(key, str) and "/" not in key, f"{path}: keys must be strings without '/', got {key!r}")
            check_tree(value, f"{path}[{key!r}]")
    elif isinstance(tree, list | tuple):
        for k, value in enumerate(tree):
            check_tree(value, f"{path}[{k}]")
    else:
        plain = tree is None or isinstance(tree, bool | int | float | str)
        array = isinstance(tree, np.ndarray) and tree.dtype != object
        demand(plain or array, f"{path} must hold arrays and JSON values only, got {type(tree).__name__}")


def saved_state(owner: Any, name: str) -> dict[str, Any]:
    """A copy of the state of a priority or a supervisor, which is called `name` in messages."""
    for method in ("state_dict", "load_state_dict"):
        demand(hasattr(owner, method), f"{name} must have {method}; one that remembers nothing has an empty state")
    state = owner.state_dict()
    demand(isinstance(state, dict), f"{name}.state_dict must return a dictionary, got {type(state).__name__}")
    check_tree(state, f"{name}.state_dict()")
    return copy.deepcopy(state)
