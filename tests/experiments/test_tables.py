from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments import tables
from tutelage.experiments.tables import (
    PUBLISHED,
    TablesConfig,
    ablation_relations,
    frozen_table,
    insert,
    levels,
    online_table,
    read,
    relations,
    run,
)  # fmt: skip

STEPS, RATE = 1000, {"C. (BC)": 10.0, "Random": 60.0, "U.C.": 55.0, "C.U.R.": 80.0}
"""Timesteps, and tasks completed by each algorithm (about)."""


def result(algorithm: str, seed: int, successes: float, hard_resets: float, evaluated: bool = True) -> dict[str, Any]:
    """A result file as the study writes it."""
    t = np.linspace(20, STEPS, 50)
    done, fell = successes + seed, hard_resets + seed
    idle = 5 * fell * np.minimum(t / 250, 1)  # nobody is idle after timestep 250
    curves = {
        "t": t, "successes": done * t / STEPS, "hard_resets": fell * np.minimum(t / 250, 1), "idle_time": idle,
        "human_time": 2.0 * t, "rohe": done * t / STEPS * 0.1 / (1 + 0.02 * t),
    }  # fmt: skip
    metrics = {
        "successes": done, "hard_resets": fell, "idle_time": 5 * fell, "human_time": 2000.0, "rohe": done * 0.1 / 21,
    }  # fmt: skip
    frozen = {"evaluation": {**metrics, "steps": STEPS}} if evaluated else {}
    expert = {"expert": {**metrics, "successes": 90.0, "steps": STEPS}} if algorithm == "C.U.R." and evaluated else {}
    config = {
        "robots": 20, "humans": 2, "steps": STEPS, "t_teleop": 5, "t_reset": 5, "disturbance": "moderate",
        "offline_pairs": 5000, "thresholds": {"initial": 250, "uncertainty": 0.01 + 0.001 * seed, "risk": 0.4},
    }  # fmt: skip
    curves = {name: list(map(float, values)) for name, values in curves.items()}
    return {"algorithm": algorithm, "seed": seed, "metrics": metrics, **frozen, **expert, "curves": curves, "config": config}


def write(folder: Path, kind: str, task: str, rates: dict[str, float], seeds: int = 3, evaluated: bool = True) -> Path:
    """Result files of a study."""
    for algorithm, rate in rates.items():
        for seed in range(seeds):
            path = folder / kind / task / f"{algorithm.lower().replace('.', '').replace(' ', '')}-s{seed}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(result(algorithm, seed, rate, 1000 / rate, evaluated)))
    return folder


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results of a study in which everything is as in the dissertation."""
    folder = write(tmp_path / "results" / "fleet", "comparison", "Humanoid", RATE)
    return write(folder, "ablations", "Humanoid", {"C.U.R.": 80.0, "C.U.R.(-i)": 70.0, "U.": 30.0})


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    """Pages with markers."""
    folder = tmp_path / "docs"
    folder.mkdir()
    for page, name in (("results.md", "tables"), ("tasks.md", "levels")):
        (folder / page).write_text(f"# Page\n\n<!-- begin: {name} -->\nstale text\n<!-- end: {name} -->\n\nbelow\n")
    return folder


def test_a_row_is_mean_and_standard_deviation_over_the_seeds_and_the_best_is_bold(results: Path) -> None:
    table = online_table(read(results, "comparison")["Humanoid"])
    assert "| Random | 3 | 61.0 ± 0.8 |" in table
    assert "| C.U.R. | 3 | **81.0 ± 0.8** |" in table


def test_rows_are_in_the_order_of_the_dissertations_table(results: Path) -> None:
    assert list(read(results, "comparison")["Humanoid"]) == list(RATE)


def test_one_seed_has_no_deviation(tmp_path: Path) -> None:
    groups = read(write(tmp_path, "comparison", "Ant", {"C.U.R.": 80.0}, seeds=1), "comparison")["Ant"]
    assert "| C.U.R. | 1 | 80.0 |" in online_table(groups)


def test_the_frozen_table_has_the_expert_and_the_published_numbers(results: Path) -> None:
    table = frozen_table(read(results, "comparison")["Humanoid"], "Humanoid")
    assert "| Expert | 3 | 90.0 ± 0.0 |" in table
    assert "771.0 ± 25.5 | 289.3 ± 21.1 | 1,446.7 ± 105.3 |" in table
    assert "published" not in frozen_table(read(results, "comparison")["Humanoid"], "Walker2d")


def test_the_published_numbers_are_those_of_table_c2() -> None:
    assert PUBLISHED["Humanoid"]["U.C."] == ("617.7 ± 66.3", "570.3 ± 139.0", "2,851.7 ± 694.8")
    assert PUBLISHED["Humanoid"]["Expert"] == ("894", "115", "575")


def test_there_is_no_frozen_table_without_evaluations(tmp_path: Path) -> None:
    groups = read(write(tmp_path, "comparison", "Ant", RATE, evaluated=False), "comparison")["Ant"]
    assert frozen_table(groups, "Ant") == ""


def test_relations_hold_when_the_data_say_so(results: Path) -> None:
    found = relations(read(results, "comparison")["Humanoid"])
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


def test_a_missing_seed_is_pointed_out(tmp_path: Path) -> None:
    folder = write(tmp_path, "comparison", "Ant", RATE)
    assert "The seeds differ" not in tables.tables(folder)
    next((folder / "comparison" / "Ant").glob("random-s1.json")).unlink()
    assert "**The seeds differ between algorithms** (Behaviour cloning (C.): 0, 1, 2; Random: 0, 2;" in tables.tables(folder)


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


def test_the_page_is_rewritten_between_its_markers_and_then_is_not_stale(results: Path, docs: Path) -> None:
    run(TablesConfig(results, docs))
    page = (docs / "results.md").read_text()
    assert page.startswith("# Page\n\n<!-- begin: tables -->\n\n### Does it reproduce?")
    assert page.endswith("<!-- end: tables -->\n\nbelow\n")
    assert "stale text" not in page
    assert all((docs / link).exists() for link in re.findall(r"\]\((images/.*?)\)", page))
    assert run(TablesConfig(results, docs, check=True)) == []


def test_check_finds_a_stale_page_and_leaves_it(results: Path, docs: Path) -> None:
    before = (docs / "results.md").read_text()
    assert docs / "results.md" in run(TablesConfig(results, docs, check=True))
    assert (docs / "results.md").read_text() == before
    with pytest.raises(SystemExit, match="run: python -m tutelage"):
        tables.main([str(results), "--docs", str(docs), "--check"])


def test_without_results_the_page_says_so(tmp_path: Path, docs: Path) -> None:
    run(TablesConfig(tmp_path / "none", docs))
    assert "No results are in" in (docs / "results.md").read_text()


def test_levels_are_held_against_the_rule(tmp_path: Path) -> None:
    path = tmp_path / "levels.json"
    fits = {"level": "moderate", "expert_success": 0.94, "bc_success": 0.03, "episodes": 100, "offline_pairs": 5000}
    easy = {**fits, "level": "none", "bc_success": 0.2}
    path.write_text(json.dumps({"Ant": [easy, {**fits, "chosen": True}], "Walker2d": fits}))
    walker, ant, chosen = levels(path).splitlines()[2:5]
    assert walker == "| Walker2d | moderate | 5,000 | 94% | 3% | 100 | yes |"
    assert ant == "| Ant | none | 5,000 | 94% | 20% | 100 | no |"
    assert chosen.startswith("| Ant | **moderate** |")


@pytest.mark.parametrize("content", ["{", "[]", '{"seed": 1}'])
def test_a_damaged_file_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "comparison" / "Ant" / "cur-s0.json"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    with pytest.raises(RunFolderError, match=r"cur-s0\.json is"):
        read(tmp_path, "comparison")


def test_a_page_without_markers_is_refused() -> None:
    with pytest.raises(TutelageError, match="no markers"):
        insert("# Page\n", "tables", "text")
