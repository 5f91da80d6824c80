"""What is supervised, and how: the flags of `tutelage serve`, and more."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tutelage.console.offers import Terms
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError


@dataclass(frozen=True)
class EngineConfig:
    """What is supervised, and how.

    Attributes:
        fleet: "sim:TASK" (a task or "module:function"), or "net:HOME", remote robots of a home made by `tutelage keys`.
        robots: N of a simulated fleet.
        humans: seats for operators; M is at most one a robot.
        priority: p-hat.
        queue: who is next, see `RunConfig`.
        wait: robots that need somebody stand still until a person comes, see `RunConfig`.
        hz: timesteps a second.
        lockstep: the simulation waits for the people who hold robots, each time at most `deadline` seconds.
        deadline: see there.
        policy: a run folder to start with its policy; "none": an untrained one; None: clone the algorithmic human first.
        learner: "process", beside the loop; "inline", within it (the fleet waits); "none": the policy stays as it is.
        per_sample: gradient steps for each new human sample, in a process.
        swap_every: seconds between two deliveries of weights.
        t_reset: t_R, timesteps of a hard reset.
        seed: root seed.
        out: folder of everything that is kept.
        terms: how long offers and leases last.
        run: more settings of the run, by name, such as offline_pairs or learner.
        save_every: seconds between checkpoints.
        replay: whether interventions are kept as films.
        gated: the algorithm also decides when an intervention ends, as the gates of chapters 2 and 3 do; else people do.
        assist: whether people may let the algorithmic human act for them.
    """

    fleet: str = "sim:Navigation"
    robots: int = 8
    humans: int = 4
    priority: str = "C.U.R."
    queue: Literal["priority", "fifo"] = "priority"
    wait: bool = False
    hz: float = 10.0
    lockstep: bool = False
    deadline: float = 30.0
    policy: str | None = None
    learner: Literal["process", "inline", "none"] = "process"
    per_sample: float = 10.0
    swap_every: float = 1.0
    t_reset: int = 5
    seed: int = 0
    out: Path = Path("served")
    terms: Terms = field(default_factory=Terms)
    run: dict[str, Any] = field(default_factory=dict)
    save_every: float = 10.0
    replay: bool = True
    gated: bool = False
    assist: bool = True

    def __post_init__(self) -> None:
        kind, _, name = self.fleet.partition(":")
        if kind not in ("sim", "net") or not name:
            meant = f" (did you mean sim:{self.fleet}?)" if self.fleet in TASKS else ""
            raise ConfigError(f"unknown fleet {self.fleet!r}{meant}: write sim:TASK or net:HOME")
        if not 0.1 <= self.hz <= 1000:
            raise ConfigError(f"hz must be from 0.1 to 1000, got {self.hz}")
        if self.humans < 1 or self.robots < 1:
            raise ConfigError("a fleet needs at least one robot, and a seat for at least one person")
        if self.lockstep and kind == "net":
            raise ConfigError("real robots do not wait: --lockstep is for simulated fleets")
        if min(self.deadline, self.swap_every, self.save_every) <= 0 or self.per_sample < 0:
            raise ConfigError("deadline, swap_every and save_every must be positive, and per_sample not negative")

    @property
    def task(self) -> str:
        """The name of the task, or of the home."""
        return self.fleet.partition(":")[2]

    def seats(self, robots: int) -> int:
        """M, for so many robots."""
        return min(self.humans, robots)

    @property
    def simulated(self) -> bool:
        """Whether the robots are simulated."""
        return self.fleet.startswith("sim:")
