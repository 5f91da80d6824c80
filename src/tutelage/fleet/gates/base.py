"""When does a robot ask for a human, and when does it give control back? What all answers share.

A gate is a priority with hysteresis: one rule to ask, a stricter one to give back. It works for one robot and one human as
in chapters 2 and 3, and for a fleet: a robot that has a human keeps that human until it gives back, before any other asks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.view import FleetView

Array = NDArray[Any]


@dataclass(frozen=True)
class GateConfig:
    """Numbers of the gates. Discrepancies are fractions of the largest possible one; see `discrepancy`.

    Attributes:
        beta_h: beta_H of SafeDAgger and LazyDAgger: an action discrepancy at or above it is unsafe; default: the one that
            marks `unsafe` of the offline data.
        unsafe: fraction of the offline data that counts as unsafe (0.2: Zhang and Cho; section 2.6).
        beta_r: beta_R of LazyDAgger, as a fraction of beta_H (table A.1: 1/10 or 1/2). Below 1.
        ask_again: give control back by the classifier alone, LazyDAgger (-Switch to Auto).
        noise: sigma^2 that LazyDAgger injects into the human's actions, in units of half the action range; 0: (-Noise).
        alpha: alpha_h of ThriftyDAgger: the desired fraction of timesteps with a request. In (0, 1).
        alpha_end: alpha_h after `alpha_over` timesteps, reached in a straight line from alpha; default: alpha_h stays.
        alpha_over: how long that takes.
        without: a signal that ThriftyDAgger is to do without, "novelty" or "risk" (its two ablations); default: none.
        novelty: delta_h with which ThriftyDAgger begins; default: from the first steps of the cloned policy.
        risk_ask: likewise beta_H.
        risk_cede: likewise beta_R.
        mean_discrepancy: likewise delta_r; default: from the offline data.
        history: timesteps of robots seen before ThriftyDAgger recomputes its thresholds.
        doubt: chi of EnsembleDAgger: uncertainty above it asks; default: like u-hat of the thresholds.
        reaction: timesteps that HG-DAgger's human needs to make up their mind, either way.
        span: robots that one human can watch at a time in HG-DAgger.
        dwell: timesteps that they look at the same robots.
        beta: beta of DAgger: in epoch i the human's action is executed with probability beta^i.
        epoch: timesteps of an epoch of DAgger.
    """

    beta_h: float | None = None
    unsafe: float = 0.2
    beta_r: float = 0.1
    ask_again: bool = False
    noise: float = 0.1
    alpha: float = 0.01
    alpha_end: float | None = None
    alpha_over: int = 10_000
    without: str | None = None
    novelty: float | None = None
    risk_ask: float | None = None
    risk_cede: float | None = None
    mean_discrepancy: float | None = None
    history: int = 25
    doubt: float | None = None
    reaction: int = 2
    span: int = 3
    dwell: int = 20
    beta: float = 0.0
    epoch: int = 5000

    def __post_init__(self) -> None:
        for name in ("beta_h", "novelty", "risk_ask", "risk_cede", "mean_discrepancy", "doubt"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < np.inf:
                raise ConfigError(f"gate {name} must be a number >= 0, got {value}")
        for name in ("unsafe", "alpha", "alpha_end"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) < 1:
                raise ConfigError(f"gate {name} must be between 0 and 1, got {getattr(self, name)}")
        if not 0 < self.beta_r < 1:
            raise ConfigError(f"gate beta_r (beta_R / beta_H) must be above 0 and below 1, got {self.beta_r}")
        if self.risk_ask is not None and self.risk_cede is not None and self.risk_cede > self.risk_ask:
            raise ConfigError(f"risk_cede ({self.risk_cede}) must not exceed risk_ask ({self.risk_ask})")
        if self.without not in (None, "novelty", "risk"):
            raise ConfigError(f"ThriftyDAgger can do without novelty or risk, not without {self.without!r}")
        if not 0 <= self.noise < np.inf or not 0 <= self.beta <= 1:
            raise ConfigError(f"gates need noise >= 0 and beta in [0, 1], got {self.noise} and {self.beta}")
        for name in ("alpha_over", "history", "reaction", "span", "dwell", "epoch"):
            if getattr(self, name) < 1:
                raise ConfigError(f"gate {name} must be at least 1, got {getattr(self, name)}")

    def budget(self, t: int) -> float:
        """alpha_h at timestep t."""
        if self.alpha_end is None:
            return self.alpha
        return self.alpha + (self.alpha_end - self.alpha) * min(1.0, t / self.alpha_over)


class Gate(ABC):
    """When to ask, and when to give back.

    Attributes:
        needs: the signals it looks at.
    """

    needs: tuple[str, ...] = ()

    def __init__(self, config: GateConfig) -> None:
        self.config = config

    @abstractmethod
    def ask(self, view: FleetView) -> Array:
        """How much each robot needs a human, (N,); > 0: it asks."""

    @abstractmethod
    def cede(self, view: FleetView) -> Array:
        """Which robots need the human no longer that they had in the last timestep, (N,) bool."""

    def __call__(self, view: FleetView) -> Array:
        """(N, 2): who keeps a human, then who asks. A robot in violation does neither: it needs a hard reset."""
        asks = np.where(view.violation, 0.0, self.ask(view))
        # A new episode begins autonomously (line 22 of algorithm 3), unless it begins with a request.
        ranks = np.empty((2, len(asks)))
        ranks[0] = view.supervised & ~view.violation & ((asks > 0) | ~(self.cede(view) | view.fresh))
        ranks[1] = asks
        return ranks.T
