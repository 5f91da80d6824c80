"""A frozen policy at work: how good is it by itself, or with help (appendix C.3, table C.2)?"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tutelage.errors import ConfigError, RunFolderError
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.run import loop_state, read_config
from tutelage.fleet.policy import Policy
from tutelage.fleet.priority import Uncertainty, parse
from tutelage.fleet.step import Subscriber
from tutelage.fleet.tally import Counting, Tally
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.store import write_atomic

LEARNED = {"risk", "goal", "predicted_discrepancy"}
"""Signals of the learner's critics and classifier. A run folder has those that its own priority looks at."""


def evaluate_policy(
    config: RunConfig,
    policy: Policy | None,
    priority: str = "C.",
    tally: Tally | None = None,
    subscribers: Sequence[Subscriber] = (),
    learned: dict[str, Any] | None = None,
) -> dict[str, float]:
    """Run a frozen policy for `config.steps` timesteps; returns the metrics.

    Args:
        config: of the run: everything but its learning and its initial period t_I is taken from it.
        policy: the policy; None: the algorithmic expert itself.
        priority: who gets help; "C." gives hard resets and nothing else. Terms that look at the policy's signals
            need a policy that has them.
        tally: where to count, for a display that watches it.
        subscribers: listeners, such as a progress display.
        learned: the state of the run's loop, for priorities that look at its critics or its classifier. If `priority` is
            the run's own, it goes on with the thresholds that it had at the end of the run.

    Raises:
        ConfigError: the priority looks at something that this run has not learned.
    """
    # The period t_I without hard resets belongs to the beginning of learning.
    thresholds = dataclasses.replace(config.thresholds, initial=0)
    asked = parse(priority, thresholds, config.gate)
    if thresholds.uncertainty is None and any(isinstance(term, Uncertainty) for term in asked.terms):
        raise ConfigError(f"this run has no threshold of uncertainty, which {priority} needs; choose C. or Random.")
    assembly = assemble(dataclasses.replace(config, priority=priority, thresholds=thresholds))
    wanted = LEARNED & asked.needs
    if wanted and policy is not None:
        try:
            assembly.learner.load_state_dict((learned or {})["learner"])
        except KeyError:
            able = list(dict.fromkeys(name for name in (config.priority, "U.C.", "C.") if name != priority))
            raise ConfigError(
                f"this run did not learn {', '.join(sorted(wanted))}, which {priority} looks at; evaluate it with "
                f"{', '.join(able[:-1])} or {able[-1]}"
            ) from None
    tally = tally or Tally(config.robots, config.humans)
    loop = assembly.loop(frozen=assembly.human if policy is None else policy)
    if learned and priority == config.priority:
        loop.priority.load_state_dict(learned["priority"])
    loop.subscribers = [Counting(tally), *subscribers]
    loop.run(config.steps)
    assembly.fleet.close()
    return tally.summary()


def evaluate_run(
    folder: Path,
    steps: int,
    priority: str = "C.",
    expert: bool = False,
    tally: Tally | None = None,
    subscribers: Sequence[Subscriber] = (),
) -> dict[str, Any]:
    """Evaluate the policy of a run folder as in table C.2, and write `evaluation.json` there.

    Raises:
        RunFolderError, TutelageError: no run there, or no policy in it.
    """
    config = dataclasses.replace(read_config(folder), steps=steps)
    if not os.access(folder, os.W_OK):  # before minutes of evaluation
        raise RunFolderError(f"cannot write to {folder}, where the result goes; evaluate a copy of it")
    policy = None if expert else EnsemblePolicy.load(folder / "policy.safetensors")[0]
    remembers = priority == config.priority or LEARNED & parse(priority, gate=config.gate).needs
    learned = loop_state(folder) if remembers and not expert else None
    metrics = evaluate_policy(config, policy, priority, tally, subscribers, learned)
    result = {"steps": steps, "priority": priority, "policy": "expert" if expert else "run", **metrics}
    write_atomic(evaluation_path(folder, expert), json.dumps(result, indent=2).encode())
    return result


def evaluation_path(folder: Path, expert: bool) -> Path:
    """Where the evaluation of a run's policy, or of the expert, is kept."""
    return folder / ("evaluation-expert.json" if expert else "evaluation.json")
