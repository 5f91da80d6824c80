"""Without an extra: the core still imports, and what needs the extra says which one, in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT = """
import sys
for name in {missing!r}:
    sys.modules[name] = None
"""


def python(code: str, folder: Path, missing: list[str]) -> subprocess.CompletedProcess[str]:
    """Run code in an interpreter that lacks some packages."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT.format(missing=missing) + code],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_core_needs_no_extra(tmp_path: Path) -> None:
    extras = ["mujoco", "matplotlib", "pyarrow", "tensorboard", "envpool", "robosuite", "imageio"]
    code = (
        "import tutelage.fleet.loop, tutelage.learning.imitation, tutelage.policies.ensemble, tutelage.checks, tutelage.cli"
    )
    said = python(code, tmp_path, extras)
    assert said.returncode == 0, said.stderr


@pytest.mark.parametrize(
    ("missing", "verb", "extra"),
    [("mujoco", "['run', 'Walker2d']", "mujoco"), ("mujoco", "['train-expert', 'Ant']", "mujoco"),
     ("robosuite", "['run', 'NutAssemblyRound']", "robosuite"),
     ("torch.utils.tensorboard", "['run', 'Walker2d', '--tensorboard']", "tensorboard"),
     ("fastapi", "['serve']", "console"), ("uvicorn", "['serve']", "console"), ("cv2", "['serve']", "console"),
     ("argon2", "['accounts', 'add', 'ana']", "console")],
)  # fmt: skip
def test_what_needs_an_extra_names_it(missing: str, verb: str, extra: str, tmp_path: Path) -> None:
    said = python(f"from tutelage.cli import main; main({verb})", tmp_path, [missing])
    assert said.returncode == 2
    assert said.stderr.count("\n") == 1
    assert f"pip install 'tutelage[{extra}]'" in said.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["keys", "router", "proxy", "ping", "top", "serve", "accounts", "audit"])
def test_what_needs_no_learning_library_loads_none(verb: str, tmp_path: Path) -> None:
    code = f"""
import contextlib
from tutelage.cli import main
with contextlib.suppress(SystemExit):
    main(["{verb}", "--help"])
assert not {{"torch", "numpy", "gymnasium"}} & set(sys.modules)
"""
    said = python(code, tmp_path, [])
    assert said.returncode == 0, said.stderr
    assert f"usage: tutelage {verb}" in said.stdout
