"""Weights on disk and in memory: parameters as plain arrays, with a card that says where they come from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from tutelage.errors import ContractError
from tutelage.store import load_tree, save_tree


def module_state(module: torch.nn.Module) -> dict[str, Any]:
    """All parameters and buffers as arrays (copies)."""
    return {name: p.detach().clone().numpy() for name, p in module.state_dict().items()}


def load_module_state(module: torch.nn.Module, state: dict[str, Any]) -> None:
    """Restore what `module_state` returned, in place.

    Raises:
        ContractError: a name or a shape does not fit.
    """
    try:
        module.load_state_dict({name: torch.from_numpy(np.array(p)) for name, p in state.items()})
    except (RuntimeError, TypeError, ValueError) as error:  # the last two: not an array of numbers
        lines = [line.strip() for line in str(error).splitlines()]
        said = lines[1] if lines[1:] else lines[0]
        raise ContractError(f"these weights do not fit {type(module).__name__}: {said}") from None


def save_policy(path: Path, policy: torch.nn.Module, card: dict[str, Any]) -> None:
    """Write a policy as safetensors. card: JSON values: what it is, the command, seed, steps and scores that made it."""
    save_tree(path, {"weights": module_state(policy), "card": {**card, "kind": type(policy).__name__}})


def load_weights(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read weights and card of a policy of the given kind (the name of its class).

    Raises:
        TutelageError: no such file, or a damaged one.
        ContractError: the file holds something else.
    """
    tree = load_tree(path)
    weights, card = tree.get("weights"), tree.get("card")
    found = card.get("kind") if isinstance(weights, dict) and isinstance(card, dict) else None
    if found != kind:
        raise ContractError(f"{path} holds {found or 'no policy'}, not {kind}")
    return weights, card  # type: ignore[return-value]
