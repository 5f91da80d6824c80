"""Everything before timestep 0: demonstrations, behaviour cloning, first critic data, thresholds (appendix C.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.tasks.base import Task
from tutelage.errors import ConfigError
from tutelage.experiments.assemble import Assembly, fleet_of
from tutelage.experiments.config import RunConfig
from tutelage.fleet.conformal import miss_threshold
from tutelage.fleet.discrepancy import discrepancy
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import parse
from tutelage.fleet.supervisor import PolicySupervisor
from tutelage.policies.kinds import kinds_of
from tutelage.seeding import derive, stream

Array = NDArray[Any]
Report = Callable[[str, float], None]
"""Told what is being prepared, and how much of it is done (0 to 1)."""
AHEAD = 10
"""A fall is asked about in time if the risk was above r-hat in one of so many timesteps before it."""


def prepare(assembly: Assembly, report: Report = lambda what, done: None) -> Assembly:
    """Demonstrate, clone, calibrate; returns the assembly with resolved thresholds."""
    c, learner, policy = assembly.config, assembly.learner, assembly.policy
    report("recording demonstrations", 0.0)
    shown = demonstrations(c, assembly.actor, assembly.fleet.horizon)
    obs, actions = shown.obs, shown.actions
    policy.set_normalisation(obs)
    held_out = np.zeros(len(obs), dtype=bool)
    if learner.classifier:  # 70 % for the policy, 30 % for the classifier (appendix A.1)
        held_out[stream(c.seed, "held out").permutation(len(obs))[: round(0.3 * len(obs))]] = True
        learner.classifier.held_out.add(obs[held_out], actions[held_out])
    learner.dataset.add(obs[~held_out], actions[~held_out])
    _in_steps(c.learner.pretrain, learner.gradient_steps, "behaviour cloning", report)

    needs = parse(c.priority, gate=c.gate).needs
    offline = discrepancy(policy.act(obs), actions, assembly.fleet.action_low, assembly.fleet.action_high)
    if c.gate.beta_h is None:
        c = dataclasses.replace(c, gate=dataclasses.replace(c.gate, beta_h=float(np.quantile(offline, 1 - c.gate.unsafe))))
    if learner.classifier:
        learner.classifier.beta_h = c.gate.beta_h or 0.0
        learner.classifier.warn_if_blind()
        _in_steps(c.learner.pretrain, learner.classifier.updates, "discrepancy classifier", report)
    if needs & {"uncertainty", "risk", "goal"}:
        signals = _calibrate(assembly, report)
        if goal := learner.critics.get("goal"):  # eq. 3.6 is over D_r and D_h; a risk critic would learn nothing from calm
            goal.add(obs, actions, shown.next_obs, shown.success, end=shown.success)
        for name, critic in learner.critics.items():
            _in_steps(c.critic.pretrain, critic.updates, f"{name} critic", report)
            signals[name] = np.concatenate([critic(o, a) for o, a in signals["visited"]])
        if c.thresholds.missed is not None and c.thresholds.risk is None and "risk" in learner.critics:
            falls = _risk_before_falls(assembly, report)
            bound = max(0.0, miss_threshold(falls, c.thresholds.missed))  # 0, always ask: too few falls for a promise
            c = dataclasses.replace(c, thresholds=dataclasses.replace(c.thresholds, risk=bound))
        c = _resolve_gate(_resolve_thresholds(c, signals), signals, offline)
    return dataclasses.replace(assembly, config=c)


class Demonstrations(NamedTuple):
    """n transitions of the human: obs, next_obs (n, D) float32 or (n, H, W, 3) uint8, actions (n, A), success (n,) bool.

    Success: the goal was reached in this step.
    """

    obs: Array
    actions: Array
    next_obs: Array
    success: Array


def demonstrations(config: RunConfig, actor: Policy, horizon: int) -> Demonstrations:
    """Offline data of the human, as many pairs as `config` says. Whole episodes, one a robot; falls are left out.

    Where there is a goal an episode ends with it, those that do not reach it are left out too, and robots demonstrate again
    until there are pairs enough.
    """
    wanted = config.offline_pairs or Task.offline_pairs
    episodes = max(1, round(wanted / horizon))
    length = min(horizon, -(-wanted // episodes))
    spare = episodes + 2 + episodes // 4  # the human repeats a demonstration that failed
    spare += -spare % len(kinds_of(actor))  # as many of one kind of human as of the other
    # A fleet of the user's own need not know levels; a run on one that does has a level by now.
    level = None if config.disturbance is None else config.offline_disturbance
    fleet = fleet_of(config, spare, level)
    human, goal = PolicySupervisor(actor, fleet), fleet.goal_conditioned
    seed: int | None = derive(config.seed, "demonstrations") % 2**32
    episodes_of: list[Demonstrations] = []
    while sum(len(part.obs) for part in episodes_of) < wanted:
        obs, _ = fleet.reset(seed=seed)
        seen, done, after, ends, failed = _episodes(fleet, human, obs, horizon if goal else length)
        good = np.flatnonzero(~failed)
        if len(good) < (1 if goal else episodes):
            what = "did not reach the goal" if goal else "fell"
            calm = level in (None, "none")
            mend = "name a better one: --expert" if calm else "choose a calmer level: --offline-disturbance"
            raise ConfigError(f"the expert {what} in {int(failed.sum())} of {spare} demonstrations; {mend}")
        good = good if goal else good[:episodes]
        for robot in good:
            end = ends[robot]
            reached = np.arange(1, end + 1) == end if goal else np.zeros(end, dtype=bool)
            episodes_of.append(Demonstrations(seen[:end, robot], done[:end, robot], after[:end, robot], reached))
        seed = None
    fleet.close()
    return Demonstrations(*(np.concatenate(part)[:wanted] for part in zip(*episodes_of, strict=True)))


def _episodes(fleet: Fleet, human: Policy, obs: Array, length: int) -> tuple[Array, Array, Array, Array, Array]:
    """One episode of the human on each robot, from `obs`, of at most so many timesteps.

    Returns:
        obs (T, N, D) float32 or (T, N, H, W, 3) uint8, actions (T, N, A), next_obs like obs, the timesteps of each robot
        (N,), and whether it failed (N,).
    """
    ends = np.full(fleet.num_envs, length)
    complete = np.zeros(fleet.num_envs, dtype=bool)
    seen, done = [], []
    for t in range(length):
        action = human.act(obs)
        seen.append(obs)
        done.append(action)
        obs, _, _, _, info = fleet.step(action)
        if fleet.goal_conditioned:
            ends[info["success"] & ~complete] = t + 1
            complete = complete | info["success"]
            if (complete | info["violation"]).all():
                break
    failed = ~complete if fleet.goal_conditioned else info["violation"]
    states = np.stack([*seen, obs])
    if states.dtype != np.uint8:  # images are kept as bytes
        states = states.astype(np.float32)
    return states[:-1], np.stack(done), states[1:], ends, failed


def _calibrate(assembly: Assembly, report: Report) -> dict[str, Any]:
    """Run the cloned policy alone; whoever falls or ends starts again at once. Feeds the critics, returns what it felt."""
    c, policy = assembly.config, assembly.policy
    fleet = assembly.fleet
    obs, _ = fleet.reset(seed=derive(c.seed, "calibration") % 2**32)
    uncertainty, visited = [], []
    for t in range(c.calibration_steps):
        actions = policy.act(obs)
        uncertainty.append(policy.uncertainty(obs))
        visited.append((obs, actions))
        after, _, violation, truncated, info = fleet.step(actions)
        for name, critic in assembly.learner.critics.items():
            event = violation if name == "risk" else info["success"]
            critic.add(obs, actions, after, event, end=violation)
        obs = after
        over = violation | truncated | info["success"]
        if over.any():
            obs, _ = fleet.reset(options={"reset_mask": over})
        report("the cloned policy alone", (t + 1) / c.calibration_steps)
    return {"uncertainty": np.concatenate(uncertainty), "visited": visited}


def _risk_before_falls(assembly: Assembly, report: Report) -> Array:
    """Run the cloned policy once more, on other streams: the largest risk in the last timesteps before each fall, (n,).

    The critic has not learned from these falls, so they are exchangeable with those to come while the policy is the same.
    """
    c, policy, fleet, critic = assembly.config, assembly.policy, assembly.fleet, assembly.learner.critics["risk"]
    obs, _ = fleet.reset(seed=derive(c.seed, "conformal") % 2**32)
    recent, falls = np.zeros((AHEAD, fleet.num_envs)), []
    for t in range(c.calibration_steps):
        actions = policy.act(obs)
        recent[t % AHEAD] = critic(obs, actions)
        obs, _, violation, truncated, info = fleet.step(actions)
        falls.append(recent.max(axis=0)[violation])
        over = violation | truncated | info["success"]
        recent[:, over] = 0.0
        if over.any():
            obs, _ = fleet.reset(options={"reset_mask": over})
        report("falls of the cloned policy", (t + 1) / c.calibration_steps)
    return np.concatenate(falls)


def _resolve_thresholds(config: RunConfig, signals: dict[str, Any]) -> RunConfig:
    """Quantiles of the policy's own first steps become the thresholds that were not given as numbers."""
    t = config.thresholds
    found: dict[str, Any] = {
        name: float(np.quantile(signals[name], getattr(t, f"{name}_quantile")))
        for name in ("uncertainty", "risk")
        if getattr(t, name) is None and name in signals
    }
    return dataclasses.replace(config, thresholds=dataclasses.replace(t, **found))


def _resolve_gate(config: RunConfig, signals: dict[str, Any], offline: Array) -> RunConfig:
    """The thresholds with which ThriftyDAgger begins (section 3.4), where they were not given as numbers."""
    gate, q = config.gate, 1 - config.gate.alpha
    risk = 1.0 - signals["goal"] if "goal" in signals else np.zeros(1)
    found: dict[str, Any] = {
        "novelty": float(np.quantile(signals["uncertainty"], q)),
        "risk_ask": float(np.quantile(risk, q)),
        "risk_cede": float(np.median(risk)),
        "mean_discrepancy": float(offline.mean()),
    }
    missing = {name: value for name, value in found.items() if getattr(gate, name) is None}
    return dataclasses.replace(config, gate=dataclasses.replace(gate, **missing))


def _in_steps(total: int, work: Callable[[int], Any], name: str, report: Report, chunk: int = 50) -> None:
    for done in range(0, total, chunk):
        report(name, done / total)
        work(min(chunk, total - done))
