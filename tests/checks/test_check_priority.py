"""check_priority passes what keeps the contract and names the clause that is broken."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes import FakePriority, Good, count

from tutelage.checks import check_priority
from tutelage.errors import ContractError
from tutelage.fleet.priority import parse


class Rank(FakePriority):
    """A priority of one line that returns just what it computes."""

    def __call__(self, view: Any) -> Any:
        return self.rank(view)


def spoil(view: Any) -> Any:
    view.violation[:] = True
    return np.ones((view.num_robots, 1))


def spoil_signal(view: Any) -> Any:
    view.risk[:] = 0.5
    return np.ones((view.num_robots, 1))


@pytest.mark.parametrize("text", ["C.", "C.U.R.", "U.C.", "U.G.C.", "U.G.", "R.U.C.", "Random.C.", "Random."])
@pytest.mark.parametrize("fleet", [5, Good()], ids=["5 robots", "a fleet"])
def test_the_priorities_of_the_dissertation_pass(text: str, fleet: Any) -> None:
    check_priority(parse(text), fleet)


def test_checking_a_priority_leaves_no_trace() -> None:
    priority = parse("U.G.C.")
    before = priority.state_dict()
    check_priority(priority, 6)
    after = priority.state_dict()
    assert before["0"]["count"] == after["0"]["count"]
    assert np.array_equal(before["0"]["mean"], after["0"]["mean"])


@pytest.mark.parametrize(
    ("rank", "message"),
    [
        (lambda view: view.uncertainty, r"must return shape \(6, K\) with K >= 1, got \(6,\)"),
        (lambda view: np.zeros((6, 0)), "K >= 1"),
        (lambda view: [[1.0]] * 6, "must return a numpy array, got list"),
        (lambda view: view.violation[:, None], "must return float64, got bool"),
        (lambda view: view.human_action[:, :1].astype(float), "returned NaN"),
        (lambda view: np.ones((6, 1 + (view.t > 0))), "the same number of columns"),
        (spoil, "changes view.violation"),
        (spoil_signal, "changes the signal 'risk'"),
        (lambda view, calls=[]: np.full((6, 1), count(calls)), "the same ranks for the same view"),
    ],
)
def test_a_broken_priority_is_told_which_clause(rank: Any, message: str) -> None:
    with pytest.raises(ContractError, match=message):
        check_priority(Rank(rank), 6)


def test_a_priority_must_have_a_state() -> None:
    with pytest.raises(ContractError, match="must have state_dict; one that remembers nothing has an empty state"):
        check_priority(lambda view: np.ones((6, 1)), 6)  # type: ignore[arg-type]
