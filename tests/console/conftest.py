"""What the tests of the console share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from consoles import Running


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A console over a small supervision, with a page of two files."""
    static = tmp_path_factory.mktemp("static")
    (static / "index.html").write_text("<!doctype html><title>Tutelage</title>")
    (static / "assets").mkdir()
    (static / "assets" / "console-abc.js").write_text("// page")
    server = Running(tmp_path_factory.mktemp("run"), static=static)
    yield server
    server.close()
