"""Trials with people at consoles, here scripted ones: figure 5.5 over the same sockets as the page.

    python -m tutelage.console.trial '{"priority": "C.U.R.", "seed": 0}'

A whole server on loopback, as `tutelage serve` starts it, and operators who log in, are offered robots, accept, drive and
give back. Prints the result as one line of JSON. `tutelage reproduce figure-5.5-remote` runs many of these.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import queue
import secrets
import signal
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tutelage.console.accounts import Accounts, Role
from tutelage.console.audit import Audit
from tutelage.console.parts import EngineConfig
from tutelage.console.scripted import ScriptedOperator, Tally, after
from tutelage.console.serve import WebConfig, serve
from tutelage.console.supervision import Supervision
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments.records import load_run
from tutelage.fleet import metrics
from tutelage.fleet.priority import PriorityConfig

PATIENCE = 900.0
"""Seconds after which a trial that does not end is given up."""


@dataclass(frozen=True)
class TrialConfig:
    """One trial.

    Attributes:
        task: name of a task with a shipped human.
        priority: p-hat.
        seed: root seed.
        robots: N.
        humans: M, operators at consoles of their own.
        steps: T.
        t_teleop: t_T, timesteps after which an operator gives a robot back.
        t_reset: t_R.
        hz: timesteps a second; the simulation waits for operators who have a robot.
        react: seconds that an operator takes to accept.
        random: threshold of the Random term.
        learner: whether the policy learns from them.
        observation: what the policy sees.
        pairs: state-action pairs of the demonstrations before the trial; None: the task's own.
    """

    task: str = "BlockPushing"
    priority: str = "C.U.R."
    seed: int = 0
    robots: int = 4
    humans: int = 2
    steps: int = 250
    t_teleop: int = 3
    t_reset: int = 5
    hz: float = 10.0
    react: float = 0.3
    random: float | None = None
    learner: bool = True
    observation: str = "state"
    pairs: int | None = None

    def engine(self, out: Path) -> EngineConfig:
        """The server's settings."""
        thresholds = PriorityConfig(initial=0)  # no time without hard resets: a trial is too short for that
        if self.random is not None:
            thresholds = dataclasses.replace(thresholds, random=self.random)
        return EngineConfig(
            f"sim:{self.task}", self.robots, self.humans, self.priority, hz=self.hz, lockstep=True, seed=self.seed, out=out,
            learner="process" if self.learner else "none", t_reset=self.t_reset, replay=False,
            run={
                "thresholds": thresholds, "observation": self.observation, "offline_pairs": self.pairs,
                "threads": 1, "torch_threads": 1,
            },
        )  # fmt: skip


def trial(config: TrialConfig, out: Path) -> dict[str, Any]:
    """Run a trial in a folder; returns its metrics and what the operators did. In the main thread only.

    Raises:
        TutelageError: the server or an operator failed, or it took too long.
    """
    out.mkdir(parents=True, exist_ok=True)
    names = [f"operator-{k + 1}" for k in range(config.humans)]
    passwords = {name: secrets.token_urlsafe(16) for name in names}
    accounts = Accounts(out)
    for name in names:
        accounts.add(name, Role.OPERATOR, passwords[name])
    accounts.close()
    said: queue.SimpleQueue[str] = queue.SimpleQueue()
    made: list[Supervision] = []
    tallies: list[Tally] = []
    failed: list[BaseException] = []

    def open_supervision(audit: Audit) -> Supervision:
        made.append(Supervision.open(config.engine(out), audit))
        return made[0]

    def work() -> None:
        try:
            while not (line := said.get()).startswith("console: "):  # it listens from then on
                pass
            address = urlsplit(line.removeprefix("console: "))
            end = time.monotonic() + PATIENCE

            def over() -> bool:
                return made[0].snapshot().t >= config.steps or time.monotonic() > end

            people = [
                ScriptedOperator(
                    f"http://{address.netloc}", name, passwords[name], config.react, rule=after(config.t_teleop)
                )
                for name in names
            ]

            async def all_of_them() -> None:
                tallies.extend(await asyncio.gather(*(each.run(until=over) for each in people)))

            asyncio.run(all_of_them())
        except BaseException as error:  # told in the main thread
            failed.append(error)
        finally:
            signal.raise_signal(signal.SIGTERM)

    worker = threading.Thread(target=work, name="operators", daemon=True)
    worker.start()
    serve(open_supervision, out, WebConfig(port=0), said.put)
    worker.join()
    if failed:
        raise TutelageError(f"an operator failed: {failed[0]}") from failed[0]
    log = load_run(out).log
    if log.steps < config.steps:
        raise TutelageError(f"only {log.steps} of {config.steps} timesteps in {PATIENCE:g} s")
    return {
        "algorithm": config.priority, "seed": config.seed, "config": dataclasses.asdict(config),
        "metrics": metrics.summary(log.until(config.steps)), "operators": [_plain(tally) for tally in tallies],
    }  # fmt: skip


def _plain(tally: Tally) -> dict[str, Any]:
    counts = dataclasses.asdict(tally)
    for series in ("round_trips", "latency", "delays"):
        values = sorted(counts.pop(series))
        counts[f"{series}_median"] = values[len(values) // 2] if values else None
    return counts


def main() -> None:
    """Run the trial of the command line in a temporary folder."""
    try:
        config = TrialConfig(**json.loads(sys.argv[1] if len(sys.argv) > 1 else "{}"))
    except (TypeError, ValueError) as error:
        raise SystemExit(f"tutelage: {ConfigError(f'a trial is described by a JSON object: {error}')}") from None
    try:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(trial(config, Path(folder))))
    except TutelageError as error:
        raise SystemExit(f"tutelage: {error}") from None


if __name__ == "__main__":
    main()
