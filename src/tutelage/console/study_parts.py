"""The parts of a participant's session, the runs of its conditions, and their results on the disk."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tutelage.console.config import EngineConfig
from tutelage.console.supervision import Supervision
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments.config import RunConfig
from tutelage.experiments.table_3_2 import condition
from tutelage.experiments.user_study.concentration import Table
from tutelage.experiments.user_study.protocol import CONDITIONS, HUMAN_GATED, ROBOTS, STEPS, Counting

Kind = Literal["welcome", "practice_game", "practice_requests", "practice_monitoring", "condition", "survey", "done"]
Report = Callable[[str, float], None]
LABELS = "ABCD"
FORMAT = 1


class OutOfOrderError(TutelageError):
    """What was asked for does not belong to the present part of the study."""


@dataclass(frozen=True)
class StudyConfig:
    """A participant's session.

    Attributes:
        participant: their number, which gives the order of the conditions, their robots and their cards.
        out: folder of the whole study.
        hz: timesteps a second at most; the simulation waits for who holds a robot.
        steps: timesteps of a condition.
        practice: whether the session begins with the practice of B.4.
        assist: whether the task's expert may act for the person; not with real participants.
        settings: changes of the runs, by name of `RunConfig`'s fields.
    """

    participant: int
    out: Path
    hz: float = 10.0
    steps: int = STEPS
    practice: bool = True
    assist: bool = False
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.participant < 0 or self.steps < 1:
            raise ConfigError("a participant's number is 0 or more, and a condition has at least one timestep")


@dataclass(eq=False)
class Part:
    """One part of a session. supervision: its robots, where it has some; state: ready, running or over."""

    kind: Kind
    algorithm: str | None = None
    label: str | None = None
    supervision: Supervision | None = None
    table: Table | None = None
    counting: Counting | None = None
    t: int = 0
    state: Literal["ready", "running", "over"] = "ready"

    @property
    def interface(self) -> str | None:
        """What the person does when no robot is theirs: plays ("game"), or watches ("panes")."""
        if self.kind == "practice_game":
            return "game"
        return None if self.algorithm is None else "panes" if self.algorithm == HUMAN_GATED else "game"


def engine_of(config: StudyConfig, algorithm: str, seed: int, folder: Path) -> EngineConfig:
    """A condition with a person: as the simulated one of table 3.2, but for who helps."""
    run = dataclasses.replace(condition(algorithm, seed, latency=0), **config.settings)
    ours = {field_.name for field_ in dataclasses.fields(EngineConfig)}
    rest = {f.name: getattr(run, f.name) for f in dataclasses.fields(RunConfig)}
    for name in [*ours & rest.keys(), "task", "steps", "record", "metrics_every", "out"]:
        rest.pop(name, None)
    human_gated = algorithm == HUMAN_GATED
    rest["learner"] = run.learner
    return EngineConfig(
        fleet=f"sim:{run.task}", robots=ROBOTS, humans=1, priority="C." if human_gated else run.priority,
        queue=run.queue, wait=run.wait, gated=not human_gated, assist=config.assist, hz=config.hz, lockstep=True,
        deadline=60.0, learner="none", t_reset=run.t_reset, seed=seed, out=folder, run=rest, replay=False,
    )  # fmt: skip


def read_result(path: Path) -> dict[str, Any]:
    """A condition's result. Raises ConfigError where it is damaged."""
    try:
        result: dict[str, Any] = json.loads(path.read_bytes())
        if result["format"] != FORMAT or result["algorithm"] not in CONDITIONS:
            raise ValueError("another format")
        return result
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ConfigError(f"{path} is damaged: {error}") from None
