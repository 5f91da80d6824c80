"""The user study of appendix B.4 with a person at the console: which part comes when, what is counted, what is kept.

Three robots, four conditions in the participant's own random order, behind neutral labels. Where robots ask by themselves
(SafeDAgger, LazyDAgger, ThriftyDAgger) the person plays Concentration until one calls, and the algorithm says when it goes
on by itself; with HG-DAgger they watch all three and take one when they see fit. The simulation waits for who holds a robot.
"""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tutelage.console.audit import Audit
from tutelage.console.study_parts import FORMAT, LABELS, OutOfOrderError, Part, StudyConfig, engine_of, read_result
from tutelage.console.supervision import Supervision
from tutelage.errors import ConfigError
from tutelage.experiments.jobs import slug
from tutelage.experiments.user_study.concentration import CARDS, PRACTICE_CARDS, Table
from tutelage.experiments.user_study.protocol import (
    CONDITIONS,
    HUMAN_GATED,
    QUESTIONS,
    SCALE,
    Counting,
    order,
)
from tutelage.files import write_atomic
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.seeding import stream

Report = Callable[[str, float], None]


class Study:
    """One participant's session. Thread-safe; `changed` is called after every change, from any thread.

    Args:
        config: the session.
        audit: the record.
        report: told what is being prepared.

    Raises:
        ConfigError: this participant is done.
    """

    def __init__(self, config: StudyConfig, audit: Audit, report: Report = lambda what, done: None) -> None:
        self.config, self.audit = config, audit
        self.changed: Callable[[], None] = lambda: None
        self._lock = threading.RLock()
        self._answered = False
        self._opened: list[Supervision] = []
        self.algorithms = order(config.participant)
        done = {algorithm for algorithm in CONDITIONS if self._file(algorithm).exists()}
        if len(done) == len(CONDITIONS) and all("answers" in self._read(a) for a in CONDITIONS):
            raise ConfigError(f"participant {config.participant} is done; results: tutelage study table {config.out}")
        try:
            self._parts = self._make(done, report)
        except BaseException:
            self.close()
            raise
        self._at = 0

    def _make(self, done: set[str], report: Report) -> list[Part]:
        parts = [Part("welcome", state="running")]
        p = self.config.participant
        if self.config.practice and not done:
            parts.append(Part("practice_game", table=Table(PRACTICE_CARDS, stream(p, "practice cards"))))
            for kind, algorithm in (("practice_requests", CONDITIONS[1]), ("practice_monitoring", HUMAN_GATED)):
                table = Table(CARDS, stream(p, "cards between practice")) if algorithm != HUMAN_GATED else None
                parts.append(self._with_robots(Part(kind, algorithm, table=table), 1000 + p, report))  # type: ignore[arg-type]
        for label, algorithm in zip(LABELS, self.algorithms, strict=True):
            if algorithm not in done:
                table = Table(CARDS, stream(p, f"cards {label}")) if algorithm != HUMAN_GATED else None
                parts.append(self._with_robots(Part("condition", algorithm, label, table=table), p, report))
        if not self._opened:  # only the survey is left: robots stand beside it
            self._with_robots(Part("practice_monitoring", HUMAN_GATED), 1000 + p, report)
        return [*parts, Part("survey"), Part("done")]

    def _with_robots(self, part: Part, seed: int, report: Report) -> Part:
        name = part.kind if part.kind != "condition" else slug(part.algorithm or "")
        folder = self.config.out / f"participant-{self.config.participant}" / name
        if (folder / "began").exists():  # it was interrupted, and half a condition is none
            shutil.rmtree(folder)
        said = f"participant {self.config.participant}, {part.kind} {part.label or ''}".rstrip()
        engine = engine_of(self.config, part.algorithm or "", seed, folder)
        part.supervision = Supervision.open(engine, self.audit, lambda what, done: report(f"{said}: {what}", done))
        self._opened.append(part.supervision)
        part.counting = Counting()
        if part.algorithm == HUMAN_GATED:
            part.counting.counts.idle_time = None
        budget = Budget(self, part, self.config.steps if part.kind == "condition" else None)
        part.supervision.engine.loop.subscribers[:0] = [part.counting, budget]
        return part

    # -- what the page asks -------------------------------------------------------------------------------------

    @property
    def part(self) -> Part:
        """The present part."""
        return self._parts[self._at]

    @property
    def supervision(self) -> Supervision:
        """The robots of the present part, or of the next one that has some, or the last."""
        later = [part.supervision for part in self._parts[self._at :] if part.supervision]
        return later[0] if later else self._opened[-1]

    def state(self) -> dict[str, Any]:
        """What a page shows; nothing of it names an algorithm."""
        with self._lock:
            part = self.part
            game = part.table.game if part.table else None
            board = None
            if game and part.table:
                board = {"cards": game.cards, "face_up": game.face_up, "pairs": part.table.pairs, "turns": game.turns}
            return {
                "participant": self.config.participant, "stage": part.kind, "state": part.state, "label": part.label,
                "index": LABELS.index(part.label) if part.label else None, "of": len(CONDITIONS),
                "interface": part.interface, "t": part.t, "steps": self.config.steps if part.kind == "condition" else None,
                "calls": bool(part.counting and part.state == "running" and part.counting.called), "board": board,
                "questions": QUESTIONS, "scale": list(SCALE), "labels": list(LABELS),
            }  # fmt: skip

    def next(self, who: str) -> None:
        """Begin the present part, or go on to the next one.

        Raises:
            OutOfOrderError: a condition is running, or the survey has not been answered.
        """
        with self._lock:
            part = self.part
            if part.supervision and part.state == "ready":
                self._begin(part, who)
            elif part.kind == "condition" and part.state == "running":
                raise OutOfOrderError("this part ends by itself")
            elif part.kind in ("survey", "done"):
                raise OutOfOrderError("answer the questions" if part.kind == "survey" else "the study is over; thank you")
            else:
                part.state = "over"
                self._at += 1
                if not self.part.supervision:
                    self.part.state = "running"
            self.audit.write("study", who, stage=self.part.kind, state=self.part.state, label=self.part.label)
        self.changed()

    def _begin(self, part: Part, who: str) -> None:
        assert part.supervision is not None
        write_atomic(part.supervision.engine.config.out / "began", who.encode())
        part.state = "running"
        part.supervision.start()

    def turn(self, card: int) -> dict[str, Any]:
        """Turn a card over: {card, picture, pair, board}.

        Raises:
            OutOfOrderError: there are no cards now, or the card is face up.
        """
        with self._lock:
            table = self.part.table
            if table is None or self.part.state != "running":
                raise OutOfOrderError("there are no cards now")
            if card not in table.game.face_down:
                raise OutOfOrderError("choose a card that lies face down")
            turned = table.turn(card)
        self.changed()
        return {"card": turned.card, "picture": turned.picture, "pair": turned.pair, "board": self.state()["board"]}

    def answer(self, who: str, answers: dict[str, dict[str, int]]) -> None:
        """The survey: by label, by question, a number of the scale.

        Raises:
            OutOfOrderError: it is not its time.
            ConfigError: an answer is missing, or not on the scale.
        """
        with self._lock:
            if self.part.kind != "survey":
                raise OutOfOrderError("the questions come after the last part")
            low, high = SCALE
            if answers.keys() != set(LABELS) or any(a.keys() != QUESTIONS.keys() for a in answers.values()):
                raise ConfigError("answer every question for every part")
            if not all(low <= value <= high for a in answers.values() for value in a.values()):
                raise ConfigError(f"an answer is from {low} to {high}")
            for label, algorithm in zip(LABELS, self.algorithms, strict=True):
                result = self._read(algorithm) | {"answers": answers[label]}
                write_atomic(self._file(algorithm), json.dumps(result, indent=2).encode())
            self.audit.write("study", who, stage="survey", state="over", answers=answers)
            self._at += 1
            self.part.state = "over"
        self.changed()

    def retire(self, supervision: Supervision) -> None:
        """End the robots of a part that is over. Waits for it."""
        supervision.close()
        self._opened.remove(supervision)

    def close(self) -> None:
        """End the robots of all parts."""
        while self._opened:
            self.retire(self._opened[-1])

    # -- from the loop's thread ---------------------------------------------------------------------------------

    def stepped(self, part: Part, t: int) -> None:
        """A timestep of a part is over."""
        part.t = t
        self.changed()

    def ended(self, part: Part) -> None:
        """The last timestep of a condition is over: keep what was counted."""
        assert part.algorithm is not None
        assert part.counting is not None
        with self._lock:
            counts = part.counting.counts
            counts.pairs = part.table.pairs if part.table else None
            result = {
                "format": FORMAT, "algorithm": part.algorithm, "seed": self.config.participant, "counts": counts.to_json(),
                "order": self.algorithms.index(part.algorithm), "steps": self.config.steps,
            }  # fmt: skip
            write_atomic(self._file(part.algorithm), json.dumps(result, indent=2).encode())
            part.state = "over"
            self.audit.write("study", "server", stage="condition", state="over", label=part.label, counts=counts.to_json())
        self.changed()

    def _file(self, algorithm: str) -> Path:
        return self.config.out / "results" / f"{slug(algorithm)}-s{self.config.participant}.json"

    def _read(self, algorithm: str) -> dict[str, Any]:
        return read_result(self._file(algorithm))


class Budget:
    """A subscriber: tells the study of each timestep, and ends the loop after the last one of a condition."""

    def __init__(self, study: Study, part: Part, steps: int | None) -> None:
        self._study, self._part, self._steps = study, part, steps

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Count."""
        self._study.stepped(self._part, loop.t)
        if self._steps is not None and loop.t >= self._steps:
            loop.stop_requested = True
            self._study.ended(self._part)

    def on_end(self, loop: Loop) -> None:
        """Nothing to do."""
