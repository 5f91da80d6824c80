"""Priority functions p-hat: who needs a human most (section 5.4).

A priority is a string such as "C.U.R.": its letters are terms, compared lexicographically from left to right, and a robot
for which all terms are 0 asks for nobody. Every algorithm and ablation of chapter 5 is such a string:

    C.      Constraint            hard resets only
    Random. Random                a random score above a threshold
    U.C.    Fleet-EnsembleDAgger  uncertain robots, then violated ones
    U.G.C.  Fleet-ThriftyDAgger   uncertainty and risk of missing the goal as one number, then violated ones
    C.U.R.  Constraint-Uncertainty-Risk

The gates of chapters 2 and 3 are terms too, by name. "LazyDAgger" alone is "LazyDAgger.C.": who asks, then who fell.
"module:callable" is a priority of the user's own.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.gates import GATES, GateConfig
from tutelage.fleet.view import FleetView
from tutelage.objects import make_object

Array = NDArray[Any]


@runtime_checkable
class Priority(Protocol):
    """p-hat: how much each robot needs a human.

    One that looks at signals names them in an attribute `needs`, a tuple: a run makes critics for "risk" and "goal" only
    if they are named there.
    """

    def __call__(self, view: FleetView) -> Array:
        """(N, K) float64, compared lexicographically; all K <= 0: needs nobody."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What the priority remembers between steps."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        ...


@dataclass(frozen=True)
class PriorityConfig:
    """Numbers of the priority functions (table C.1). Thresholds given as a quantile are resolved before the run.

    Attributes:
        uncertainty: u-hat, uncertainty at or below it counts as 0; default: from `uncertainty_quantile`.
        risk: r-hat, likewise; default: from `risk_quantile`, or from `missed`.
        uncertainty_quantile: quantile of the uncertainty over the policy's own first steps that becomes u-hat.
        risk_quantile: likewise for r-hat.
        missed: in place of `risk_quantile`: fraction of falls of the cloned policy that may come without its risk having
            been above r-hat in the 10 timesteps before (a conformal bound, on average over calibrations); default: no such
            promise.
        initial: t_I, timesteps at the start during which constraint violations have no priority; default: what the
            task and the priority decide (only C.U.R. has such a period).
        combined: threshold of the combined score of U.G.
        goal_weight: weight of the goal term in the combined score of U.G.
        random: threshold of Random: a score in [0, 1) at or below it counts as 0.
    """

    uncertainty: float | None = None
    risk: float | None = None
    uncertainty_quantile: float = 0.9
    risk_quantile: float = 0.99
    missed: float | None = None
    initial: int | None = None
    combined: float = 3.25
    goal_weight: float = 0.25
    random: float = 0.9

    def __post_init__(self) -> None:
        for name in ("uncertainty", "risk", "combined", "goal_weight", "random"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"threshold {name} must be a finite number, got {value}")
        for name in ("uncertainty_quantile", "risk_quantile"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.missed is not None and not 0 < self.missed < 1:
            raise ConfigError(f"missed must be between 0 and 1, got {self.missed}")
        if self.initial is not None and self.initial < 0:
            raise ConfigError(f"initial (t_I) must be >= 0 timesteps, got {self.initial}")


class Constraint:
    """C: 1 for robots in violation, 0 for the others; 0 for all during the first t_I timesteps."""

    needs: tuple[str, ...] = ()

    def __init__(self, config: PriorityConfig) -> None:
        self.initial = config.initial or 0

    def __call__(self, view: FleetView) -> Array:
        return view.violation * float(view.t >= self.initial)


class Uncertainty:
    """U: the policy's uncertainty where above u-hat. A robot in violation has nothing to be uncertain about."""

    needs: tuple[str, ...] = ("uncertainty",)

    def __init__(self, config: PriorityConfig) -> None:
        self.threshold = config.uncertainty or 0.0

    def __call__(self, view: FleetView) -> Array:
        return np.where((view.uncertainty > self.threshold) & ~view.violation, view.uncertainty, 0.0)


class Risk:
    """R: the safety critic's estimate where above r-hat; 0 for robots in violation."""

    needs: tuple[str, ...] = ("risk",)

    def __init__(self, config: PriorityConfig) -> None:
        self.threshold = config.risk or 0.0

    def __call__(self, view: FleetView) -> Array:
        return np.where((view.risk > self.threshold) & ~view.violation, view.risk, 0.0)


class Goal:
    """G: the probability of missing the goal, 1 - goal critic; 0 for robots in violation."""

    needs: tuple[str, ...] = ("goal",)

    def __init__(self, config: PriorityConfig) -> None:
        del config

    def __call__(self, view: FleetView) -> Array:
        return np.where(view.violation, 0.0, 1.0 - view.goal)


class Random:
    """Random: a uniform score in [0, 1) where above the threshold, drawn anew for each robot at each timestep."""

    needs: tuple[str, ...] = ()

    def __init__(self, config: PriorityConfig) -> None:
        self.threshold = config.random
        if not 0 <= self.threshold <= 1:
            raise ConfigError(f"the threshold of Random must be between 0 and 1, got {self.threshold}")

    def __call__(self, view: FleetView) -> Array:
        score = view.rng.random(view.num_robots)
        return np.where(score > self.threshold, score, 0.0)


class UncertaintyGoal:
    """U.G.: z-scores of uncertainty and of 1 - goal critic, added with a weight, where above a threshold.

    Means and standard deviations are running ones over all autonomous, unviolated robots so far.
    """

    needs: tuple[str, ...] = ("uncertainty", "goal")

    def __init__(self, config: PriorityConfig) -> None:
        self.threshold, self.weight = config.combined, config.goal_weight
        self.count, self.mean, self.m2 = 0.0, np.zeros(2), np.zeros(2)

    def __call__(self, view: FleetView) -> Array:
        raw = np.stack([view.uncertainty, 1.0 - view.goal], axis=1)
        own = raw[~view.violation & ~view.supervised]
        if len(own):  # Chan et al.: merge the moments of this batch
            n, mean = len(own), own.mean(axis=0)
            delta, total = mean - self.mean, self.count + n
            self.m2 = self.m2 + np.square(own - mean).sum(axis=0) + np.square(delta) * self.count * n / total
            self.mean, self.count = self.mean + delta * n / total, total
        std = np.sqrt(self.m2 / max(self.count, 1.0))
        z = np.divide(raw - self.mean, std, out=np.zeros_like(raw), where=std > 0)
        score = z[:, 0] + self.weight * z[:, 1]
        return np.where((score > self.threshold) & ~view.violation, score, 0.0)

    def state_dict(self) -> dict[str, Any]:
        """The running moments."""
        return {"count": self.count, "mean": self.mean, "m2": self.m2}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.count, self.mean, self.m2 = state["count"], state["mean"].copy(), state["m2"].copy()


class Own:
    """A priority of the user's own as the only term: its columns are those of the whole.

    Args:
        name: "module:callable", for errors.
        priority: what the callable made.
    """

    def __init__(self, name: str, priority: Priority) -> None:
        self.name, self.priority = name, priority
        self.needs: tuple[str, ...] = tuple(getattr(priority, "needs", ()))

    def __call__(self, view: FleetView) -> Array:
        ranks = self.priority(view)
        if not isinstance(ranks, np.ndarray) or ranks.ndim != 2 or len(ranks) != view.num_robots or not ranks.shape[1]:
            found = ranks.shape if isinstance(ranks, np.ndarray) else type(ranks).__name__
            raise ContractError(f"priority {self.name!r} must return an array ({view.num_robots}, K), got {found}")
        return ranks

    def state_dict(self) -> dict[str, Any]:
        """What the priority remembers."""
        return self.priority.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.priority.load_state_dict(state)


TERMS: dict[str, Any] = {"C": Constraint, "U": Uncertainty, "R": Risk, "G": Goal, "Random": Random}


@dataclass
class Lexicographic:
    """Several terms, compared from left to right."""

    name: str
    terms: list[Any] = field(default_factory=list)

    @property
    def needs(self) -> set[str]:
        """The signals that the terms look at."""
        return {signal for term in self.terms for signal in term.needs}

    def __call__(self, view: FleetView) -> Array:
        columns = [term(view) for term in self.terms]
        for term, column in zip(self.terms, columns, strict=True):
            if column.shape[:1] != (view.num_robots,) or column.ndim > 2:
                raise ContractError(f"{type(term).__name__} must return ({view.num_robots},), got {column.shape}")
        # Columns stay contiguous: allocation sorts column by column.
        rows = [column[None] if column.ndim == 1 else column.T for column in columns]
        return np.concatenate(rows, dtype=np.float64).T

    def state_dict(self) -> dict[str, Any]:
        """What the terms remember, by position."""
        return {str(k): term.state_dict() for k, term in enumerate(self.terms) if hasattr(term, "state_dict")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for k, inner in state.items():
            self.terms[int(k)].load_state_dict(inner)


def parse(text: str, config: PriorityConfig | None = None, gate: GateConfig | None = None) -> Lexicographic:
    """The priority that a string such as "C.U.R." or "LazyDAgger" names. Neighbours "U.G." become one combined term.

    Args:
        text: terms with dots between them; a gate alone is followed by "C". Or "module:callable", see `own_priority`.
        config: numbers of the terms.
        gate: numbers of the gates.

    Raises:
        ConfigError: an unknown or repeated term.
    """
    config, gate = config or PriorityConfig(), gate or GateConfig()
    if ":" in text:
        return Lexicographic(text, [Own(text, own_priority(text, config))])
    if gate.doubt is None:
        gate = dataclasses.replace(gate, doubt=config.uncertainty)
    names = [part for part in text.split(".") if part]
    unknown = [name for name in names if name not in TERMS and name not in GATES]
    if not names or unknown or len(set(names)) < len(names):
        raise ConfigError(
            f"cannot read the priority {text!r}: use different terms of {', '.join(TERMS)} with dots, such as C.U.R., "
            f"or one of {', '.join(GATES)}, or your own as module:callable"
        )
    if len(names) == 1 and names[0] in GATES:
        names.append("C")
    terms: list[Any] = []
    while names:
        if names[:2] == ["U", "G"]:
            terms.append(UncertaintyGoal(config))
            names = names[2:]
        else:
            name = names.pop(0)
            terms.append(GATES[name](gate) if name in GATES else TERMS[name](config))
    return Lexicographic(text, terms)


def own_priority(name: str, config: PriorityConfig | None = None) -> Priority:
    """The priority that "module:callable" makes. The callable gets `thresholds`, a `PriorityConfig`, if it takes them.

    Before a run is prepared, thresholds that are found by quantiles are None.

    Raises:
        ConfigError: no such callable, or it needs other arguments.
        ContractError: it does not make a priority.
    """
    priority = make_object(name, "priority", thresholds=config or PriorityConfig())
    if isinstance(priority, type) or not isinstance(priority, Priority):
        wanted = "a priority, which is called with a view and has state_dict and load_state_dict"
        raise ContractError(f"priority {name!r} must return {wanted}, got {type(priority).__name__}")
    return priority
