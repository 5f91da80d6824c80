"""A participant's session of the user study, on the running server: the parts in their order, the game, the survey, the table."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from consoles import PASSWORD, Running

from tutelage.console.audit import Audit
from tutelage.console.scripted import ScriptedOperator, after
from tutelage.console.study import Study
from tutelage.console.study_parts import LABELS, OutOfOrderError, StudyConfig
from tutelage.console.study_table import study_table
from tutelage.errors import ConfigError
from tutelage.experiments.jobs import slug
from tutelage.experiments.user_study.protocol import CONDITIONS, HUMAN_GATED, QUESTIONS, order
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig

pytestmark = pytest.mark.filterwarnings("ignore:at beta_H:UserWarning")

SMALL = {
    "offline_pairs": 300, "calibration_steps": 60, "hidden": (16,), "members": 2,
    "learner": LearnerConfig(schedule="never", pretrain=30), "critic": CriticConfig(pretrain=20, hidden=(16,), batch=32),
}  # fmt: skip


def config(out: Path, **changes: Any) -> StudyConfig:
    """A session of a few seconds."""
    settings: dict[str, Any] = {"participant": 4, "out": out, "hz": 50.0, "steps": 25, "assist": True, "settings": SMALL}
    return StudyConfig(**settings | changes)


class Session:
    """A participant at the page of a study: clicks, and a scripted hand for the robots."""

    def __init__(self, out: Path, **changes: Any) -> None:
        self.study: Study | None = None

        def open_study(audit: Audit) -> Any:
            self.study = Study(config(out, **changes), audit)
            return self.study

        self.running = Running(out, open_study)
        self.client = self.running.client("ana")
        self.hand: threading.Thread | None = None
        self.stop = threading.Event()

    def state(self) -> dict[str, Any]:
        return dict(self.client.get("/api/study").json())

    def next(self) -> dict[str, Any]:
        answer = self.client.post("/api/study/next", json={})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def help_robots(self) -> None:
        """From now on somebody accepts what is offered."""

        def work() -> None:
            while not self.stop.is_set():
                operator = ScriptedOperator(self.running.origin, "ana", PASSWORD, react=0.0, rule=after(8), rate=50)
                with contextlib.suppress(ConfigError):  # the next part begins
                    asyncio.run(operator.run(until=self.stop.is_set))

        self.hand = threading.Thread(target=work)
        self.hand.start()

    def wait_over(self) -> dict[str, Any]:
        deadline = time.monotonic() + 90
        while (state := self.state())["state"] != "over":
            assert time.monotonic() < deadline, state
            time.sleep(0.05)
        return state

    def close(self) -> None:
        self.stop.set()
        if self.hand:
            self.hand.join()
        self.client.close()
        self.running.close()


@pytest.fixture
def sessions() -> Iterator[list[Session]]:
    made: list[Session] = []
    yield made
    for session in made:
        session.close()


def test_a_session_from_the_welcome_to_the_table(tmp_path: Path, sessions: list[Session]) -> None:
    sessions.append(session := Session(tmp_path))
    assert session.state()["stage"] == "welcome"
    state = session.next()
    assert (state["stage"], state["interface"], state["board"]["cards"]) == ("practice_game", "game", 12)
    first = session.client.post("/api/study/turn", json={"card": 0}).json()
    assert first["pair"] is None
    assert first["board"]["face_up"] == {"0": first["picture"]}
    assert session.client.post("/api/study/turn", json={"card": 0}).status_code == 409
    assert session.client.post("/api/study/answers", json={"answers": {}}).status_code == 409

    session.help_robots()
    for stage, interface in (("practice_requests", "game"), ("practice_monitoring", "panes")):
        state = session.next()
        assert (state["stage"], state["interface"], state["state"]) == (stage, interface, "ready")
        assert session.next()["state"] == "running"
        time.sleep(0.5)
        assert session.state()["t"] > 0
    for k, algorithm in enumerate(order(4)):
        state = session.next()
        assert (state["stage"], state["label"], state["index"], state["state"]) == ("condition", LABELS[k], k, "ready")
        assert state["interface"] == ("panes" if algorithm == HUMAN_GATED else "game")
        assert not [name for name in CONDITIONS if name in json.dumps(state)]
        assert session.next()["state"] == "running"
        early = session.client.post("/api/study/next", json={})
        assert early.status_code == 409 or early.json()["state"] != "running"
        state = session.wait_over()
        assert state["t"] == 25
        counts = json.loads((tmp_path / "results" / f"{slug(algorithm)}-s4.json").read_text())["counts"]
        assert counts["robot_actions"] + counts["human_actions"] <= 75
        assert (counts["pairs"] is None) == (algorithm == HUMAN_GATED)
    assert session.next()["stage"] == "survey"
    assert session.study
    with pytest.raises(OutOfOrderError, match="answer the questions"):
        session.study.next("ana")
    answers = {label: dict.fromkeys(QUESTIONS, k + 1) for k, label in enumerate(LABELS)}
    for wrong in ({}, {"A": answers["A"]}, answers | {"A": dict.fromkeys(QUESTIONS, 6)}, answers | {"A": {"mood": 3}}):
        assert session.client.post("/api/study/answers", json={"answers": wrong}).status_code == 400
    assert session.client.post("/api/study/answers", json={"answers": answers}).json()["stage"] == "done"

    table = study_table(tmp_path)
    assert "1 participants" in table
    for algorithm in CONDITIONS:
        mark = order(4).index(algorithm) + 1
        assert f"| {algorithm} | {mark}.0 ± 0.0" in table
    assert {row.kind for row in session.running.audit.rows(kind="study")} == {"study"}
    with pytest.raises(ConfigError, match="is done"):
        Study(config(tmp_path), session.running.audit)


def test_a_condition_that_was_interrupted_begins_anew_and_finished_ones_stay(
    tmp_path: Path, sessions: list[Session]
) -> None:
    sessions.append(session := Session(tmp_path, practice=False, steps=10, hz=5.0))
    session.help_robots()
    session.next()
    session.next()
    session.wait_over()
    session.next()
    session.next()  # the second condition runs
    session.close()
    sessions.clear()
    first = tmp_path / "results" / f"{slug(order(4)[0])}-s4.json"
    kept = first.read_text()
    sessions.append(again := Session(tmp_path, practice=False, steps=10, hz=5.0))
    state = again.next()
    assert (state["label"], state["state"], state["t"]) == ("B", "ready", 0)
    assert first.read_text() == kept


def test_the_study_is_for_operators(tmp_path: Path, sessions: list[Session]) -> None:
    sessions.append(session := Session(tmp_path, practice=False, steps=10, hz=5.0))
    assert httpx.get(f"{session.running.origin}/api/study").status_code == 401
    with contextlib.closing(session.running.client("viewer")) as viewer:
        assert viewer.get("/api/study").status_code == 403
        for name, body in (("next", {}), ("turn", {"card": 0}), ("answers", {"answers": {}})):
            assert viewer.post(f"/api/study/{name}", json=body).status_code == 403
            assert httpx.post(f"{session.running.origin}/api/study/{name}", json=body).status_code == 403
    with session.running.socket("ana") as ana:
        assert ana.hear("hello")["study"]["stage"] == "welcome"
        session.next()
        assert ana.hear("study")["stage"] == "condition"


def test_there_is_no_table_before_somebody_is_done(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no participant"):
        study_table(tmp_path)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.json").write_text("{")
    with pytest.raises(ConfigError, match="damaged"):
        study_table(tmp_path)
