"""The gallery of the documentation: a picture of each built-in task, and what its algorithmic human scores.

python -m tutelage.experiments.gallery            # draw docs/images/gallery-TASK.png, rewrite docs/gallery.md
python -m tutelage.experiments.gallery --check    # exit 1 if the page does not say what the cards say
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from tyro.conf import Positional

from tutelage.envs import experts
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments.tables import insert
from tutelage.experiments.watch import WatchConfig, pillow, watch
from tutelage.store import write_atomic

COLOURS, MAXCOVERAGE = 96, 1
"""Of a picture, which keeps its file small, and Pillow's number of the method that chooses them."""
STRIDE = 100
"""Timesteps shown of a task that has no goal: a gait, not the landscape."""


@dataclass(frozen=True)
class GalleryConfig:
    """What to draw.

    Attributes:
        tasks: names of tasks; empty: all.
        docs: folder of the documentation.
        check: draw and write nothing; exit with 1 if the page is not what it would be, or lacks a picture.
    """

    tasks: Positional[tuple[str, ...]] = ()
    docs: Path = Path("docs")
    check: bool = False

    def __post_init__(self) -> None:
        unknown = set(self.tasks) - set(TASKS)
        if unknown:
            raise ConfigError(f"unknown task {', '.join(sorted(unknown))}; known tasks: {', '.join(TASKS)}")


def picture_of(task: str) -> str:
    """The file of a task's picture in docs/images/."""
    return f"gallery-{task}.png"


def draw(task: str, path: Path) -> None:
    """Six moments of an episode of the task's algorithmic human in calm, as a PNG of few colours.

    Raises:
        ConfigError: no algorithmic human is shipped for it.
        MissingExtraError: Pillow is not installed.
        TutelageError: no OpenGL.
    """
    steps = None if TASKS[task].goal else STRIDE
    watch(WatchConfig(task, out=path, steps=steps, width=240, height=180, disturbance="none"))
    image, buffer = pillow().open(path), io.BytesIO()
    # The method that keeps the colours of small things, such as a cube on a table.
    image.quantize(COLOURS, method=MAXCOVERAGE, dither=0).save(buffer, "png", optimize=True)
    write_atomic(path, buffer.getvalue())


def gallery() -> str:
    """What stands between the markers of docs/gallery.md."""
    return "\n".join(_entry(name) for name in TASKS)


def _entry(name: str) -> str:
    task = TASKS[name]
    lines = [f"### {name}\n", f"{task.summary[0].upper()}{task.summary[1:]}.\n", f"![{name}](images/{picture_of(name)})\n"]
    if not experts.path_of(name).exists():
        return "\n".join([*lines, "No algorithmic human is shipped.\n"])
    scores = experts.load(name)[1]["scores"]
    lines += [
        "| its human, level | episodes | return | without violation | success |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for level in dict.fromkeys(["none", task.disturbance]):
        s = scores[level]
        calm = "in calm" if level == "none" else f"at its level, {level}"
        spread = f"{s['mean']:,.2f} ± {s['sd']:,.2f}"
        lines.append(f"| {calm} | {s['episodes']} | {spread} | {s['survived']:.0%} | {s['success']:.0%} |")
    return "\n".join(lines) + "\n"


def run(config: GalleryConfig) -> list[Path]:
    """Draw the pictures and rewrite the page; returns the files that were, or with `check` should be, written."""
    page = config.docs / "gallery.md"
    text = page.read_text(encoding="utf-8")
    wanted = insert(text, "gallery", gallery())
    stale = [page] if wanted != text else []
    if stale and not config.check:
        write_atomic(page, wanted.encode())
    for task in config.tasks or TASKS:
        path = config.docs / "images" / picture_of(task)
        if not config.check:
            draw(task, path)
            stale.append(path)
        elif not path.exists():
            stale.append(path)
    return stale


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of `python -m tutelage.experiments.gallery`."""
    try:
        config = tyro.cli(GalleryConfig, args=args, description=__doc__)
        stale = run(config)
    except TutelageError as error:
        raise SystemExit(f"gallery: {error}") from None
    for path in stale:
        print(f"stale: {path}" if config.check else f"written: {path}")
    if config.check and stale:
        raise SystemExit("run: python -m tutelage.experiments.gallery")


if __name__ == "__main__":
    main()
