"""The rule for levels of disturbance, and the file that keeps the measurements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tutelage.envs.experts import Score
from tutelage.experiments import levels


@pytest.mark.parametrize(
    ("expert", "cloned", "suits"),
    [(0.97, 0.0, True), (0.91, 0.19, True), (0.90, 0.0, False), (0.97, 0.2, False), (0.5, 0.5, False)],
)
def test_a_level_suits_when_the_expert_can_and_the_clone_cannot(
    expert: float,
    cloned: float,
    suits: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(levels.experts, "load", lambda task: (None, {}))
    monkeypatch.setattr(
        levels.experts,
        "evaluate",
        lambda actor, task, level, n, seed, threads: Score(level, 4000.0, 1.0, expert, expert, n, seed),
    )
    monkeypatch.setattr(levels, "behaviour_cloning", lambda config, level: {"success": cloned, "survived": cloned})
    path = tmp_path / "levels.json"
    arguments = ["Walker2d", "--results", str(path)]
    levels.main([*arguments, "--levels", "mild", "moderate"])
    levels.main([*arguments, "--levels", "moderate"])  # measured again: replaced, not repeated
    levels.main([*arguments, "--offline-pairs", "100"])  # another amount of data: another row
    rows = json.loads(path.read_text())["Walker2d"]
    assert [(r["level"], r["offline_pairs"], r["chosen"]) for r in rows] == [
        ("mild", 5000, False), ("moderate", 5000, True), ("moderate", 100, False),
    ]  # fmt: skip
    levels.main([*arguments, "--observation", "images"])  # and so is what is observed
    assert [r.get("observation") for r in json.loads(path.read_text())["Walker2d"]] == [None, None, None, "images"]
    assert {r["suits"] for r in rows} == {suits}
    assert ("does not suit" in capsys.readouterr().out) is not suits
