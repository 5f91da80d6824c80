"""Reading the result files of a study."""

from __future__ import annotations

from pathlib import Path

import pytest
from study_results import RATE, write

from tutelage.errors import RunFolderError
from tutelage.experiments.results import in_order, read


def test_rows_are_in_the_order_of_the_dissertations_table(tmp_path: Path) -> None:
    backwards = dict(reversed(RATE.items()))
    assert list(read(write(tmp_path, "comparison", "Humanoid", backwards), "comparison")["Humanoid"]) == list(RATE)


@pytest.mark.parametrize("content", ["{", "[]", '{"seed": 1}'])
def test_a_damaged_file_is_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "comparison" / "Ant" / "cur-s0.json"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    with pytest.raises(RunFolderError, match=r"cur-s0\.json is"):
        read(tmp_path, "comparison")


def test_what_is_not_known_comes_last() -> None:
    assert in_order({"b", "a", "Ant", "Walker2d"}, ("Walker2d", "Ant")) == ["Walker2d", "Ant", "a", "b"]
