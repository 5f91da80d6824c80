"""Adam whose state is plain arrays, so that it can be saved without pickle and resumed bit for bit."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


def adam(parameters: Iterable[Tensor], learning_rate: float) -> torch.optim.Adam:
    """Adam in its fastest CPU form: one fused kernel for all parameters."""
    return torch.optim.Adam(list(parameters), lr=learning_rate, fused=True)


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """The moments of each parameter, by position (copies)."""
    state = optimiser.state_dict()["state"]
    return {str(i): {k: v.detach().clone().numpy() for k, v in moments.items()} for i, moments in state.items()}


def load_optimiser_state(optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore what `optimiser_state` returned."""
    whole = optimiser.state_dict()
    whole["state"] = {int(i): {k: torch.from_numpy(v.copy()) for k, v in m.items()} for i, m in state.items()}
    optimiser.load_state_dict(whole)
