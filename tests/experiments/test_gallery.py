"""The gallery: a small picture of each task, and the scores that are on the cards."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tutelage.envs.tasks import TASKS
from tutelage.experiments import gallery
from tutelage.experiments.gallery import GalleryConfig, picture_of, run

Image = pytest.importorskip("PIL.Image")
DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    (tmp_path / "gallery.md").write_text("above\n<!-- begin: gallery -->\n<!-- end: gallery -->\nbelow\n")
    return tmp_path


def test_the_page_is_what_the_cards_say_and_every_picture_is_small() -> None:
    assert run(GalleryConfig(docs=DOCS, check=True)) == []
    for name in TASKS:
        picture = Image.open(DOCS / "images" / picture_of(name))
        assert picture.size == (3 * 246, 2 * 186)
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 3
        assert (DOCS / "images" / picture_of(name)).stat().st_size < 60_000


def test_a_picture_is_drawn_and_the_page_rewritten(docs: Path) -> None:
    config = GalleryConfig(("Navigation",), docs)
    assert len(run(dataclasses.replace(config, check=True))) == 2
    assert run(config) == [docs / "gallery.md", docs / "images" / "gallery-Navigation.png"]
    assert run(dataclasses.replace(config, check=True)) == []
    page = (docs / "gallery.md").read_text()
    assert page.startswith("above\n<!-- begin: gallery -->\n\n### HalfCheetah\n\nA planar cheetah runs forward; violation:")
    assert page.endswith("<!-- end: gallery -->\nbelow\n")
    assert "### Navigation\n\nA point robot in a maze" in page
    assert "| at its level, wind=0.75 | 100 | 1.00 ± 0.00 | 100% | 100% |" in page


def test_a_stale_page_is_an_error_that_says_what_to_run(docs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"run: python -m tutelage\.experiments\.gallery"):
        gallery.main(["Navigation", "--docs", str(docs), "--check"])
    assert f"stale: {docs / 'gallery.md'}" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="gallery: unknown task Nowhere; known tasks: HalfCheetah"):
        gallery.main(["Nowhere"])
