"""From a configuration to the parts of a run: fleet, humans, policy, critics, and the loop over them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.cores import default_torch_threads, keep_freed_memory
from tutelage.envs import experts
from tutelage.envs.registry import find_task, make_fleet
from tutelage.envs.task_fleet import TaskFleet
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import Task
from tutelage.errors import ConfigError, ContractError
from tutelage.experiments.config import RunConfig
from tutelage.fleet.allocation import FirstComeFirstServed, FleetDAgger
from tutelage.fleet.discrepancy import discrepancy
from tutelage.fleet.execution import BetaMixture, Execution, NoiseInjection
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.gates import DAgger, LazyDAgger
from tutelage.fleet.loop import Loop
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import Lexicographic, parse
from tutelage.fleet.supervisor import NoisySupervisor, PolicySupervisor, Supervisor, Team
from tutelage.fleet.view import FleetView, Signal
from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.critic import Critic
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.expert import GaussianActor
from tutelage.policies.kinds import kinds_of
from tutelage.policies.networks import hidden_layers, stored_as
from tutelage.seeding import derive, stream

Array = NDArray[Any]


@dataclass
class Assembly:
    """The parts of a run, before anything is learned."""

    config: RunConfig
    fleet: Fleet
    actor: Policy
    policy: EnsemblePolicy
    learner: ImitationLearner

    @property
    def human(self) -> PolicySupervisor:
        """The algorithmic human of this fleet; where there are kinds, all of them, see `Kinds`."""
        return PolicySupervisor(self.actor, self.fleet)

    def loop(self, frozen: Policy | None = None, **changes: Any) -> Loop:
        """The loop over these parts; thresholds must be resolved.

        Args:
            frozen: act with this policy instead, and learn nothing: an evaluation, on random streams that training never
                uses.
            changes: arguments of `Loop` in place of those of the run, such as a team of people.
        """
        c = self.config
        priority = parse(c.priority, c.thresholds, c.gate)
        if "goal" in priority.needs and not self.fleet.goal_conditioned:
            raise ConfigError(f"{c.priority} needs a task with a goal, and {c.task} has none; use C.U.R. or U.C.")
        queue = FirstComeFirstServed if c.queue == "fifo" else FleetDAgger
        parts: dict[str, Any] = {
            "fleet": self.fleet, "policy": self.policy, "priority": priority, "learner": self.learner,
            "allocator": queue(c.t_teleop, c.t_reset), "execution": self._execution(priority),
            "overlap": c.overlap, "wait": c.wait, "seed": c.seed,
        }  # fmt: skip
        if frozen is not None:
            parts |= {"policy": frozen, "learner": None, "execution": None, "overlap": False}
            parts["seed"] = derive(c.seed, "evaluation")
        parts |= changes
        for name, make in (("team", self.team), ("signals", self.signals)):
            if name not in parts:
                parts[name] = make()
        if unknown := sorted(priority.needs - {"uncertainty", *parts["signals"]}):
            known = "uncertainty, risk, goal, predicted_discrepancy and judgement"
            raise ConfigError(
                f"{c.priority} needs the signal {', '.join(unknown)}, and a run has {known}; others go into a Loop of yours"
            )
        return Loop(**parts)

    def team(self) -> Team:
        """The M algorithmic humans."""
        kinds = self._supervisors()
        return Team([kinds[j % len(kinds)] for j in range(self.config.humans)], self.config.latency)

    def _kinds(self) -> list[PolicySupervisor]:
        """The algorithmic humans of this fleet, one of each kind."""
        return [PolicySupervisor(kind, self.fleet) for kind in kinds_of(self.actor)]

    def _supervisors(self) -> list[Supervisor]:
        """One human of each kind, with their trembling hands."""
        c = self.config
        supervisors: list[Supervisor] = [*self._kinds()]
        if c.supervisor_noise:
            sigma = c.supervisor_noise * float((self.fleet.action_high - self.fleet.action_low).mean() / 2)
            names = ["supervisor noise", *(f"supervisor noise/{k}" for k in range(1, len(supervisors)))]
            return [NoisySupervisor(s, sigma, stream(c.seed, name)) for s, name in zip(supervisors, names, strict=True)]
        return supervisors

    def _judgement(self, view: FleetView) -> Array:
        """How much what the policy proposes differs from what a human would do; of any kind, for all of them do it well."""
        low, high = self.fleet.action_low, self.fleet.action_high
        return np.min([discrepancy(view.actions, kind.act(view.obs), low, high) for kind in self._kinds()], axis=0)  # type: ignore[no-any-return]

    def signals(self) -> dict[str, Signal]:
        """What the critics, the classifier and the humans' own judgement say."""
        signals = {name: _estimate(critic) for name, critic in self.learner.critics.items()}
        signals["judgement"] = self._judgement
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
    parse(config.priority, config.thresholds, config.gate)  # refused before an expert is looked for
    actor = _expert(config)
    fleet = fleet_of(config, config.robots, config.disturbance)

    shape, actions = _obs_shape(fleet, config), len(fleet.action_low)
    config = sized(config, shape)
    # Where vectors are seen, PyTorch computes only what is too small to be worth a meeting of threads.
    torch.set_num_threads(config.torch_threads or 1 if len(shape) == 3 else 1)
    keep_freed_memory()
    known = shape[0] if fleet.state is None else fleet.state.shape[1]
    if isinstance(actor, GaussianActor) and (actor.features > known or len(actor.low) != actions):
        raise ContractError(
            f"the expert {config.expert} sees {actor.features} numbers and gives {len(actor.low)} actions, "
            f"but {config.task} shows {known} and takes {actions}; train one with: tutelage train-expert {config.task}"
        )
    if isinstance(fleet, TaskFleet) and not fleet.goal_conditioned:
        if config.success_return is None and config.task in TASKS:  # once: a level that is not on the card is measured
            config = dataclasses.replace(config, success_return=_success_return(config, actor))
        if config.success_return is not None:
            fleet.success_return = config.success_return
    learner = learner_of(config, shape, fleet.action_low, fleet.action_high)
    return Assembly(config, fleet, actor, learner.policy, learner)


def sized(config: RunConfig, shape: tuple[int, ...]) -> RunConfig:
    """The configuration with the hidden layers that networks have which see observations of this shape."""
    return dataclasses.replace(
        config, hidden=hidden_layers(shape, config.hidden),
        critic=dataclasses.replace(config.critic, hidden=hidden_layers(shape, config.critic.hidden)),
    )  # fmt: skip


def learner_of(config: RunConfig, shape: tuple[int, ...], low: Array, high: Array) -> ImitationLearner:
    """The learner of a run, with its policy, data set, critics and classifier; nothing is trained yet.

    Args:
        config: of the run, `sized`.
        shape: of an observation: (D,) or (H, W, 3).
        low, high: bounds of the actions, (A,).

    Raises:
        ConfigError: an unknown priority.
    """
    priority, actions = parse(config.priority, config.thresholds, config.gate), len(low)
    policy = EnsemblePolicy(
        shape, low, high,
        members=config.members, hidden=config.hidden, seed=derive(config.seed, "policy/initial weights"),
        threads=config.threads,
    )  # fmt: skip
    dataset = AggregatedDataset(
        shape, actions, config.members, stream(config.seed, "dataset"), config.bootstrap, stored_as(shape)
    )
    scale = (policy.obs_mean, policy.obs_std, policy.action_middle, policy.action_half)
    critics = {
        name: Critic(shape, actions, "bad" if name == "risk" else "good", policy, config.critic, scale,
                     stream(config.seed, f"critic/{name}"), derive(config.seed, f"critic/{name}/initial weights"),
                     config.threads)
        for name in sorted(priority.needs & {"risk", "goal"})
    }  # fmt: skip
    classifier = None
    if "predicted_discrepancy" in priority.needs:
        classifier = DiscrepancyClassifier(
            policy, dataset, stream(config.seed, "classifier"), derive(config.seed, "classifier/initial weights"),
            beta_h=np.nan if config.gate.beta_h is None else config.gate.beta_h, batch=config.learner.batch,
        )  # fmt: skip
    return ImitationLearner(policy, dataset, config.learner, critics, classifier, config.seed)


def fleet_of(config: RunConfig, num_envs: int, level: str | None, **settings: Any) -> Fleet:
    """A fleet of the run's task at a level of disturbance, that observes what the run's policy sees.

    Raises:
        ConfigError: see `make_fleet`.
    """
    if config.observation != "state":  # a fleet of the user's own need not know the setting
        settings["observation"] = config.observation
    return make_fleet(config.task, num_envs, disturbance=level, threads=config.threads, **settings)


def _obs_shape(fleet: Fleet, config: RunConfig) -> tuple[int, ...]:
    """(D,) of vectors or (H, W, 3) of images.

    Raises:
        ConfigError: the fleet observes something else.
    """
    space = fleet.single_observation_space
    shape = space.shape or ()
    if len(shape) == 1 or (len(shape) == 3 and shape[2] == 3 and space.dtype == np.uint8):
        return shape
    raise ConfigError(f"a policy sees vectors or RGB images of bytes (H, W, 3), and {config.task} observes {space}")


def _resolve_defaults(config: RunConfig) -> RunConfig:
    """Fill in what the task and the priority decide."""
    changes: dict[str, Any] = {}
    t = config.thresholds
    found = find_task(config.task)
    task = found if isinstance(found, type) and issubclass(found, Task) else None
    if config.disturbance is None and task:
        changes["disturbance"] = task.disturbance
    if config.offline_pairs is None:
        changes["offline_pairs"] = getattr(found, "offline_pairs", Task.offline_pairs)
    if t.initial is None:
        initial = task.initial_period if task and config.priority.strip(".") == "C.U.R" else 0
        changes["thresholds"] = dataclasses.replace(t, initial=initial)
    if config.torch_threads is None:
        changes["torch_threads"] = default_torch_threads()
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
    if experts.path_of(config.task).exists() or experts.program_of(config.task):
        return experts.success_return(config.task, config.disturbance, threads=config.threads)
    if isinstance(actor, GaussianActor):
        return experts.success_return(config.task, config.disturbance, Path(config.expert or ""), threads=config.threads)
    raise ConfigError(f"no expert is shipped with {config.task}, so nothing says what a success is; give its weights")
