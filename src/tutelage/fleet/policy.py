"""The shared robot policy pi_theta, and how it is updated (section 5.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from numpy.typing import NDArray

if TYPE_CHECKING:
    from tutelage.fleet.step import Step

Array = NDArray[Any]


@runtime_checkable
class Policy(Protocol):
    """The policy that all robots of a fleet share."""

    def act(self, obs: Array) -> Array:
        """Actions for a batch of observations: (N, ...) -> (N, A)."""
        ...


@runtime_checkable
class UncertainPolicy(Policy, Protocol):
    """A policy that knows how unsure it is (needed by the term U)."""

    def uncertainty(self, obs: Array) -> Array:
        """How unsure the policy is about each robot's action, (N,), >= 0."""
        ...


@runtime_checkable
class Learner(Protocol):
    """The update function f of eq. 5.3: keeps the data, improves the policy."""

    def record(self, step: Step) -> None:
        """Take in what happened in a timestep: human actions become training data."""
        ...

    def update(self, t: int) -> dict[str, float]:
        """Improve the policy according to the schedule; returns losses by name (empty: nothing was due)."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        ...


@runtime_checkable
class PromptLearner(Learner, Protocol):
    """A learner that need not wait for the outcome of a timestep to learn from what humans said in it.

    `record` and `update` follow and do the rest, so that the result is the same as if they had done all.
    """

    def hear(self, t: int, obs: Array, wanted: Array) -> None:
        """Take in what humans want of n robots in timestep t, obs (n, ...) and wanted (n, A), before the robots move."""
        ...

    def begin(self, t: int) -> None:
        """Start to learn in the background from all data so far. What the policy says stays the same until `update`."""
        ...
