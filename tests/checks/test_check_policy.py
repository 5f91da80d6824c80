"""check_policy passes what keeps the contract and names the clause that is broken."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes import FakePolicy, Good, count, right, scribble

from tutelage.checks import check_policy
from tutelage.errors import ContractError
from tutelage.policies.ensemble import EnsemblePolicy


class Policy:
    """A policy of one line."""

    def __init__(self, act: Any, uncertainty: Any = None) -> None:
        self.act = act
        if uncertainty is not None:
            self.uncertainty = uncertainty


def test_good_policies_pass() -> None:
    fleet = Good()
    check_policy(Policy(right), fleet)
    check_policy(FakePolicy(0.5, 0.1), fleet)
    check_policy(EnsemblePolicy(4, fleet.action_low, fleet.action_high, hidden=(16,)), fleet)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Policy(lambda obs: [[0.0]] * len(obs)), "Policy.act must return a numpy array, got list"),
        (Policy(lambda obs: right(obs)[:, 0]), r"Policy.act must return shape \(4, 1\), got \(4,\)"),
        (Policy(lambda obs: np.ones((len(obs), 1), dtype=int)), "Policy.act must return floats"),
        (Policy(lambda obs: right(obs) * np.nan), "Policy.act returned a number that is not finite"),
        (Policy(scribble), "changes the observations"),
        (Policy(lambda obs, calls=[]: right(obs) + count(calls)), "must be deterministic"),
        (Policy(lambda obs: right(obs - obs.mean(axis=0))), "look at each robot's observation alone"),
        (Policy(lambda obs: right(obs) + np.arange(len(obs))[:, None]), "presented in another order"),
        (Policy(right, lambda obs: np.zeros((len(obs), 1))), r"Policy.uncertainty must return shape \(4,\)"),
        (Policy(right, lambda obs: np.full(len(obs), -1.0)), "Policy.uncertainty must be >= 0"),
        (Policy(right, lambda obs: np.linspace(0, 1, len(obs))), "Policy.uncertainty must look at each"),
    ],
)
def test_a_broken_policy_is_told_which_clause(policy: Any, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_policy(policy, Good())


def test_a_policy_that_reuses_its_memory_is_found_out() -> None:
    class Reuses:
        memory = np.zeros((9, 1))

        def act(self, obs: Any) -> Any:
            return np.tanh(obs[:, :1], out=self.memory[: len(obs)])

    with pytest.raises(ContractError, match=r"Reuses\.act overwrites what it returned before"):
        check_policy(Reuses(), Good())
