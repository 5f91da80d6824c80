"""What it costs to see: drawing, acting on and learning from 64 x 64 images, on one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, elu_

from benchmarks.timing import ratio, table, take_turns
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig
from tutelage.policies.vision import LAYERS, BatchedCNN

BATCH = 64
"""Images in a gradient step of a network (appendix B.2)."""


def run(quick: bool = False) -> dict[str, Any]:
    """Milliseconds of each part of a timestep of CableRouting by the number of robots, and of a gradient step."""
    parts = {str(robots): timestep(robots, 5 if quick else 20) for robots in (1, 100)}
    head = ["robots", *next(iter(parts.values()))]
    print(table(head, [[robots, *part.values()] for robots, part in parts.items()]))
    steps = gradient_steps(3 if quick else 15)
    print("\n" + table(["gradient step, 64 images a network", "ms"], [[name, ms] for name, ms in steps["ms"].items()]))
    print(f"\ngrouped convolutions take {steps['grouped / one by one']:.2f} times as long as one network after the other")
    return {"timestep": parts, "gradient step": steps}


def parts_of(robots: int) -> tuple[Any, MujocoFleet]:
    """A run on images and a fleet that observes its state, both at their first timestep."""
    c = RunConfig(
        "CableRouting", "ThriftyDAgger", observation="images", robots=robots, humans=1, threads=1, torch_threads=1,
        learner=LearnerConfig(batch=BATCH), critic=CriticConfig(batch=BATCH),
    )  # fmt: skip
    blind = MujocoFleet("CableRouting", robots, threads=1)
    blind.reset(seed=0)
    return assemble(c), blind


def timestep(robots: int, rounds: int) -> dict[str, float]:
    """Medians, ms."""
    run, blind = parts_of(robots)
    fleet, policy, goal = run.fleet, run.policy, run.learner.critics["goal"]
    obs, _ = fleet.reset(seed=0)
    actions, rng = policy.act(obs), np.random.default_rng(0)

    def act() -> None:
        policy.forget()
        policy.act(obs)
        policy.uncertainty(obs)

    work: dict[str, Callable[[], Any]] = {
        "physics": lambda: blind.step(rng.uniform(-1, 1, actions.shape)),
        "draw": fleet.images,
        "policy": act,
        "critic": lambda: goal(obs, actions),
    }
    seconds = take_turns(work, rounds)
    found = {f"{name}, ms": 1e3 * float(np.median(s)) for name, s in seconds.items()}
    found["images a second"] = robots * 1e3 / found["draw, ms"]
    for each in (fleet, blind):
        each.close()
    return found


def gradient_steps(rounds: int) -> dict[str, Any]:
    """Medians, ms; and the ratio of two ways to train five networks."""
    run, blind = parts_of(100)
    obs, _ = run.fleet.reset(seed=0)
    actions = run.policy.act(obs)
    goal = run.learner.critics["goal"]
    run.learner.dataset.add(obs, actions)
    goal.add(obs, actions, obs, np.arange(100) < 10, np.arange(100) < 10)
    x = run.policy.normalise(torch.from_numpy(obs[:BATCH])).expand(5, -1, -1, -1, -1)
    net = run.policy.net

    def learn(forward: Callable[[BatchedCNN, Tensor], Tensor]) -> None:
        net.zero_grad(set_to_none=True)
        forward(net, x).square().sum().backward()

    seconds = take_turns(
        {
            "policy, 5 networks": lambda: run.learner.gradient_steps(1),
            "critic, 2 networks": goal.update,
            "one by one": lambda: learn(lambda net, x: torch.stack([net._embed(k, x[k]) for k in range(5)])),
            "grouped": lambda: learn(grouped),
        },
        rounds,
    )
    for each in (run.fleet, blind):
        each.close()
    ms = {name: 1e3 * float(np.median(s)) for name, s in seconds.items()}
    return {
        "ms": {name: ms[name] for name in list(ms)[:2]},
        "convolutions, ms": {name: ms[name] for name in list(ms)[2:]},
        "grouped / one by one": ratio(seconds, "grouped", "one by one"),
    }


def grouped(net: BatchedCNN, x: Tensor) -> Tensor:
    """The convolutions of all members at once: (K, B, H, W, C) -> (B, K * 64)."""
    x = x.permute(1, 0, 4, 2, 3).flatten(1, 2)
    for kernels, biases, (_, _, stride) in zip(net.kernels, net.biases, LAYERS, strict=True):
        x = elu_(conv2d(x, kernels.flatten(0, 1), biases.flatten(), stride, groups=len(kernels)))
    return x.flatten(1)
