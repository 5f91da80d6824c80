"""The contract of a priority."""

from __future__ import annotations

import numpy as np

from tutelage.checks.shared import demand, saved_state
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.priority import Priority
from tutelage.fleet.view import FleetView
from tutelage.seeding import stream


def check_priority(priority: Priority, fleet: Fleet | int, *, seed: int = 0) -> None:
    """Check that a priority function keeps the promises of `Priority`.

    It is shown made-up views in which robots are in violation, supervised, certain and uncertain.

    Args:
        priority: what it remembers is restored afterwards if it has `state_dict`.
        fleet: the fleet that it is for, or N.
        seed: of the views.

    Raises:
        ContractError: naming the broken clause.
    """
    name = getattr(priority, "name", type(priority).__name__)
    before = saved_state(priority, name)
    columns = 0
    for t in (0, 1, 1000):
        view, again = _view(fleet, t, seed), _view(fleet, t, seed)
        state = saved_state(priority, name)
        raw = priority(view)
        n = view.num_robots
        demand(isinstance(raw, np.ndarray), f"{name} must return a numpy array, got {type(raw).__name__}")
        good = raw.ndim == 2 and len(raw) == n and raw.shape[1] >= 1
        demand(good, f"{name} must return shape ({n}, K) with K >= 1, got {raw.shape}")
        demand(raw.dtype == np.float64, f"{name} must return float64, got {raw.dtype}")
        demand(not np.isnan(raw).any(), f"{name} returned NaN; a robot that needs nobody has priority 0")
        demand(columns in (0, raw.shape[1]), f"{name} must always return the same number of columns")
        columns = raw.shape[1]
        for part in ("obs", "actions", "violation", "supervised", "duration", "human_action", "discrepancy", "fresh"):
            nan = part in ("human_action", "discrepancy")  # where no human acted
            same = np.array_equal(getattr(view, part), getattr(again, part), equal_nan=nan)
            demand(same, f"{name} changes view.{part}; a priority only looks")
        for signal, value in view.computed.items():
            demand(
                np.array_equal(value, again.signal(signal)), f"{name} changes the signal {signal!r}; a priority only looks"
            )
        value = raw.copy()
        priority.load_state_dict(state)
        answer = priority(_view(fleet, t, seed))
        reason = "draw random numbers from view.rng, and save all that it remembers in state_dict"
        demand(np.array_equal(answer, value), f"{name} must give the same ranks for the same view and state; {reason}")
        demand(np.array_equal(raw, value), f"{name} overwrites what it returned before; return a new array")
    priority.load_state_dict(before)


def _view(fleet: Fleet | int, t: int, seed: int) -> FleetView:
    """A fleet in the middle of work, (N,) robots in all sorts of trouble; the same for the same arguments."""
    rng = stream(seed, f"checks/view/{t}")
    n = fleet if isinstance(fleet, int) else fleet.num_envs
    obs_shape: tuple[int, ...] = (8,) if isinstance(fleet, int) else fleet.single_observation_space.shape or ()
    low, high = (np.full(2, -1.0), np.ones(2)) if isinstance(fleet, int) else (fleet.action_low, fleet.action_high)
    obs = rng.standard_normal((n, *obs_shape))
    if not isinstance(fleet, int):
        obs = obs.astype(fleet.single_observation_space.dtype)
    human = rng.uniform(low, high, (n, len(low))).astype(np.float32)
    human[rng.random(n) < 0.5] = np.nan
    names = ("uncertainty", "risk", "goal", "predicted_discrepancy", "judgement")
    numbers = {signal: np.where(rng.random(n) < 0.2, 0.0, rng.random(n)) for signal in names}
    supervised = rng.random(n) < 0.3
    return FleetView(
        t=t,
        obs=obs,
        actions=rng.uniform(low, high, (n, len(low))).astype(np.float32),
        violation=rng.random(n) < 0.3,
        supervised=supervised,
        duration=rng.integers(0, 10, n),
        human_action=human,
        discrepancy=np.where(supervised, rng.random(n), np.nan),
        fresh=rng.random(n) < 0.1,
        num_humans=max(1, n // 3),
        rng=stream(seed, f"checks/priority/{t}"),
        signals={signal: lambda view, value=value: value for signal, value in numbers.items()},  # type: ignore[misc]
    )
