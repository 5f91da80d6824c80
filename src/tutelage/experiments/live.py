"""Plots that follow a run: `plots/curves.png`, drawn anew while it goes on, and TensorBoard for those who ask."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from tutelage.errors import MissingExtraError, TutelageError
from tutelage.experiments.recording import Recorder
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step


class LivePlots:
    """Redraws the curves of a run about once in `seconds`; without matplotlib there are none.

    Args:
        folder: the run folder.
        seconds: between two drawings.
    """

    def __init__(self, folder: Path, seconds: float = 20.0) -> None:
        self._folder, self._seconds = folder, seconds
        self._last = time.monotonic()

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Draw when the last drawing is old."""
        if time.monotonic() - self._last > self._seconds:
            self.draw()
            self._last = time.monotonic()

    def on_end(self, loop: Loop) -> None:
        """Draw the end."""
        self.draw()

    def draw(self) -> None:
        """Draw the curves so far, if there are any. A picture that fails must not end a run, nor hide why one ended."""
        from tutelage.experiments import plots
        from tutelage.experiments.records import load_run

        try:
            plots.save(plots.curves([load_run(self._folder)]), self._folder / "plots" / "curves.png")
        except MissingExtraError:
            self._seconds = float("inf")
        except TutelageError:  # no line of metrics yet, or a full disk, which the recorder will report
            pass


class TensorBoard:
    """Writes the metrics of `metrics.jsonl` to `tensorboard/` in the run folder as well (extra `tensorboard`).

    Args:
        folder: the run folder.
        recorder: whose metrics.
    """

    def __init__(self, folder: Path, recorder: Recorder) -> None:
        self._writer = self.writer()(folder / "tensorboard")
        self._recorder = recorder

    @staticmethod
    def writer() -> Any:
        """The class that writes, or a `MissingExtraError`."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise MissingExtraError("tensorboard", "tensorboard") from None
        return SummaryWriter

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Write what the recorder writes, when it does."""
        if self._recorder.due(loop.t):
            for name, value in self._recorder.row().items():
                self._writer.add_scalar(name, value, loop.t)

    def on_end(self, loop: Loop) -> None:
        """Close the files."""
        self._writer.close()
