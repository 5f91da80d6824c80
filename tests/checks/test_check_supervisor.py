"""check_supervisor passes what keeps the contract and names the clause that is broken."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes import FakePolicy, FakeSupervisor, Good, right, scribble

from tutelage.checks import check_supervisor
from tutelage.errors import ContractError
from tutelage.fleet.supervisor import NoisySupervisor, PolicySupervisor


class Person:
    """A supervisor of one line."""

    def __init__(self, act: Any) -> None:
        self.act = act


def renumber(obs: Any, robots: Any) -> Any:
    robots[:] = 0
    return right(obs)


def test_good_supervisors_pass() -> None:
    fleet = Good()
    check_supervisor(FakeSupervisor(), fleet)
    inner = PolicySupervisor(FakePolicy(0.2))
    check_supervisor(inner, fleet)
    check_supervisor(NoisySupervisor(inner, 0.3, np.random.default_rng(0)), fleet)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda obs, robots: 0.0, "Person.act must return a numpy array, got float"),
        (lambda obs, robots: np.zeros((4, 1)), r"must return shape \(2, 1\) for 2 robots, got \(4, 1\)"),
        (lambda obs, robots: right(obs) * np.inf, "not finite"),
        (lambda obs, robots: np.full((len(obs), 1), 90.0), "commands 90 times half the action range"),
        (lambda obs, robots: scribble(obs), "changes the observations"),
        (renumber, "changes the indices"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_broken_supervisor_is_told_which_clause(act: Any, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_supervisor(Person(act), Good())


def test_a_supervisor_whose_state_is_not_all_of_it_is_found_out() -> None:
    class Trembling(FakeSupervisor):
        def act(self, obs: Any, robots: Any) -> Any:
            return super().act(obs, robots) + 1e-3 * len(self.seen)

        def state_dict(self) -> dict[str, Any]:
            return {}

        def load_state_dict(self, state: dict[str, Any]) -> None:
            pass

    with pytest.raises(ContractError, match="must give the same actions again"):
        check_supervisor(Trembling(), Good())
