"""What a person sees while a run goes on: a progress bar with live metrics on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.fleet.tally import Tally


def stages(say: Callable[[str], None], seconds: float = 10.0) -> Callable[[str, float], None]:
    """What tells of a preparation in few lines: each stage as it begins, and how far it is every so many seconds.

    Args:
        say: takes a line.
        seconds: between two lines of a stage.
    """
    stage, due = "", 0.0

    def report(what: str, done: float) -> None:
        nonlocal stage, due
        now = time.monotonic()
        if what != stage or now >= due:
            stage, due = what, now + seconds
            say(f"preparing: {what}" + (f" {done:.0%}" if 0 < done < 1 else ""))

    return report


class ProgressDisplay:
    """Shows timesteps, ETA, successes, ROHE, falls and busy humans.

    Args:
        name: of the run.
        steps: T.
        tally: what to show.
        console: where to.
    """

    def __init__(self, name: str, steps: int, tally: Tally, console: Console) -> None:
        self._name, self._steps, self._tally, self._console = name, steps, tally, console
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[metrics]}"),
            console=console,
        )
        self._task = self._bar.add_task(name, total=steps, metrics="")
        self._shown = 0.0

    def on_start(self, loop: Loop) -> None:
        """Show the bar."""
        if self._console.is_terminal:
            self._bar.start()
        self._bar.update(self._task, completed=loop.t)
        self._began, self._first = time.monotonic(), loop.t

    def on_step(self, loop: Loop, step: Step) -> None:
        """Refresh a few times a second; without a terminal, a line every tenth of the run."""
        if self._console.is_terminal:
            if time.monotonic() - self._shown > 0.2 or loop.t == self._steps:
                self._shown = time.monotonic()
                self._bar.update(self._task, completed=loop.t, metrics=self._metrics(loop))
        elif loop.t % max(1, self._steps // 10) == 0:
            rate = (loop.t - self._first) / max(1e-9, time.monotonic() - self._began)
            self._console.print(
                f"{self._name}  {loop.t}/{self._steps}  {rate:.0f} steps/s  {self._metrics(loop)}", highlight=False
            )

    def on_end(self, loop: Loop) -> None:
        """Take the bar down."""
        self._bar.stop()

    def _metrics(self, loop: Loop) -> str:
        m = self._tally.summary()
        busy = int((loop.robot_of >= 0).sum())
        return (
            f"successes {m['successes']:.0f}  ROHE {m['rohe']:.2f}  falls {m['violations']:.0f}  "
            f"humans busy {busy}/{len(loop.robot_of)}"
        )
