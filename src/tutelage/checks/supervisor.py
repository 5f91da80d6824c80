"""The contract of a supervisor."""

from __future__ import annotations

import numpy as np

from tutelage.checks.shared import demand, observations, saved_state
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.supervisor import Supervisor

_REACH = 10.0  # a human's command further from the middle of the bounds, in halves of their width, is a mistake of units


def check_supervisor(supervisor: Supervisor, fleet: Fleet, *, seed: int = 0) -> None:
    """Check that a supervisor keeps the promises of `Supervisor`.

    Args:
        supervisor: asked to act for all robots, for some, and for one.
        fleet: it is reset and stepped.
        seed: of the fleet's reset.

    Raises:
        ContractError: naming the broken clause.
    """
    name = type(supervisor).__name__
    demand(isinstance(supervisor, Supervisor), f"{name} is no supervisor; it needs act(obs, robots)")
    obs = observations(fleet, seed)
    n, low, high = fleet.num_envs, fleet.action_low, fleet.action_high
    middle, half = (low + high) / 2, (high - low) / 2
    for robots in (np.arange(n), np.arange(n)[::2], np.arange(n)[-1:]):
        seen, asked = obs[robots], robots.copy()
        given = seen.copy()
        raw = supervisor.act(given, asked)
        expected = (len(robots), len(low))
        demand(isinstance(raw, np.ndarray), f"{name}.act must return a numpy array, got {type(raw).__name__}")
        demand(raw.shape == expected, f"{name}.act must return shape {expected} for {len(robots)} robots, got {raw.shape}")
        demand(np.isfinite(raw).all(), f"{name}.act returned a number that is not finite")
        demand(np.array_equal(given, seen), f"{name}.act changes the observations that it is given; work on a copy")
        demand(np.array_equal(asked, robots), f"{name}.act changes the indices that it is given; work on a copy")
        far = float((np.abs(raw - middle) / half).max())
        message = f"{name}.act commands {far:.0f} times half the action range; commands are in the units of the action space"
        demand(far <= _REACH, message)
    if hasattr(supervisor, "state_dict"):
        state = saved_state(supervisor, name)
        first = np.array(supervisor.act(obs, np.arange(n)))
        supervisor.load_state_dict(state)  # type: ignore[attr-defined]
        second = supervisor.act(obs, np.arange(n))
        demand(np.array_equal(first, second), f"{name}.load_state_dict(state_dict()) must give the same actions again")
        supervisor.load_state_dict(state)  # type: ignore[attr-defined]
