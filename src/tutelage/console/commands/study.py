"""The user study of table 3.2 with people: run, table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

if TYPE_CHECKING:
    from tutelage.console.audit import Audit
    from tutelage.console.study import Study


def run(
    participant: Positional[int],
    out: Path = Path("study"),
    hz: float = 10.0,
    steps: int = 350,
    practice: bool = True,
    host: str = "127.0.0.1",
    port: int = 8800,
    certificate: Path | None = None,
    key: Path | None = None,
    origin: str | None = None,
) -> None:
    """One participant's session in the browser: practice, four conditions in random order, the questions of the NASA-TLX.

    The first start of a participant trains their base policies, which takes minutes; do it before they come.

    Args:
        participant: their number, 0 or more.
        out: folder of the whole study.
        hz: timesteps a second at most; the simulation waits for whoever holds a robot.
        steps: timesteps of a condition.
        practice: begin with the practice of appendix B.4.
        host: address to listen on; others than this machine's own need a certificate, a key and accounts.
        port: 0: any free one.
        certificate: PEM file of the server's certificate, for HTTPS; left out: HTTP, on this machine only.
        key: PEM file of its private key, without a password; left out: only where there is no certificate.
        origin: how browsers reach the server through a proxy that you run in front of it, such as https://robots.example;
            left out: they reach it directly.
    """
    from tutelage.console.serve import WebConfig, serve

    web = WebConfig(host, port, certificate, key, origin)
    web.check()
    from tutelage.console.study import Study
    from tutelage.console.study_parts import StudyConfig
    from tutelage.experiments.progress import stages

    config = StudyConfig(participant, out, hz, steps, practice)

    def say(line: str) -> None:
        print(line, flush=True)

    def open_study(audit: Audit) -> Study:
        return Study(config, audit, stages(say))

    serve(open_study, out, web, say)


def table(folder: Positional[Path]) -> None:
    """Table 3.2 and the answers to the questions, over all participants of a study who are done.

    Args:
        folder: of the study.
    """
    from tutelage.console.study_table import study_table

    print(study_table(folder), end="")


VERBS = {"run": run, "table": table}
