"""From a configuration to the parts of a run: fleet, humans, policy, critics, and the loop over them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.cores import available_cores, default_torch_threads
from tutelage.envs import experts
from tutelage.envs.registry import find_task, make_fleet
from tutelage.envs.task_fleet import TaskFleet
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import Task
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

    def loop(self, frozen: Policy | None = None) -> Loop:
        """The loop over these parts; thresholds must be resolved.

        frozen: act with this policy instead, and learn nothing: an evaluation, on random streams that training never uses.
        """
        c = self.config
        priority = parse(c.priority, c.thresholds, c.gate)
        if "goal" in priority.needs and not self.fleet.goal_conditioned:
            raise ConfigError(f"{c.priority} needs a task with a goal, and {c.task} has none; use C.U.R. or U.C.")
        kinds = self._supervisors()
        team = Team([kinds[j % len(kinds)] for j in range(c.humans)], c.latency)
        omega = FleetDAgger(c.t_teleop, c.t_reset)
        signals = self._signals()
        if frozen is not None:
            return Loop(self.fleet, frozen, priority, team, omega, signals=signals, seed=derive(c.seed, "evaluation"))
        return Loop(
            self.fleet, self.policy, priority, team, omega, self.learner, signals,
            execution=self._execution(priority), overlap=c.overlap, seed=c.seed,
        )  # fmt: skip

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

    def _signals(self) -> dict[str, Signal]:
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
    torch.set_num_threads(config.torch_threads or 1)
    priority = parse(config.priority, config.thresholds, config.gate)
    actor = _expert(config)
    fleet = fleet_of(config, config.robots, config.disturbance)

    shape, actions = _obs_shape(fleet, config), len(fleet.action_low)
    config = dataclasses.replace(
        config, hidden=hidden_layers(shape, config.hidden),
        critic=dataclasses.replace(config.critic, hidden=hidden_layers(shape, config.critic.hidden)),
    )  # fmt: skip
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
    policy = EnsemblePolicy(
        shape, fleet.action_low, fleet.action_high,
        members=config.members, hidden=config.hidden, seed=derive(config.seed, "policy/initial weights"),
    )  # fmt: skip
    dataset = AggregatedDataset(
        shape, actions, config.members, stream(config.seed, "dataset"), config.bootstrap, stored_as(shape)
    )
    scale = (policy.obs_mean, policy.obs_std, policy.action_middle, policy.action_half)
    critics = {
        name: Critic(shape, actions, "bad" if name == "risk" else "good", policy, config.critic, scale,
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
    if experts.path_of(config.task).exists() or experts.program_of(config.task):
        return experts.success_return(config.task, config.disturbance, threads=config.threads)
    if isinstance(actor, GaussianActor):
        return experts.success_return(config.task, config.disturbance, Path(config.expert or ""), threads=config.threads)
    raise ConfigError(f"no expert is shipped with {config.task}, so nothing says what a success is; give its weights")
