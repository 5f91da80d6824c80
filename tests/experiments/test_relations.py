"""What the runs say about the dissertation's statements."""

from __future__ import annotations

import json
from pathlib import Path

from study_results import RATE, write

from tutelage.experiments.relations import ablation_relations, relations
from tutelage.experiments.results import read


def test_relations_hold_when_the_data_say_so(tmp_path: Path) -> None:
    found = relations(read(write(tmp_path, "comparison", "Humanoid", RATE), "comparison")["Humanoid"])
    assert [relation.verdict for relation in found] == ["HOLDS"] * 6
    assert "81.0 ± 0.8; best other: Random 61.0 ± 0.8" in found[0].numbers
    assert "0.00% of robot time idle after timestep 250" in found[4].numbers
    assert found[5].numbers == "81.0 of 90.0, 90%"


def test_relations_do_not_hold_when_the_data_say_so(tmp_path: Path) -> None:
    folder = write(tmp_path, "comparison", "Ant", RATE | {"C.U.R.": 60.0, "Random": 61.0})
    found = {relation.statement: relation for relation in relations(read(folder, "comparison")["Ant"])}
    assert found["C.U.R. has the most cumulative successes"].verdict == "DOES NOT HOLD"
    assert found["C.U.R. has the most cumulative successes"].numbers.endswith("the standard deviations overlap")
    assert not found["Frozen, C.U.R. approaches the expert (at least 80% of its successes)"].holds


def test_a_tie_is_no_lead(tmp_path: Path) -> None:
    folder = write(tmp_path, "ablations", "Ant", {"C.U.R.": 80.0, "U.": 80.0})
    assert [r.holds for r in ablation_relations(read(folder, "ablations")["Ant"])] == [False, False]


def test_robots_that_lie_until_the_end_are_idle(tmp_path: Path) -> None:
    folder = write(tmp_path, "comparison", "Ant", RATE)
    for path in (folder / "comparison" / "Ant").glob("uc-*.json"):
        content = json.loads(path.read_text())
        content["curves"]["idle_time"] = [10.0 * t for t in content["curves"]["t"]]  # half of the 20 robots
        path.write_text(json.dumps(content))
    idle = {r.statement.split()[0]: r for r in relations(read(folder, "comparison")["Ant"])}["U.C."]
    assert not idle.holds
    assert idle.numbers.startswith("50.00% of robot time idle")
