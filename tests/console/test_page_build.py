"""The built page that the wheel carries: made from the sources beside it, small, and with nothing from elsewhere."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pytest

WEB = Path(__file__).parents[2] / "web"
STATIC = Path(__file__).parents[2] / "src" / "tutelage" / "console" / "static"
FILES = ("index.html", "package.json", "package-lock.json", "tsconfig.json", "vite.config.ts")


def test_the_page_is_built_from_these_sources() -> None:
    names = [*FILES]
    for folder in ("public", "src"):
        names += [path.relative_to(WEB).as_posix() for path in (WEB / folder).rglob("*") if path.is_file()]
    digest = hashlib.sha256()
    for name in sorted(names):
        content = (WEB / name).read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    stamp = json.loads((STATIC / "built-from.json").read_text())
    assert stamp["sources"] == digest.hexdigest(), "web/ has changed: run `npm ci && npm run build` in it"
    found = {path.relative_to(STATIC).as_posix() for path in STATIC.rglob("*") if path.is_file()} - {"built-from.json"}
    assert found == set(stamp["built"])
    for name, expected in stamp["built"].items():
        assert hashlib.sha256((STATIC / name).read_bytes()).hexdigest() == expected, f"{name} was changed by hand"


def test_the_page_fits_a_strict_policy_and_a_slow_link() -> None:
    html = (STATIC / "index.html").read_text()
    assert not re.search(r"<style|style=|<script(?![^>]*\bsrc=)|\son\w+=", html), "inline scripts and styles are refused"
    loaded = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert loaded
    for address in loaded:
        assert (STATIC / address.removeprefix("/")).is_file(), address
    assert sum(path.stat().st_size for path in STATIC.rglob("*") if path.is_file()) < 400_000


@pytest.mark.parametrize("pattern", [r"https?://(?!www\.w3\.org/)[\w.-]+", r"\beval\(", r"new Function\("])
def test_the_page_asks_nobody_else_and_evaluates_nothing(pattern: str) -> None:
    for path in [*STATIC.glob("assets/*"), STATIC / "index.html"]:
        assert not re.findall(pattern, path.read_text()), path.name
