"""What the benchmarks share: a fleet with humans that is ready to run after seconds."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from tutelage.experiments.assemble import Assembly, assemble
from tutelage.experiments.config import RunConfig
from tutelage.fleet.priority import PriorityConfig

ROBOTS, HUMANS = 100, 10
OFFLINE = 5000
"""State-action pairs before the run (the dissertation's number)."""


def ready(task: str, seed: int = 0, pretrain: int = 100, **settings: Any) -> Assembly:
    """100 robots, 10 humans, C.U.R., in a calm world; cloned for a while, so that the thresholds mean something.

    `t_I` is 0: fallen robots are reset from the start, as they are during most of a run.
    """
    config = RunConfig(
        task=task, robots=ROBOTS, humans=HUMANS, seed=seed, disturbance="none",
        thresholds=PriorityConfig(initial=0), **settings,
    )  # fmt: skip
    assembly = assemble(config)
    fleet, learner, policy = assembly.fleet, assembly.learner, assembly.policy
    obs, _ = fleet.reset(seed=seed)
    seen, done = [], []
    for _ in range(OFFLINE // ROBOTS):
        action = assembly.actor.act(obs)
        seen.append(obs)
        done.append(action)
        after, _, violation, _, info = fleet.step(action)
        for critic in learner.critics.values():
            critic.add(obs, action, after, violation, end=violation)
        obs, _ = fleet.reset(options={"reset_mask": info["violation"]})
    policy.set_normalisation(np.concatenate(seen).astype(np.float32))
    learner.dataset.add(np.concatenate(seen), np.concatenate(done))
    learner.gradient_steps(pretrain)
    for critic in learner.critics.values():
        critic.updates(pretrain)
    uncertainty = np.concatenate([policy.uncertainty(o) for o in seen])
    risk = np.concatenate([learner.critics["risk"](o, a) for o, a in zip(seen, done, strict=True)])
    found = PriorityConfig(float(np.quantile(uncertainty, 0.9)), float(np.quantile(risk, 0.99)), initial=0)
    return dataclasses.replace(assembly, config=dataclasses.replace(assembly.config, thresholds=found))
