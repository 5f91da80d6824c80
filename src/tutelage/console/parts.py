"""From what is to be supervised to the parts of the loop: a fleet, its policy, and what learns from people."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import tutelage
from tutelage.console.config import EngineConfig as EngineConfig
from tutelage.console.stoppable import StoppableFleet
from tutelage.envs import experts
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError, RunFolderError
from tutelage.experiments.assemble import Assembly, assemble, learner_of, sized
from tutelage.experiments.config import FORMAT, RunConfig, to_json
from tutelage.experiments.prepare import prepare
from tutelage.experiments.run import loop_state, read_config
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import parse
from tutelage.learning.imitation import ImitationLearner, LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.store import load_tree, save_tree, write_atomic

Report = Callable[[str, float], None]
UNSURE, RISKY, DIFFERENT = 0.05, 0.5, 0.1
"""Thresholds of uncertainty, risk and discrepancy for a policy that was not trained before."""
SERVED = "serve.json"
"""The file of a folder that says what is supervised there."""


@dataclass
class Parts:
    """What a loop with people is made of.

    Attributes:
        config: resolved.
        fleet: with its emergency stop.
        assembly: the parts as an algorithmic run would have them; its policy is the one that acts.
        expert: the algorithmic human, or None.
        resumed: whether the folder was served before.
    """

    config: RunConfig
    fleet: StoppableFleet
    assembly: Assembly
    expert: Policy | None
    resumed: bool

    @property
    def policy(self) -> EnsemblePolicy:
        """The one that acts."""
        return self.assembly.policy

    @property
    def learner(self) -> ImitationLearner:
        """Policy, critics and data."""
        return self.assembly.learner


def learner_path(folder: Path) -> Path:
    """The state of the learner."""
    return folder / "checkpoint" / "learner.safetensors"


def check_folder(folder: Path) -> None:
    """Raises RunFolderError where a folder holds a run that was not served."""
    if (folder / "config.json").exists() and not (folder / SERVED).exists():
        raise RunFolderError(f"{folder} holds a run that was not served; choose another --out, or give it as --policy")


def make_parts(config: EngineConfig, report: Report) -> Parts:
    """Make the parts, new or as the folder has them. Prepares a policy where there is none yet, which takes a while.

    Raises:
        RunFolderError: the folder holds something else.
        ConfigError: a fleet, task or combination that cannot work.
    """
    folder = config.out
    check_folder(folder)
    if (folder / SERVED).exists():
        return _again(config)
    parts = (_simulated if config.simulated else _remote)(config, report)
    folder.mkdir(parents=True, exist_ok=True)
    save_learner(folder, parts.learner, seen=0, version=0)
    run = parts.config
    settings = {"format": FORMAT, "version": tutelage.__version__, "algorithm": run.algorithm, **to_json(run)}
    write_atomic(folder / "config.json", json.dumps(settings, indent=2).encode())
    low, high = (bound.tolist() for bound in (parts.fleet.action_low, parts.fleet.action_high))
    served = {"format": FORMAT, "fleet": config.fleet, "shape": parts.policy.obs_shape, "low": low, "high": high}
    write_atomic(folder / SERVED, json.dumps(served, indent=2).encode())  # last: a folder that has it is complete
    return parts


def save_learner(folder: Path, learner: ImitationLearner, seen: int, version: int) -> None:
    """Keep a learner's state, which includes the samples up to the one with id `seen`."""
    tree = {"format": FORMAT, "seen": seen, "version": version, "learner": learner.state_dict()}
    save_tree(learner_path(folder), tree)


def load_learner(folder: Path, learner: ImitationLearner) -> tuple[int, int]:
    """Restore what `save_learner` wrote; returns the last sample's id, and the version.

    Raises:
        RunFolderError: it is damaged, or of another version.
    """
    path = learner_path(folder)
    tree = load_tree(path)
    if tree.get("format") != FORMAT:
        raise RunFolderError(f"{path} has format {tree.get('format')}, this version reads {FORMAT}")
    try:
        learner.load_state_dict(tree["learner"])
        return int(tree["seen"]), int(tree["version"])
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError):
        raise RunFolderError(f"{path} does not fit {folder / 'config.json'}: one of them is damaged; restore it") from None


def learner_in(folder: Path) -> ImitationLearner:
    """The learner of a folder, of the right shape; `load_learner` gives it its state.

    Raises:
        RunFolderError: the folder is damaged.
    """
    served = _served(folder)
    try:
        low, high = (np.array(served[name], dtype=np.float32) for name in ("low", "high"))
        config = dataclasses.replace(read_config(folder), threads=1)  # of the others robots and people have need
        return learner_of(config, tuple(served["shape"]), low, high)
    except (LookupError, TypeError, ValueError):
        raise RunFolderError(f"{folder / SERVED} is damaged; restore it, or choose another --out") from None


def _served(folder: Path) -> dict[str, Any]:
    try:
        served = json.loads((folder / SERVED).read_text())
        found = served["format"]
    except (OSError, ValueError, LookupError, TypeError):
        raise RunFolderError(f"{folder / SERVED} is damaged; restore it, or choose another --out") from None
    if found != FORMAT:
        raise RunFolderError(f"{folder} has format {found}, this version reads {FORMAT}; use the version that wrote it")
    return dict(served)


def _simulated(config: EngineConfig, report: Report) -> Parts:
    run = _run_config(config, config.robots)
    trained = config.policy if config.policy not in (None, "none") else None
    if trained:
        before = read_config(Path(trained))
        if before.task != config.task:
            raise ConfigError(f"{trained} is a run of {before.task}, not of {config.task}")
        ours = ("robots", "humans", "priority", "steps", "out", "t_reset", "record", "queue", "wait", "latency")
        run = dataclasses.replace(before, **{name: getattr(run, name) for name in ours})
    assembly = _taught(assemble(run), run)
    _check(assembly)
    if trained:
        state = loop_state(Path(trained))
        try:
            assembly.learner.load_state_dict(state["learner"])
        except (LookupError, RuntimeError, TypeError, ValueError):
            raise RunFolderError(
                f"{trained} has no learner for the priority {config.priority}; serve it with the one it was trained with"
            ) from None
    elif config.policy is None:
        assembly = prepare(assembly, report)
    else:
        assembly = _bare(assembly.config, assembly.fleet)
    return Parts(assembly.config, StoppableFleet(assembly.fleet), assembly, assembly.actor, resumed=False)


def _remote(config: EngineConfig, report: Report) -> Parts:
    """Real robots. Where they work at a task that can be simulated, its algorithmic human gives the first demonstrations."""
    fleet = _connect(config)
    try:
        run = dataclasses.replace(_run_config(config, fleet.num_envs), task=fleet.description.task)  # type: ignore[attr-defined]
        if (config.policy is None and run.task in TASKS) or config.policy not in (None, "none"):
            small = dataclasses.replace(config, fleet=f"sim:{run.task}", robots=run.humans)
            assembly = _simulated(small, report).assembly
            config_of = dataclasses.replace(assembly.config, robots=fleet.num_envs)
            assembly.fleet.close()
            if assembly.policy.obs_shape != fleet.single_observation_space.shape:
                raise ConfigError(f"the robots do not observe what {run.task} shows: {fleet.single_observation_space.shape}")
            assembly = dataclasses.replace(assembly, config=config_of, fleet=fleet)
        else:
            assembly = _bare(run, fleet)
    except BaseException:
        fleet.close()
        raise
    expert = assembly.actor if run.task in TASKS else None
    return Parts(assembly.config, StoppableFleet(fleet, paces=True), assembly, expert, resumed=False)


def _connect(config: EngineConfig) -> Fleet:
    from tutelage.remote.fleet import RemoteFleet

    return RemoteFleet.connect(Path(config.task), hz=config.hz)


def _bare(run: RunConfig, fleet: Fleet) -> Assembly:
    """Robots of which nothing is known but what they observe and what they can do."""
    shape = fleet.single_observation_space.shape or ()
    # No run of a cloned policy could say what is much.
    thresholds = _filled(run.thresholds, uncertainty=UNSURE, risk=RISKY, initial=0)
    gate = _filled(
        run.gate, beta_h=DIFFERENT, novelty=UNSURE, risk_ask=RISKY, risk_cede=RISKY / 2, mean_discrepancy=DIFFERENT / 2
    )
    run = sized(dataclasses.replace(run, thresholds=thresholds, gate=gate), shape)
    learner = learner_of(run, shape, fleet.action_low, fleet.action_high)
    actor = experts.load(run.task)[0] if run.task in TASKS else learner.policy
    return Assembly(run, fleet, actor, learner.policy, learner)


def _filled(settings: Any, **values: Any) -> Any:
    """A configuration with these values where it has none."""
    return dataclasses.replace(settings, **{name: v for name, v in values.items() if getattr(settings, name) is None})


def _again(config: EngineConfig) -> Parts:
    """The parts of a folder that was served before."""
    folder = config.out
    served, run = _served(folder), dataclasses.replace(read_config(folder), out=folder)
    robots = config.robots if config.simulated else run.robots
    wanted = (config.fleet, config.seats(robots), robots, config.priority)
    if wanted != (served.get("fleet"), run.humans, run.robots, run.priority):
        raise RunFolderError(
            f"{folder} was served with --fleet {served.get('fleet')} --robots {run.robots} --humans {run.humans} "
            f"--priority {run.priority}; use the same, or another --out"
        )
    if config.simulated:
        assembly = _taught(assemble(run), run)
        expert: Policy | None = assembly.actor
    else:
        fleet = _connect(config)
        assembly = _bare(run, fleet)
        expert = assembly.actor if run.task in TASKS else None
    load_learner(folder, assembly.learner)
    fleet = StoppableFleet(assembly.fleet, paces=not config.simulated)
    return Parts(assembly.config, fleet, assembly, expert, resumed=True)


def _run_config(config: EngineConfig, robots: int) -> RunConfig:
    settings: dict[str, Any] = {
        "task": config.task, "priority": config.priority, "robots": robots,
        "humans": config.seats(robots), "steps": 10**9, "seed": config.seed, "t_reset": config.t_reset,
        "queue": config.queue, "wait": config.wait, "record": "none", "out": config.out,
        "metrics_every": max(1, round(config.hz)),
    }  # fmt: skip
    if config.learner == "none":
        settings["learner"] = LearnerConfig(schedule="never")
    return RunConfig(**{**settings, **config.run})


def _taught(assembly: Assembly, run: RunConfig) -> Assembly:
    """A run with the priority C. keeps its policy, for nobody would teach it; people may take robots, and do."""
    assembly.learner.config = run.learner
    return dataclasses.replace(assembly, config=dataclasses.replace(assembly.config, learner=run.learner))


def _check(assembly: Assembly) -> None:
    """What cannot work is refused before minutes are spent on preparing."""
    run, fleet = assembly.config, assembly.fleet
    if not fleet.can_pause:
        raise ConfigError(f"{run.task} cannot pause robots, and people need time; serve another task")
    needs = parse(run.priority, run.thresholds, run.gate).needs
    if "goal" in needs and not fleet.goal_conditioned:
        raise ConfigError(f"{run.priority} needs a task with a goal, and {run.task} has none; use C.U.R. or U.C.")
