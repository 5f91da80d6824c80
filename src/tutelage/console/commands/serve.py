"""The verb `tutelage serve`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tutelage.console.audit import Audit
    from tutelage.console.supervision import Supervision


def serve(
    fleet: str = "sim:Navigation",
    robots: int = 8,
    humans: int = 4,
    priority: str = "C.U.R.",
    queue: Literal["priority", "fifo"] = "priority",
    hz: float = 10.0,
    lockstep: bool = False,
    policy: str | None = None,
    learner: Literal["process", "inline", "none"] = "process",
    seed: int = 0,
    out: Path = Path("served"),
    host: str = "127.0.0.1",
    port: int = 8800,
    certificate: Path | None = None,
    key: Path | None = None,
    origin: str | None = None,
) -> None:
    """The supervision server: a fleet at work, people who help it in their browsers, a policy that learns from them.

    Args:
        fleet: sim:TASK (see tutelage info; or sim:module:function), or net:HOME, remote robots (see tutelage robot).
        robots: N of a simulated fleet.
        humans: M, seats for operators, at most one a robot.
        priority: which robots ask for help: terms of C, U, R, G, Random with dots, an algorithm such as ThriftyDAgger, or
            your own as module:callable.
        queue: who is next: the neediest robot, or the one that asked first.
        hz: timesteps a second.
        lockstep: the simulation waits for the people who hold robots.
        policy: a run folder to start with its policy; none: an untrained one; left out: clone the algorithmic human first.
        learner: beside the loop, within it, or none: the policy stays as it is.
        seed: root seed.
        out: folder of accounts, record, policy and checkpoints; a folder that was served before is continued.
        host: address to listen on; others than this machine's own need a certificate, a key and accounts.
        port: 0: any free one.
        certificate: PEM file of the server's certificate, for HTTPS; left out: HTTP, on this machine only.
        key: PEM file of its private key, without a password; left out: only where there is no certificate.
        origin: how browsers reach the server through a proxy that you run in front of it, such as https://robots.example;
            left out: they reach it directly.
    """
    from tutelage.console.serve import WebConfig
    from tutelage.console.serve import serve as run

    web = WebConfig(host, port, certificate, key, origin)
    web.check()
    from tutelage.console.config import EngineConfig
    from tutelage.console.parts import check_folder
    from tutelage.console.supervision import Supervision
    from tutelage.experiments.progress import stages

    engine = EngineConfig(
        fleet=fleet, robots=robots, humans=humans, priority=priority, queue=queue, hz=hz, lockstep=lockstep, policy=policy,
        learner=learner, seed=seed, out=out,
    )  # fmt: skip

    check_folder(out)

    def say(line: str) -> None:
        print(line, flush=True)

    def open_supervision(audit: Audit) -> Supervision:
        say(f"opening {fleet}")
        return Supervision.open(engine, audit, stages(say))

    run(open_supervision, out, web, say)
