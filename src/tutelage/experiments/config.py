"""Configurations as plain data: the flags of `tutelage run` and `train-expert`, and `config.json` of a run folder."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from tyro.conf import Positional, arg

from tutelage.errors import ConfigError, RunFolderError
from tutelage.fleet.gates import GateConfig
from tutelage.fleet.priority import PriorityConfig
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig
from tutelage.learning.ppo import PPOConfig

FORMAT = 3
"""Version of a run folder. A folder of another version is refused, never guessed at."""


@dataclass(frozen=True)
class RunConfig:
    """An interactive fleet learning run (chapter 5). The defaults are the dissertation's.

    Attributes:
        task: name of a task (see `tutelage info tasks`), or "module:function" that makes a fleet.
        priority: p-hat, such as C.U.R., U.C., U.G.C., C., Random (see `tutelage info priorities`); or "module:callable" that
            makes one.
        robots: N.
        humans: M.
        steps: T, timesteps of the run.
        seed: root seed of every random stream.
        t_teleop: t_T, minimum timesteps of a teleoperation.
        t_reset: t_R, timesteps of a hard reset.
        latency: L, timesteps between an assignment and its beginning; the robot waits.
        queue: who is next: "priority", the robot that needs a human most; or "fifo", the one that has for longest.
        wait: robots that need a human stand still until one comes, instead of going on by themselves meanwhile.
        disturbance: level of the world's disturbances; default: the task's own.
        success_return: the return that makes an episode of a task without a goal a success; default: 95 % of the expert's
            at this level.
        observation: what the policy sees: "state", the task's vector, or "images", 64 x 64 RGB of the task's camera.
        offline_pairs: state-action pairs of the human before the run, in whole episodes of the supervisor; default:
            the task's own.
        offline_disturbance: level of disturbance while those were recorded (demonstrations are given in calm).
        calibration_steps: timesteps that the cloned policy runs alone before the run; from them come the thresholds
            and the first data of the critics (appendix C.3: about 20,000 transitions).
        thresholds: of the priority function.
        gate: numbers of the gates (SafeDAgger, LazyDAgger and the others).
        learner: the update schedule.
        critic: of the risk and goal critics.
        members: networks in the ensemble.
        hidden: widths of their (fully connected) hidden layers; default: 256 256, for images 100 50 10.
        bootstrap: give each member its own bootstrap sample of the data.
        supervisor_noise: standard deviation of the humans' trembling, as a fraction of half the action range.
        expert: the algorithmic humans: a file of weights, or module:function that returns a policy; default: the weights
            shipped with the task.
        overlap: learn while all else of a timestep goes on (the update at step t then sees the data up to t - 1).
        threads: threads in which physics runs, and policy and critics learn from vectors; default: one a core.
        torch_threads: threads of each matrix product of networks that see images; default: all cores, at most 4.
        out: run folder; default: runs/TASK-PRIORITY-sSEED, or runs/TASK-images-PRIORITY-sSEED.
        checkpoint_every: timesteps between checkpoints.
        metrics_every: timesteps between lines of metrics.jsonl.
        record: which frames to keep in episodes/: those under human control, all, or none.
        label: name of the algorithm in reports; default: the priority.
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    priority: str = "C.U.R."
    robots: int = 100
    humans: int = 10
    steps: int = 10_000
    seed: int = 0
    t_teleop: int = 5
    t_reset: int = 5
    latency: int = 0
    queue: Literal["priority", "fifo"] = "priority"
    wait: bool = False
    disturbance: str | None = None
    success_return: float | None = None
    observation: Literal["state", "images"] = "state"
    offline_pairs: int | None = None
    offline_disturbance: str = "none"
    calibration_steps: int = 200
    thresholds: PriorityConfig = field(default_factory=PriorityConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)
    members: int = 5
    hidden: tuple[int, ...] | None = None
    bootstrap: bool = True
    supervisor_noise: float = 0.0
    expert: str | None = None
    overlap: bool = False
    threads: int | None = None
    torch_threads: int | None = None
    out: Path | None = None
    checkpoint_every: int = 1000
    metrics_every: int = 20
    record: Literal["human", "all", "none"] = "human"
    label: str | None = None

    def __post_init__(self) -> None:
        _at_least(
            self, robots=1, humans=1, steps=1, t_teleop=1, t_reset=1, latency=0, offline_pairs=1, calibration_steps=1,
            members=1, threads=1, torch_threads=1, checkpoint_every=1, metrics_every=1, seed=0,
        )  # fmt: skip
        if self.humans > self.robots:
            raise ConfigError(f"{self.humans} humans for {self.robots} robots: use at most one human a robot (M <= N)")
        if not 0 <= self.supervisor_noise < math.inf:
            raise ConfigError(f"supervisor_noise must be a number >= 0, got {self.supervisor_noise}")
        if self.success_return is not None and not math.isfinite(self.success_return):
            raise ConfigError(f"success_return must be a number, got {self.success_return}")
        for hidden in (self.hidden, self.critic.hidden):
            if min(hidden or (1,)) < 1:
                raise ConfigError(f"hidden layers must be at least 1 wide, got {hidden}")
        if self.observation not in ("state", "images"):
            raise ConfigError(f"unknown observation {self.observation!r}: use state or images")
        if self.queue not in ("priority", "fifo"):
            raise ConfigError(f"unknown queue {self.queue!r}: use priority or fifo")
        if self.record not in ("human", "all", "none"):
            raise ConfigError(f"unknown record {self.record!r}: use human, all or none")

    @property
    def folder(self) -> Path:
        """Where the run is kept."""
        task = self.task.replace(":", ".").replace("/", ".") + ("-images" if self.observation == "images" else "")
        return self.out or Path("runs") / f"{task}-{self.priority.replace(':', '.').rstrip('.')}-s{self.seed}"

    @property
    def algorithm(self) -> str:
        """Name in reports."""
        return self.label or self.priority


@dataclass(frozen=True)
class ExpertConfig:
    """Training of an algorithmic supervisor.

    Attributes:
        task: name of a MuJoCo task.
        steps: environment steps in total, over all robots.
        robots: robots in the fleet that collects experience.
        disturbance: level during training; default: the task's own.
        seed: root seed.
        out: folder of checkpoints and weights; default: runs/expert-TASK. If it holds a checkpoint, training goes on.
        evaluate_every: environment steps between evaluations; the best policy so far is kept.
        threads: physics threads; default: all cores.
        torch_threads: likewise for matrix products; default: all cores, at most 4.
        ppo: hyper-parameters.
    """

    task: Annotated[Positional[str], arg(metavar="TASK")]
    steps: int = 5_000_000
    robots: int = 64
    disturbance: str | None = None
    seed: int = 0
    out: Path | None = None
    evaluate_every: int = 500_000
    threads: int | None = None
    torch_threads: int | None = None
    ppo: PPOConfig = field(default_factory=PPOConfig)

    def __post_init__(self) -> None:
        _at_least(self, steps=1, robots=1, evaluate_every=1, threads=1, torch_threads=1)


def _at_least(config: Any, **least: int) -> None:
    for name, bound in least.items():
        value = getattr(config, name)
        if value is not None and value < bound:  # None: decided later
            raise ConfigError(f"{name} must be at least {bound}, got {value}")


def to_json(config: Any) -> dict[str, Any]:
    """A configuration as JSON values."""
    plain = lambda value: value.item() if isinstance(value, np.generic) else str(value)  # noqa: E731
    return json.loads(json.dumps(dataclasses.asdict(config), default=plain))  # type: ignore[no-any-return]


def from_json(cls: Any, values: Mapping[str, Any]) -> Any:
    """A configuration of dataclass `cls` from JSON values.

    Raises:
        RunFolderError: a name that this version does not know, or a value of the wrong kind.
    """
    hints = get_type_hints(cls)
    unknown = set(values) - set(hints)
    if unknown:
        raise RunFolderError(f"unknown settings {sorted(unknown)}: the folder was written by another version of Tutelage")
    try:
        return cls(**{name: _restore(hints[name], value, name) for name, value in values.items()})
    except (TypeError, ValueError) as error:
        raise RunFolderError(f"a setting has the wrong kind: {error}") from None


def _restore(kind: Any, value: Any, name: str) -> Any:
    if get_origin(kind) in (Union, UnionType):
        if value is None:
            return None
        kind = next(k for k in get_args(kind) if k is not type(None))
    if get_origin(kind) is tuple and isinstance(value, list):
        return tuple(_restore(get_args(kind)[0], item, name) for item in value)
    if get_origin(kind) is Literal and value in get_args(kind):
        return value
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return from_json(kind, value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if type(value) is kind or (kind is float and type(value) is int):  # not isinstance: True is no number here
        return value
    raise TypeError(f"{name} cannot be {value!r}")
