"""The whole loop against code in the usual shape, and against raw physics plus raw gradient steps, ours or PyTorch's."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks.fleets import OFFLINE, ready
from benchmarks.original_loop import OriginalLoop
from benchmarks.timing import Phases, ratio, table, take_turns
from tutelage.cores import Together, default_torch_threads
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.experiments.assemble import Assembly
from tutelage.fleet.loop import Loop
from tutelage.fleet.modes import MOVING
from tutelage.fleet.step import Step
from tutelage.learning.regression import BatchedRegression
from tutelage.learning.twins import BatchedTwins

PRETRAIN = 100
TOGETHER = "physics, gradients of the policy"
WARM = 100
"""Timesteps before the first measurement: at the start, all robots stand upright."""


class Headcount:
    """How many robots moved, on average over the timesteps so far."""

    def __init__(self) -> None:
        self.counts: list[int] = []

    def on_start(self, loop: Loop) -> None:
        pass

    def on_step(self, loop: Loop, step: Step) -> None:
        self.counts.append(int(MOVING[step.mode].sum()))

    def on_end(self, loop: Loop) -> None:
        pass

    @property
    def mean(self) -> float:
        return float(np.mean(self.counts))


class Ours:
    """A loop that goes on from where it was at each call."""

    def __init__(self, task: str, steps: int, overlap: bool = False) -> None:
        self.assembly = ready(task, pretrain=PRETRAIN, overlap=overlap)
        self.steps = steps
        self.moved = Headcount()
        self.torch_threads, self.loop = torch.get_num_threads(), self.assembly.loop()
        self.loop.subscribers = [self.moved]
        self.loop.run(WARM)

    def threads(self) -> None:
        """Let as many threads share a matrix product as in this run; not part of what is timed."""
        torch.set_num_threads(self.torch_threads)

    def __call__(self) -> None:
        self.loop.run(self.loop.t + self.steps)


class RawPhysics:
    """Exactly the physics of a run, stretch by stretch: the engine alone, with the commands that a run like it just gave."""

    def __init__(self, run: Ours) -> None:
        fleet = run.assembly.fleet
        assert isinstance(fleet, MujocoFleet)
        self.run, self.physics = run, fleet.physics
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def record(self) -> None:
        """Let the run go on for a stretch, and back to its start; not part of what is timed.

        How many robots stand, fall and wait changes in the course of a run, and with it what physics costs.
        """
        physics, start = self.physics, self.physics.get_state()
        advance, restart = physics.advance_async, physics.restart
        self.calls.clear()
        physics.advance_async = lambda *a: self._note("advance", advance, a)  # type: ignore[method-assign]
        physics.restart = lambda *a: self._note("restart", restart, a)  # type: ignore[method-assign]
        self.run()
        physics.advance_async, physics.restart = advance, restart  # type: ignore[method-assign]
        physics.set_state(start)

    def _note(self, kind: str, work: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        self.calls.append((kind, copy.deepcopy(arguments)))
        return work(*arguments)

    def __call__(self) -> None:
        """The same stretch again; the run goes on from its end."""
        for kind, arguments in self.calls:
            if kind == "advance":
                self.physics.advance_async(*arguments).results()
            else:
                self.physics.restart(*arguments)


class RawGradients:
    """The same updates of policy and critic, always on the same batches: nothing else happens.

    library: by PyTorch, members and twins as batched products, instead of in our compiled code.
    """

    def __init__(self, assembly: Assembly, steps: int, library: bool = False) -> None:
        self.learner, self.steps = assembly.learner, steps
        if library:
            policy, c = assembly.policy, assembly.config
            scale = policy.obs_mean, policy.obs_std, policy.action_middle, policy.action_half
            self.learner.regression = BatchedRegression(policy, c.learner.learning_rate)
            for critic in self.learner.critics.values():
                critic.twins = BatchedTwins(critic.net, critic.target, scale, True, c.critic.learning_rate, c.critic.tau)
        rows = self.learner.dataset.draw(assembly.config.learner.batch)
        self.learner.dataset.draw = lambda size: rows  # type: ignore[method-assign]
        for critic in self.learner.critics.values():
            for ring in (critic.plain, critic.events):
                drawn: dict[int, Any] = {}
                draw = ring.draw
                ring.draw = lambda n, rng, drawn=drawn, draw=draw: (
                    drawn[n] if n in drawn else drawn.setdefault(n, draw(n, rng))
                )  # type: ignore[method-assign]

    def __call__(self) -> None:
        for t in range(self.steps):
            self.learner.update(t)


def share() -> None:
    """Let all cores share a matrix product, as PyTorch would by itself."""
    torch.set_num_threads(default_torch_threads())


def watch(ours: Ours) -> Phases:
    """Time the phases of a loop from now on."""
    phases, loop = Phases(), ours.loop
    learner, fleet = ours.assembly.learner, loop.fleet
    phases.watch(loop, "step", "loop and events")
    phases.watch(loop, "_observe", "observe, act")
    loop.signals = {name: phases.timed(signal, "signals") for name, signal in loop.signals.items()}
    loop.priority = phases.timed(loop.priority, "priority")  # type: ignore[assignment]
    phases.watch(loop, "_allocate", "allocation")
    phases.watch(loop.team, "act", "supervisors")
    phases.watch(fleet, "step_async", "task code")
    phases.watch(fleet, "step_wait", "task code")
    phases.watch(fleet, "reset", "reset")
    physics = fleet.physics  # type: ignore[attr-defined]
    phases.watch(physics, "restart", "reset")
    advance = physics.advance_async

    def watched(*arguments: Any) -> Together:
        moves = advance(*arguments)
        phases.watch(moves, "results", TOGETHER)
        return moves

    physics.advance_async = watched
    phases.watch(learner, "record", "record")
    phases.watch(learner, "hear", "record")
    phases.watch(learner.regression, "begin", "sampling")
    phases.watch(learner.regression, "end", TOGETHER)
    phases.watch(learner, "update", "gradients of the critic")
    phases.watch(learner.dataset, "draw", "sampling")
    for critic in learner.critics.values():
        for ring in (critic.plain, critic.events):
            phases.watch(ring, "draw", "sampling")
    return phases


def run(quick: bool = False) -> dict[str, Any]:
    """Both tasks: milliseconds a timestep, the ratios, and where the rest of the time goes."""
    rows, where, results = [], [], []
    for task in ("Walker2d", "Humanoid"):
        result = measure(task, steps=20 if quick else 30, rounds=3 if quick else 7)
        ms, ratios = result["milliseconds"], result["ratios"]
        rows.append([task, *(ms[name] for name in VARIANTS), *ratios.values()])
        where += [[task, phase, took] for phase, took in result["phases"].items()]
        results.append({"task": task, **result})
    print(table(["ms a timestep", *VARIANTS, *result["ratios"]], rows))
    print()
    print(table(["ours in lock-step", "phase", "ms a timestep"], where))
    return {"loop": results}


VARIANTS = ("original", "ours", "ours, overlap", "raw physics", "raw gradients", "raw gradients, PyTorch")


def measure(task: str, steps: int, rounds: int) -> dict[str, Any]:
    """One task; every variant runs `steps` timesteps in each round."""
    lockstep, overlap = (Ours(task, steps, overlap=o) for o in (False, True))
    physics, gradients = RawPhysics(Ours(task, steps)), RawGradients(ready(task, pretrain=PRETRAIN), steps)
    library = RawGradients(ready(task, pretrain=PRETRAIN), steps, library=True)
    data, moved = lockstep.assembly.learner.dataset, Headcount()
    original = OriginalLoop(
        task, lockstep.assembly.config, lockstep.assembly.actor,
        (data.obs.rows[:OFFLINE].numpy(), data.actions.rows[:OFFLINE].numpy()), PRETRAIN, moved.counts.append,
    )  # fmt: skip
    original.run(WARM)
    for counter in (lockstep.moved, overlap.moved, moved):
        counter.counts.clear()

    phases = watch(lockstep)
    seconds = take_turns(
        {
            "original": lambda: original.run(steps), "ours": lockstep, "ours, overlap": overlap,
            "raw physics": physics, "raw gradients": gradients, "raw gradients, PyTorch": library,
        }, rounds, before={
            "original": share, "raw gradients, PyTorch": share, "ours": lockstep.threads, "ours, overlap": overlap.threads,
            "raw physics": physics.record,
        },
    )  # fmt: skip
    assert np.array_equal(physics.run.loop.obs, lockstep.loop.obs), "the floor is that of another run"
    original.envs.close()
    floors = ("raw physics", "raw gradients")
    public = ("raw physics", "raw gradients, PyTorch")
    return {
        "milliseconds": {name: 1e3 * float(np.median(seconds[name])) / steps for name in VARIANTS},
        "ratios": {
            "original / ours": ratio(seconds, "original", "ours"),
            "original / overlap": ratio(seconds, "original", "ours, overlap"),
            "ours / floor": ratio(seconds, "ours", *floors),
            "overlap / floor": ratio(seconds, "ours, overlap", *floors),
            "ours / floor with PyTorch": ratio(seconds, "ours", *public),
            "overlap / floor with PyTorch": ratio(seconds, "ours, overlap", *public),
        },
        "robots that moved": {"original": moved.mean, "ours": lockstep.moved.mean, "ours, overlap": overlap.moved.mean},
        "phases": {name: 1e3 * took / steps / rounds for name, took in sorted(phases.seconds.items(), key=lambda p: -p[1])},
        "threads": {
            "physics": lockstep.loop.fleet.physics.threads,  # type: ignore[attr-defined]
            "torch": lockstep.torch_threads,
            "torch, original": default_torch_threads(),
        },
    }
