"""From a configuration to a loop that is ready to run: fleet, humans, demonstrations, policy, critics, thresholds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.cores import available_cores, default_torch_threads
from tutelage.envs import experts
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.registry import find_task, make_fleet
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import MujocoTask
from tutelage.errors import ConfigError, ContractError
from tutelage.experiments.config import RunConfig
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.discrepancy import discrepancy
from tutelage.fleet.execution import BetaMixture, Execution, NoiseInjection
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.gates import DAgger, LazyDAgger
from tutelage.fleet.loop import Loop
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import Lexicographic, parse
from tutelage.fleet.supervisor import NoisySupervisor, PolicySupervisor, Supervisor, Team
from tutelage.fleet.view import Signal
from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.critic import Critic
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.expert import GaussianActor
from tutelage.seeding import derive, stream

Array = NDArray[Any]
Report = Callable[[str, float], None]
"""Told what is being prepared, and how much of it is done (0 to 1)."""


@dataclass
class Assembly:
    """The parts of a run, before anything is learned."""

    config: RunConfig
    fleet: Fleet
    actor: Policy
    policy: EnsemblePolicy
    learner: ImitationLearner

    def loop(self, frozen: Policy | None = None) -> Loop:
        """The loop over these parts; thresholds must be resolved.

        frozen: act with this policy instead, and learn nothing: an evaluation, on random streams that training never uses.
        """
        c = self.config
        priority = parse(c.priority, c.thresholds, c.gate)
        if "goal" in priority.needs and not self.fleet.goal_conditioned:
            raise ConfigError(f"{c.priority} needs a task with a goal, and {c.task} has none; use C.U.R. or U.C.")
        supervisor: Supervisor = PolicySupervisor(self.actor)
        if c.supervisor_noise:
            sigma = c.supervisor_noise * float((self.fleet.action_high - self.fleet.action_low).mean() / 2)
            supervisor = NoisySupervisor(supervisor, sigma, stream(c.seed, "supervisor noise"))
        team, omega = Team([supervisor] * c.humans, c.latency), FleetDAgger(c.t_teleop, c.t_reset)
        signals = self._signals()
        if frozen is not None:
            return Loop(self.fleet, frozen, priority, team, omega, signals=signals, seed=derive(c.seed, "evaluation"))
        return Loop(
            self.fleet, self.policy, priority, team, omega, self.learner, signals,
            execution=self._execution(priority), overlap=c.overlap, seed=c.seed,
        )  # fmt: skip

    def _signals(self) -> dict[str, Signal]:
        """What the critics, the classifier and the humans' own judgement say."""
        low, high = self.fleet.action_low, self.fleet.action_high
        signals = {name: _estimate(critic) for name, critic in self.learner.critics.items()}
        signals["judgement"] = lambda view: discrepancy(view.actions, self.actor.act(view.obs), low, high)
        if classifier := self.learner.classifier:
            signals["predicted_discrepancy"] = lambda view: classifier(view.obs)
        return signals

    def _execution(self, priority: Lexicographic) -> Execution | None:
        """LazyDAgger injects noise, DAgger mixes; all others execute what the humans want."""
        c, kinds = self.config, {type(term) for term in priority.terms}
        if LazyDAgger in kinds and c.gate.noise:
            noise = stream(c.seed, "injected noise")
            return NoiseInjection(c.gate.noise, self.fleet.action_low, self.fleet.action_high, noise)
        return BetaMixture(c.gate.beta, c.gate.epoch, stream(c.seed, "DAgger mixture")) if DAgger in kinds else None


def assemble(config: RunConfig) -> Assembly:
    """Make the parts of a run. Nothing is trained yet.

    Raises:
        ConfigError: an unknown task, level or priority, or a combination that cannot work.
    """
    find_task(config.task)
    config = _resolve_defaults(config)
    torch.set_num_threads(config.torch_threads or 1)
    priority = parse(config.priority, config.thresholds, config.gate)
    actor = _expert(config)
    fleet = make_fleet(config.task, config.robots, disturbance=config.disturbance, threads=config.threads)

    width = fleet.single_observation_space.shape[0]  # type: ignore[index]
    actions = len(fleet.action_low)
    if isinstance(actor, GaussianActor) and (actor.features > width or len(actor.low) != actions):
        raise ContractError(
            f"the expert {config.expert} sees {actor.features} numbers and gives {len(actor.low)} actions, "
            f"but {config.task} shows {width} and takes {actions}; train one with: tutelage train-expert {config.task}"
        )
    if config.task in TASKS and isinstance(fleet, MujocoFleet) and not fleet.goal_conditioned:
        fleet.success_return = _success_return(config, actor)
    policy = EnsemblePolicy(
        width, fleet.action_low, fleet.action_high,
        members=config.members, hidden=config.hidden, seed=derive(config.seed, "policy/initial weights"),
    )  # fmt: skip
    dataset = AggregatedDataset((width,), actions, config.members, stream(config.seed, "dataset"), config.bootstrap)
    scale = (policy.obs_mean, policy.obs_std, policy.action_middle, policy.action_half)
    critics = {
        name: Critic(width, actions, "bad" if name == "risk" else "good", policy, config.critic, scale,
                     stream(config.seed, f"critic/{name}"), derive(config.seed, f"critic/{name}/initial weights"))
        for name in sorted(priority.needs & {"risk", "goal"})
    }  # fmt: skip
    classifier = None
    if "predicted_discrepancy" in priority.needs:
        classifier = DiscrepancyClassifier(
            policy, dataset, stream(config.seed, "classifier"), derive(config.seed, "classifier/initial weights"),
            beta_h=np.nan if config.gate.beta_h is None else config.gate.beta_h, batch=config.learner.batch,
        )  # fmt: skip
    learner = ImitationLearner(policy, dataset, config.learner, critics, classifier, config.seed)
    return Assembly(config, fleet, actor, policy, learner)


def prepare(assembly: Assembly, report: Report = lambda what, done: None) -> Assembly:
    """Everything before timestep 0: demonstrations, behaviour cloning, first critic data, thresholds (appendix C.3)."""
    c, learner, policy = assembly.config, assembly.learner, assembly.policy
    report("recording demonstrations", 0.0)
    obs, actions = demonstrations(c, assembly.actor, assembly.fleet.horizon)
    policy.set_normalisation(obs)
    held_out = np.zeros(len(obs), dtype=bool)
    if learner.classifier:  # 70 % for the policy, 30 % for the classifier (appendix A.1)
        held_out[stream(c.seed, "held out").permutation(len(obs))[: round(0.3 * len(obs))]] = True
        learner.classifier.held_out.add(obs[held_out], actions[held_out])
    learner.dataset.add(obs[~held_out], actions[~held_out])
    _in_steps(c.learner.pretrain, learner.gradient_steps, "behaviour cloning", report)

    needs = parse(c.priority).needs
    offline = discrepancy(policy.act(obs), actions, assembly.fleet.action_low, assembly.fleet.action_high)
    if c.gate.beta_h is None:
        c = dataclasses.replace(c, gate=dataclasses.replace(c.gate, beta_h=float(np.quantile(offline, 1 - c.gate.unsafe))))
    if learner.classifier:
        learner.classifier.beta_h = c.gate.beta_h or 0.0
        learner.classifier.warn_if_blind()
        _in_steps(c.learner.pretrain, learner.classifier.updates, "discrepancy classifier", report)
    if needs & {"uncertainty", "risk", "goal"}:
        signals = _calibrate(assembly, report)
        for name, critic in learner.critics.items():
            _in_steps(c.critic.pretrain, critic.updates, f"{name} critic", report)
            signals[name] = np.concatenate([critic(o, a) for o, a in signals["visited"]])
        c = _resolve_gate(_resolve_thresholds(c, signals), signals, offline)
    return dataclasses.replace(assembly, config=c)


def demonstrations(config: RunConfig, actor: Policy, horizon: int) -> tuple[Array, Array]:
    """Offline data of the human: obs (n, D) float32, actions (n, A). Whole episodes, one a robot; falls are left out.

    Where there is a goal an episode ends with it, those that do not reach it are left out too, and robots demonstrate again
    until there are pairs enough.
    """
    wanted = config.offline_pairs or MujocoTask.offline_pairs
    episodes = max(1, round(wanted / horizon))
    length = min(horizon, -(-wanted // episodes))
    spare = episodes + 2 + episodes // 4  # the human repeats a demonstration that failed
    make = find_task(config.task)
    disturbed = config.disturbance is not None or (isinstance(make, type) and issubclass(make, MujocoTask))
    level = config.offline_disturbance if disturbed else None  # a fleet of the user's own need not know levels
    fleet = make_fleet(config.task, spare, disturbance=level, threads=config.threads)
    goal = fleet.goal_conditioned
    seed: int | None = derive(config.seed, "demonstrations") % 2**32
    pairs: list[tuple[Array, Array]] = []
    while sum(len(seen) for seen, _ in pairs) < wanted:
        obs, _ = fleet.reset(seed=seed)
        seen, done, ends, failed = _episodes(fleet, actor, obs, horizon if goal else length)
        good = np.flatnonzero(~failed)
        if len(good) < (1 if goal else episodes):
            what = "did not reach the goal" if goal else "fell"
            raise ConfigError(f"the expert {what} in {int(failed.sum())} of {spare} demonstrations; choose a calmer level")
        good = good if goal else good[:episodes]
        pairs += [(seen[: ends[robot], robot], done[: ends[robot], robot]) for robot in good]
        seed = None
    fleet.close()
    all_seen, all_done = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return all_seen[:wanted], all_done[:wanted]


def _episodes(fleet: Fleet, actor: Policy, obs: Array, length: int) -> tuple[Array, Array, Array, Array]:
    """One episode of the human on each robot, from `obs`, of at most so many timesteps.

    Returns:
        obs (T, N, D) float32, actions (T, N, A), the timesteps of each robot (N,), and whether it failed (N,).
    """
    ends = np.full(fleet.num_envs, length)
    complete = np.zeros(fleet.num_envs, dtype=bool)
    seen, done = [], []
    for t in range(length):
        action = actor.act(obs)
        seen.append(obs.astype(np.float32))
        done.append(action)
        obs, _, _, _, info = fleet.step(action)
        if fleet.goal_conditioned:
            ends[info["success"] & ~complete] = t + 1
            complete = complete | info["success"]
            if (complete | info["violation"]).all():
                break
    failed = ~complete if fleet.goal_conditioned else info["violation"]
    return np.stack(seen), np.stack(done), ends, failed


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


def _resolve_defaults(config: RunConfig) -> RunConfig:
    """Fill in what the task and the priority decide."""
    changes: dict[str, Any] = {}
    t = config.thresholds
    task = TASKS.get(config.task)
    if config.disturbance is None and task:
        changes["disturbance"] = task.disturbance
    if config.offline_pairs is None:
        changes["offline_pairs"] = (task or MujocoTask).offline_pairs
    if t.initial is None:
        initial = task.initial_period if task and config.priority.strip(".") == "C.U.R" else 0
        changes["thresholds"] = dataclasses.replace(t, initial=initial)
    if config.torch_threads is None:
        changes["torch_threads"] = 1 if config.overlap else default_torch_threads()
    if config.threads is None and config.overlap and task:
        changes["threads"] = max(1, available_cores() - 1)  # the last core learns
    if set(config.priority.split(".")) <= {"C", ""}:
        # No human data can arrive: the Constraint baseline keeps the cloned policy (section 5.4).
        changes["learner"] = dataclasses.replace(config.learner, schedule="never")
    return dataclasses.replace(config, **changes)


def _estimate(critic: Critic) -> Signal:
    """The critic's estimate for what the policy proposes."""
    return lambda view: critic(view.obs, view.actions)


def _expert(config: RunConfig) -> Policy:
    """The policy of the algorithmic humans."""
    if config.expert and ":" in config.expert and not Path(config.expert).exists():
        return experts.run_program(config.expert)
    return experts.load(config.task, Path(config.expert) if config.expert else None)[0]


def _success_return(config: RunConfig, actor: Policy) -> float:
    """What makes an episode a success: 95 % of the shipped expert's return, or of this run's where none is shipped."""
    assert config.disturbance is not None
    if experts.path_of(config.task).exists():
        return experts.success_return(config.task, config.disturbance, threads=config.threads)
    if isinstance(actor, GaussianActor):
        return experts.success_return(config.task, config.disturbance, Path(config.expert or ""), threads=config.threads)
    raise ConfigError(f"no expert is shipped with {config.task}, so nothing says what a success is; give its weights")


def _in_steps(total: int, work: Callable[[int], Any], name: str, report: Report, chunk: int = 50) -> None:
    for done in range(0, total, chunk):
        report(name, done / total)
        work(min(chunk, total - done))
