"""A participant's session of the user study, in a real browser: cards, robots that call, panes, questions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import Person, chromium, person
from consoles import Running
from test_study_session import config

from tutelage.console.audit import Audit
from tutelage.console.study import Study
from tutelage.experiments.user_study.protocol import CONDITIONS

pytestmark = pytest.mark.filterwarnings("ignore:at beta_H:UserWarning")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    def open_study(audit: Audit) -> Any:
        return Study(config(tmp_path, hz=20.0, steps=60), audit)

    server = Running(tmp_path, open_study)
    yield server
    server.close()


def play(somebody: Person, turns: int) -> None:
    """Turn cards over, the first ones that lie face down."""
    for _ in range(turns):
        for nth in (0, 1):
            somebody.page.wait_for_function("() => !document.querySelector('.card[aria-disabled=true]:not(.card-up)')")
            somebody.page.locator(".card:not(.card-up)").nth(nth).click()
            somebody.page.wait_for_timeout(150)


def help_robot(somebody: Person) -> None:
    """Set it up where it has fallen, and let the expert act until it goes on by itself."""
    page = somebody.page
    somebody.see(".stage-mine")
    if page.locator(".driving", has_text="hard reset").count():
        page.keyboard.press("h")
        page.get_by_role("dialog").get_by_role("button", name="Reset").click()
    else:
        page.keyboard.down("Space")
        page.wait_for_timeout(1500)
        page.keyboard.up("Space")


def test_a_participant_goes_through_the_whole_study(running: Running) -> None:
    with chromium() as browser, person(browser, running.origin, "ana") as ana:
        page = ana.page
        ana.see("h1", "Welcome")
        page.get_by_role("button", name="Begin").click()

        ana.see("h1", "the cards")
        assert page.locator(".card").count() == 12
        play(ana, 2)
        page.get_by_role("button", name="Go on").click()

        ana.see("h1", "robots that call you")
        page.get_by_role("button", name="Try it").click()
        ana.see(".study-call", "A robot needs help")
        assert int(page.locator("html").get_attribute("data-chimes") or 0) >= 1
        page.keyboard.press("2")
        help_robot(ana)
        page.keyboard.press("1")
        page.get_by_role("button", name="I know how it works").click()

        ana.see("h1", "robots that you watch")
        page.get_by_role("button", name="Try it").click()
        page.locator(".pane").nth(1).click()
        help_robot(ana)
        page.get_by_role("button", name="I know how it works").click()

        seen = ""
        for label in "ABCD":
            ana.see("h1", f"Part {label}")
            seen += page.locator("body").inner_text()
            page.get_by_role("button", name="Begin").click()
            ana.see("h1", f"Part {label} is over", seconds=120)
            seen += page.locator("body").inner_text()
            page.get_by_role("button", name="Go on").click()
        assert not [name for name in CONDITIONS if name in seen]

        ana.see("h1", "Questions")
        send = page.get_by_role("button", name="Send")
        assert send.is_disabled()
        for group in page.locator(".scale").all():
            group.locator("input").nth(3).check(force=True)
        send.click()
        ana.see("h1", "Thank you")
    results = [json.loads(path.read_text()) for path in (running.folder / "results").glob("*.json")]
    assert [result["answers"] for result in results] == [{"mental_demand": 4, "frustration": 4}] * 4
