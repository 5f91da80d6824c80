"""Peg insertion on our engine against robosuite's, on the same cores; and where the time of ours goes."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import mujoco
import numpy as np

from benchmarks.timing import Phases, ratio, table, take_turns
from tutelage.cores import available_cores
from tutelage.envs import experts
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.registry import make_fleet
from tutelage.errors import MissingExtraError
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy

OURS, THEIRS = "PegInsertion", "NutAssemblyRound"
ROBOTS = 100
DECISIONS = {OURS: 20, THEIRS: 5}
"""Timesteps of a robot in a round."""
TIMERS = {
    "collisions": "POS_COLLISION", "constraints": "POS_MAKE", "solver": "CONSTRAINT", "kinematics": "POS_KINEMATICS",
    "inertia": "POS_INERTIA", "velocities": "VELOCITY", "integration": "ADVANCE",
}  # fmt: skip
"""Names that we give to MuJoCo's own timers."""


class Work:
    """A fleet at work under its algorithmic human; whose episode ends begins anew."""

    def __init__(self, task: str, robots: int, **settings: Any) -> None:
        self.fleet: Fleet = make_fleet(task, robots, **settings)
        self.human: Policy = experts.load(task)[0]
        self.obs, _ = self.fleet.reset(seed=0)
        for _ in range(3):  # compiled code is compiled, caches are warm
            self.step()

    def step(self, decisions: int = 1) -> None:
        """Timesteps of all robots."""
        for _ in range(decisions):
            self.obs, _, violation, truncated, info = self.fleet.step(self.human.act(self.obs))
            over = violation | truncated | info["success"]
            if over.any():
                self.obs, _ = self.fleet.reset(options={"reset_mask": over})


def run(quick: bool = False) -> dict[str, Any]:
    """Decisions a second: 100 robots of ours on all cores, and robosuite in one process a core, which is what it can do."""
    cores, rounds = available_cores(), 3 if quick else 9
    ours = Work(OURS, ROBOTS, disturbance="none", threads=cores)
    one = Work(OURS, ROBOTS, disturbance="none", threads=1)
    share = where_the_time_goes(one)
    variants: dict[str, Any] = {OURS: lambda: ours.step(DECISIONS[OURS]), "one thread": lambda: one.step(DECISIONS[OURS])}
    per_round = {OURS: ROBOTS * DECISIONS[OURS], "one thread": ROBOTS * DECISIONS[OURS], THEIRS: cores * DECISIONS[THEIRS]}
    with contextlib.ExitStack() as stack:
        try:
            variants[THEIRS] = stack.enter_context(processes(cores))
        except MissingExtraError as error:
            print(f"Only ours: {error}\n")
        seconds = take_turns(variants, rounds)
    ours.fleet.close()
    one.fleet.close()
    rates = {name: per_round[name] / float(np.median(took)) for name, took in seconds.items()}
    print(table(["decisions a second", *rates], [[f"{cores} cores", *rates.values()]]))
    found: dict[str, Any] = {"decisions a second": rates, "share of the time": share}
    if THEIRS in seconds:
        found["ratio"] = ratio(seconds, THEIRS, OURS) * per_round[OURS] / per_round[THEIRS]
        print(f"\n{OURS} / {THEIRS}: {found['ratio']:.0f} times as many decisions a second")
    print("\n" + table(["where the time of ours goes, one thread", "share"], [[k, f"{v:.1%}"] for k, v in share.items()]))
    return found


def where_the_time_goes(work: Work, steps: int = 20) -> dict[str, float]:
    """Fraction of a timestep by what is done in it, with the parts of physics from MuJoCo's own timers."""
    fleet = work.fleet
    assert isinstance(fleet, MujocoFleet)

    def timers() -> dict[str, float]:
        kinds = {name: int(getattr(mujoco.mjtTimer, f"mjTIMER_{kind}")) for name, kind in TIMERS.items()}
        kinds["all"] = int(mujoco.mjtTimer.mjTIMER_STEP)
        return {name: sum(data.timer[kind].duration for data in fleet.physics.datas) for name, kind in kinds.items()}

    phases, before = Phases(), timers()
    work.human.act = phases.timed(work.human.act, "the human")  # type: ignore[method-assign]
    for method in ("observe", "control", "success", "violation", "initial"):
        setattr(fleet.task, method, phases.timed(getattr(fleet.task, method), "task"))
    inner, fleet.step = fleet.step, phases.timed(fleet.step, "physics and fleet")  # type: ignore[method-assign]
    work.step(steps)
    fleet.step = inner  # type: ignore[method-assign]
    after = timers()
    passed = {name: after[name] - before[name] for name in after}
    total = sum(phases.seconds.values())
    shares = {name: phases.seconds.get(name, 0.0) / total for name in ("the human", "task")}
    shares |= {
        f"physics: {name}": phases.seconds["physics and fleet"] / total * passed[name] / passed["all"] for name in TIMERS
    }
    return {**shares, "physics: the rest": 1.0 - sum(shares.values())}


@contextlib.contextmanager
def processes(cores: int) -> Iterator[Any]:
    """A function that lets all processes make their timesteps and waits for the last.

    Raises:
        MissingExtraError: robosuite is not installed.
    """
    import tutelage.envs.robosuite_fleet  # noqa: F401 - here, where a missing extra can be told

    context = multiprocessing.get_context("spawn")
    ends, workers = [], []
    for _ in range(cores):
        end, other = context.Pipe()
        workers.append(context.Process(target=_serve, args=(other,), daemon=True))
        workers[-1].start()
        ends.append(end)
    for end in ends:
        end.recv()  # it is ready

    def work() -> None:
        for end in ends:
            end.send(DECISIONS[THEIRS])
        for end in ends:
            end.recv()

    yield work
    for end, worker in zip(ends, workers, strict=True):
        end.send(0)
        worker.join()


def _serve(end: Connection) -> None:
    work = Work(THEIRS, 1)
    end.send(True)
    while decisions := end.recv():
        work.step(decisions)
        end.send(True)
    work.fleet.close()
