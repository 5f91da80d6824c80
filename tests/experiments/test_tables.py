"""The page of results, its tables and its figures."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from study_results import RATE, write

from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments import tables
from tutelage.experiments.results import read
from tutelage.experiments.tables import PUBLISHED, TablesConfig, frozen_table, insert, levels, online_table, run


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


def test_a_missing_seed_is_pointed_out(tmp_path: Path) -> None:
    folder = write(tmp_path, "comparison", "Ant", RATE)
    assert "The seeds differ" not in tables.tables(folder)
    next((folder / "comparison" / "Ant").glob("random-s1.json")).unlink()
    assert "**The seeds differ between algorithms** (Behaviour cloning (C.): 0, 1, 2; Random: 0, 2;" in tables.tables(folder)


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
    path.write_text(json.dumps({"Ant": [easy, {**fits, "chosen": True}], "Walker2d": [fits]}))
    walker, ant, chosen = levels(path).splitlines()[2:5]
    assert walker == "| Walker2d | moderate | 5,000 | 94% | 3% | 100 | yes |"
    assert ant == "| Ant | none | 5,000 | 94% | 20% | 100 | no |"
    assert chosen.startswith("| Ant | **moderate** |")


@pytest.mark.parametrize("content", ["{", '{"Ant": [{"level": "mild"}]}', '{"Ant": {"level": "mild"}}'])
def test_damaged_levels_are_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "levels.json"
    path.write_text(content)
    with pytest.raises(RunFolderError, match=r"levels\.json is damaged"):
        levels(path)


def test_a_page_without_markers_is_refused() -> None:
    with pytest.raises(TutelageError, match="no markers"):
        insert("# Page\n", "tables", "text")
