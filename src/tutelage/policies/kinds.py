"""Humans who do not act alike (section 6.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.policy import Policy

Array = NDArray[Any]


class Kinds:
    """Several kinds of humans. A team gives each of its humans one kind in turn; human j is of kind j mod K.

    As a policy of a whole fleet, kind i mod K drives robot i: that is how they demonstrate, and how they are scored.

    Args:
        policies: one for each kind.
    """

    def __init__(self, policies: Sequence[Policy]) -> None:
        if not policies:
            raise ConfigError("name at least one kind of human")
        self.policies = tuple(policies)

    def act(self, obs: Array) -> Array:
        """Actions (N, A) for the observations (N, ...) of all robots, in their order."""
        kind = np.arange(len(obs)) % len(self.policies)
        parts = [np.asarray(policy.act(obs[kind == k])) for k, policy in enumerate(self.policies)]
        actions = np.empty((len(obs), *parts[0].shape[1:]), dtype=parts[0].dtype)
        for k, part in enumerate(parts):
            actions[kind == k] = part
        return actions


def kinds_of(policy: Policy) -> tuple[Policy, ...]:
    """The kinds of humans that a policy stands for: itself, where there is one only."""
    return policy.policies if isinstance(policy, Kinds) else (policy,)
