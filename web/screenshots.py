"""Pictures of every page of the console, light and dark, on a desk and on a phone:

    python web/screenshots.py [--fleet sim:PegInsertion] [--robots 12] [--seconds 60] [--out web/shots]

Starts `tutelage serve` in a temporary folder, lets two programs work as operators for a while, so that there is something to
see, and takes over a robot itself. With --docs those of docs/console.md are renewed, too. Needs Chromium and playwright.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests" / "console")]
os.environ["PYTHONPATH"] = str(ROOT / "src")

from browsing import DESKTOP, PASSWORD, PHONE, Person, Served, chromium  # noqa: E402

from tutelage.console.scripted import ScriptedOperator, after  # noqa: E402
from tutelage.errors import TutelageError  # noqa: E402

UNTENDED = ".look-auto, .look-asking"
SIZES = {"desktop": DESKTOP, "phone": PHONE}


@contextlib.contextmanager
def helpers(origin: str, names: list[str]) -> Iterator[None]:
    """Operators that are programs, at work until the end."""
    stop = threading.Event()

    def work(name: str) -> None:
        while not stop.is_set():
            operator = ScriptedOperator(origin, name, PASSWORD, react=1.5, rule=after(60))
            with contextlib.suppress(TutelageError):
                asyncio.run(operator.run(until=stop.is_set))

    threads = [threading.Thread(target=work, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def shoot(browser: Any, origin: str, out: Path, size: str, scheme: str) -> None:
    """Every page, once."""

    def save(name: str) -> None:
        somebody.page.screenshot(path=out / f"{name}-{size}-{scheme}.png")

    somebody = Person(browser, origin, None, color_scheme=scheme, **SIZES[size])
    page = somebody.page
    page.wait_for_selector(".login")
    save("login")
    somebody.sign_in("ada")
    page.wait_for_timeout(5000)
    save("wall")
    if size == "phone":
        somebody.go("/queue")
        page.wait_for_timeout(800)
        save("queue")
        somebody.go("/more")
        page.wait_for_timeout(400)
        save("more")
    else:
        page.locator(".person summary").click()
        page.wait_for_timeout(300)
        save("menu")
        page.keyboard.press("Escape")
    for name in ("charts", "operators", "accounts"):
        somebody.go(f"/{name}")
        page.wait_for_timeout(1500)
        save(name)
    somebody.go("/audit")
    page.get_by_role("button", name="Verify the chain").click()
    page.wait_for_timeout(1500)
    save("audit")
    somebody.go("/replay")
    page.wait_for_selector(".page.replay")
    with contextlib.suppress(Exception):
        page.locator(".episodes a").nth(1).click(timeout=3000)
        page.wait_for_selector(".player img", timeout=10_000)
        page.get_by_label("Timestep", exact=True).press("PageUp")
        page.wait_for_timeout(1500)
    save("replay")
    somebody.go("/")
    page.wait_for_timeout(500)
    robot = page.evaluate(
        """() => [...document.querySelectorAll('.tile')].findIndex(t => t.matches('.look-auto, .look-asking'))"""
    )
    somebody.go(f"/robot/{max(0, robot)}")
    page.wait_for_timeout(1500)
    save("robot")
    for _ in range(6):  # a robot may be done before the picture is taken
        with contextlib.suppress(Exception):
            page.locator(".panel .button.primary").click(timeout=3000)
            page.wait_for_selector(".stage-mine", timeout=4000)
            page.locator(".view").focus()
            page.keyboard.down("ArrowRight")
            page.wait_for_selector(".view-live", timeout=3000)
            page.wait_for_selector(".offer", state="detached", timeout=2000)
            page.wait_for_timeout(400)
            driven = page.locator(".stage-mine .view-live").count()
            save("drive")
            page.keyboard.up("ArrowRight")
            page.get_by_role("button", name="Hard reset").click(timeout=2000)
            page.wait_for_timeout(400)
            save("reset")
            page.get_by_role("dialog").get_by_role("button", name="Cancel").click(timeout=2000)
            page.get_by_role("button", name="Give back").click(timeout=2000)
            if driven:
                break
        somebody.go("/")
        page.wait_for_timeout(1000)
        robot = page.evaluate(
            f"() => [...document.querySelectorAll('.tile')].findLastIndex((tile) => tile.matches('{UNTENDED}'))"
        )
        somebody.go(f"/robot/{max(0, robot)}")
        page.wait_for_timeout(1000)
    for line in somebody.complaints:
        print(f"{size} {scheme}: {line}", file=sys.stderr)
    somebody.close()


def for_docs(shots: Path) -> None:
    """The pictures of docs/console.md. Without the two lowest bits of a colour, which nobody sees, they are smaller."""
    from PIL import Image

    images = ROOT / "docs" / "images"

    def load(name: str) -> Image.Image:
        return Image.open(shots / f"{name}.png").convert("RGB")

    def save(picture: Image.Image, name: str) -> None:
        picture.point(lambda value: min(255, (value + 2) // 4 * 4)).save(images / f"console-{name}.png", optimize=True)

    save(load("wall-desktop-light"), "wall")
    save(load("drive-desktop-dark"), "drive")
    save(load("charts-desktop-light").crop((0, 0, 1440, 620)), "charts")
    phones = [load(f"{name}-phone-light") for name in ("queue", "wall", "drive")]
    height, gap = 760, 24
    phones = [
        phone.resize((round(phone.width * height / phone.height), height), Image.Resampling.LANCZOS) for phone in phones
    ]
    row = Image.new("RGB", (sum(phone.width + gap for phone in phones) - gap, height), (180, 186, 177))
    for k, phone in enumerate(phones):
        row.paste(phone, (k * (phone.width + gap), 0))
    save(row, "phone")
    for scheme in ("light", "dark"):
        sheet(shots, scheme).save(images / f"console-all-{scheme}.jpg", quality=82, optimize=True)


def sheet(shots: Path, scheme: str, columns: int = 3, width: int = 560) -> Any:
    """All pages of a colour scheme on one picture: those on a desk in a grid, those on a phone in rows below."""
    from PIL import Image

    gap, paper = 16, (180, 186, 177)
    grids = []
    for size, across in (("desktop", columns), ("phone", 3 * columns)):
        each = (columns * width + (columns - 1) * gap - (across - 1) * gap) // across
        pictures = [Image.open(path).convert("RGB") for path in sorted(shots.glob(f"*-{size}-{scheme}.png"))]
        small = [p.resize((each, round(p.height * each / p.width)), Image.Resampling.LANCZOS) for p in pictures]
        grids.append([small[k : k + across] for k in range(0, len(small), across)])
    rows = [row for grid in grids for row in grid]
    height = sum(max(p.height for p in row) + gap for row in rows) - gap
    whole = Image.new("RGB", (columns * width + (columns - 1) * gap, height), paper)
    y = 0
    for row in rows:
        x = 0
        for picture in row:
            whole.paste(picture, (x, y))
            x += picture.width + gap
        y += max(p.height for p in row) + gap
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fleet", default="sim:PegInsertion")
    parser.add_argument("--robots", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=60.0, help="of work before the first picture")
    parser.add_argument("--out", type=Path, default=ROOT / "web" / "shots")
    parser.add_argument("--docs", action="store_true", help="renew docs/images/console-*.png")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, chromium() as browser, contextlib.ExitStack() as stack:
        server = Served(
            Path(folder), "--fleet", arguments.fleet, "--robots", str(arguments.robots), "--humans", "4", seconds=900
        )
        stack.callback(server.close)
        stack.enter_context(helpers(server.origin, ["ana", "ben"]))
        time.sleep(arguments.seconds)
        for size in SIZES:
            for scheme in ("light", "dark"):
                shoot(browser, server.origin, arguments.out, size, scheme)
    if arguments.docs:
        for_docs(arguments.out)
    print(f"{len(list(arguments.out.glob('*.png')))} pictures in {arguments.out}")


if __name__ == "__main__":
    main()
