"""A served fleet and people at it: `tutelage serve` as users start it, and real browsers without a window."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tutelage.console.accounts import Accounts, Role

PASSWORD = "correct horse battery"
PEOPLE = {"ada": "admin", "ana": "operator", "ben": "operator", "vic": "viewer"}
PATIENCE = 120.0
"""Seconds that a machine that is busy with other things may take for anything."""
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
SWITCHES = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--autoplay-policy=no-user-gesture-required",
)  # fmt: skip
PHONE: dict[str, Any] = {
    "viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "has_touch": True, "is_mobile": True,
}  # fmt: skip
DESKTOP: dict[str, Any] = {"viewport": {"width": 1440, "height": 900}}


def missing(what: str) -> None:
    """Skip the test, but in CI that is a failure."""
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """The browser of this machine, without a window."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("there is no playwright (pip install playwright)")
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    if path is None:
        missing("there is no Chromium (apt-get install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(SWITCHES), headless=True)
        try:
            yield browser
        finally:
            browser.close()


class Served:
    """`tutelage serve` in a process of its own.

    Args:
        folder: its --out.
        options: further options of the command.
        seconds: that it may take to begin.
    """

    def __init__(self, folder: Path, *options: str, seconds: float = 120.0) -> None:
        self.folder, self.options, self.seconds = folder, options, seconds
        accounts = Accounts(folder)
        for name, role in PEOPLE.items():
            accounts.add(name, Role.of(role), PASSWORD)
        accounts.close()
        self.port = 0
        self.start()

    def start(self) -> None:
        """Start it, on the port that it had before."""
        command = [*self.command(), "serve", "--out", str(self.folder), "--port", str(self.port), *self.options]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=self.environment()
        )
        self.lines: list[str] = []
        told: queue.Queue[str | None] = queue.Queue()

        def read() -> None:
            for line in self.process.stdout or ():
                self.lines.append(line.rstrip())
                told.put(line)
            told.put(None)

        threading.Thread(target=read, daemon=True).start()
        deadline = time.monotonic() + self.seconds
        while True:
            line = told.get(timeout=max(0.1, deadline - time.monotonic()))
            assert line is not None, "\n".join(self.lines)
            if found := re.search(r"http://127\.0\.0\.1:(\d+)", line):
                self.port = int(found[1])
                break
        self.origin = f"http://127.0.0.1:{self.port}"
        until(self._answers, "the server answers")

    def _answers(self) -> bool:
        try:
            return httpx.get(f"{self.origin}/healthz", timeout=2).status_code == 200
        except httpx.HTTPError:
            return False

    def kill(self) -> None:
        """As kill -9 does."""
        self.process.kill()
        self.process.wait(10)

    def close(self) -> None:
        """As Ctrl-C does."""
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.kill()

    @contextlib.contextmanager
    def client(self, name: str) -> Iterator[httpx.Client]:
        """Somebody without a browser, logged in."""
        with httpx.Client(base_url=self.origin, headers={"origin": self.origin, "x-tutelage": "1"}, timeout=20) as client:
            assert client.post("/api/login", json={"name": name, "password": PASSWORD}).status_code == 200
            yield client

    @staticmethod
    def command() -> list[str]:
        return [sys.executable, "-c", "from tutelage.cli import main; main()"]

    @staticmethod
    def environment() -> dict[str, str]:
        path = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])  # `lasting`
        return os.environ | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "PYTHONPATH": path}


def until(holds: Callable[[], object], what: str, seconds: float = PATIENCE) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, f"not within {seconds:g} s: {what}"
        time.sleep(0.05)


WATCH = """
window.__violations = [];
document.addEventListener("securitypolicyviolation", (e) => window.__violations.push(e.violatedDirective + " " + e.blockedURI));
"""


class Person:
    """Somebody at a browser. Whatever their browser complains about is in `complaints`.

    Args:
        browser: the browser.
        origin: the server.
        name: whom to sign in as; None: nobody.
        options: of the browser's window.
    """

    def __init__(self, browser: Any, origin: str, name: str | None, **options: Any) -> None:
        self.origin, self.name = origin, name
        self.complaints: list[str] = []
        self.context = browser.new_context(**(DESKTOP | options))
        self.context.add_init_script(WATCH)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1000 * PATIENCE)
        self.said: deque[str] = deque(maxlen=40)
        self.page.on("websocket", self._listen)
        self.page.on("console", lambda m: m.type in ("error", "warning") and self.complaints.append(f"{m.type}: {m.text}"))
        self.page.on("pageerror", lambda error: self.complaints.append(f"exception: {error}"))
        self.page.goto(origin)
        if name is not None:
            self.sign_in(name)

    def _listen(self, socket: Any) -> None:
        """Keep what was said lately, for the report of a test that fails."""
        began = time.monotonic()
        often = re.compile(r'"type": ?"(state|ping|pong|got|watch|renew|command|link|metrics|hello)"')

        def keep(way: str, message: object) -> None:
            if isinstance(message, str) and not often.search(message):
                self.said.append(f"{time.monotonic() - began:7.2f} {way} {message[:160]}")

        socket.on("framesent", lambda message: keep("->", message))
        socket.on("framereceived", lambda message: keep("<-", message))

    def sign_in(self, name: str, password: str = PASSWORD) -> None:
        self.page.get_by_label("Name").fill(name)
        self.page.get_by_label("Password").fill(password)
        self.page.get_by_role("button", name="Sign in").click()
        self.page.wait_for_selector(".tile, .study")

    def go(self, path: str) -> None:
        """To another page of the console."""
        self.page.evaluate("path => { location.hash = path }", path)

    def see(self, selector: str, text: str | re.Pattern[str] | None = None, seconds: float = PATIENCE) -> Any:
        """What is on the page; waits for it."""
        found = self.page.locator(selector)
        if text is not None:
            found = found.filter(has_text=text)
        found.first.wait_for(timeout=1000 * seconds)
        return found.first

    def see_picture(self) -> Any:
        """The large picture of a robot; waits for it. Before, the frame is of another shape."""
        until(lambda: self.page.evaluate("document.querySelector('.view canvas')?.width ?? 0") > 100, "a picture")
        return self.page.locator(".view canvas")

    def number(self, selector: str) -> int:
        return int(self.page.locator(selector).first.inner_text().replace("\u2009", ""))

    def check(self) -> None:
        """Nothing was wrong in the browser."""
        assert self.page.evaluate("window.__violations") == []
        assert self.complaints == []

    def close(self) -> None:
        self.context.close()


@contextlib.contextmanager
def person(browser: Any, origin: str, name: str | None, **options: Any) -> Iterator[Person]:
    """Somebody, for a while; at the end their browser must not have complained."""
    somebody = Person(browser, origin, name, **options)
    try:
        yield somebody
        somebody.check()
    except BaseException:
        print(f"{name}: {somebody.page.url}", *somebody.said, somebody.page.locator("body").inner_text(), sep="\n")
        raise
    finally:
        somebody.close()
