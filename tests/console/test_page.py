"""The console in a real browser, at a fleet that `tutelage serve` runs: what operators do all day, and what may go wrong."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from browsing import PHONE, Person, Served, chromium, person, until

ROBOTS = 4


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def served(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Four robots that know nothing yet, in a maze in which no episode ends under the hand of a test."""
    options = ("--fleet", "sim:lasting:Lasting", "--robots", str(ROBOTS), "--humans", "3", "--policy", "none")
    server = Served(tmp_path_factory.mktemp("page"), *options)
    yield server
    server.close()


@pytest.fixture(autouse=True)
def fresh(served: Served) -> None:
    """Each test begins with nothing stopped and nobody at a robot."""
    with served.client("ada") as ada:
        ada.post("/api/estop/clear", json={"robot": None})


def take(somebody: Person, robot: int) -> None:
    """Take a robot over, whether it asks or not."""
    somebody.go(f"/robot/{robot}")
    page = somebody.page
    page.get_by_role("button", name=re.compile("^(Take over|Accept)")).last.click()
    somebody.see(".stage-mine")


def accept(somebody: Person) -> None:
    """Accept the first offer; one that runs out while the machine is busy comes again."""
    from playwright.sync_api import Error

    offer, mine = somebody.page.locator(".offer").first, somebody.page.locator(".stage-mine")

    def click() -> int:
        if not mine.count() and offer.count():
            with contextlib.suppress(Error):  # it went while it was aimed at
                offer.get_by_role("button", name="Accept").click(timeout=5000)
                mine.wait_for(timeout=5000)
        return int(mine.count())

    until(click, "an offer is accepted")


def drive(somebody: Person, key: str = "ArrowRight", seconds: float = 1.0) -> None:
    somebody.page.keyboard.down(key)
    somebody.see(".view-live")
    somebody.see(".kbd-on, .stick-on")
    time.sleep(seconds)
    somebody.page.keyboard.up(key)


def test_an_operator_helps_and_the_policy_learns_from_it(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        offer = ana.see(".offer")
        assert re.search("(?i)uncertain|violated", offer.inner_text())
        assert int(ana.page.locator("html").get_attribute("data-chimes")) >= 1
        assert "request" in ana.page.title()
        accept(ana)
        before = ana.number("[data-testid=policy-version]")
        drive(ana, seconds=0.6)
        ana.see(".driving", "It holds")
        ana.see(".hud", re.compile(r"Pictures\s*[1-9]"))
        ana.see(".hud", re.compile(r"Command p99\s*[\d.]+ ms"))
        ana.page.get_by_role("button", name="Give back").click()
        ana.see(".note", "You gave it back")
        ana.page.wait_for_selector(".stage-mine", state="detached")
        until(lambda: ana.number("[data-testid=policy-version]") > before, "the policy's version rises")
    with served.client("ana") as http:
        row = next(row for row in http.get("/api/operators").json()["rows"] if row["operator"] == "ana")
        assert row["interventions"] >= 1
        assert row["commands"] >= 3


def test_a_reset_is_asked_for_twice(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        take(ana, 1)
        ana.page.get_by_role("button", name="Hard reset").click()
        dialog = ana.page.get_by_role("dialog")
        dialog.get_by_role("button", name="Cancel").click()
        dialog.wait_for(state="detached")
        ana.see(".stage-mine")
        ana.page.get_by_role("button", name="Hard reset").click()
        dialog.get_by_role("button", name="Reset").click()
        ana.see(".note", "reset is done")


def test_only_one_of_two_gets_a_robot_and_hands_it_over(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana, person(browser, served.origin, "ben") as ben:
        for somebody in (ana, ben):
            somebody.go("/robot/2")
            somebody.page.get_by_role("button", name="Take over").or_(
                somebody.page.get_by_role("button", name="Accept")
            ).last.wait_for()
        click = "[...document.querySelectorAll('.panel .button.primary')].forEach(b => b.click())"
        ana.page.evaluate(f"setTimeout(() => {{ {click} }}, 300)")
        ben.page.evaluate(f"setTimeout(() => {{ {click} }}, 300)")
        until(lambda: any(p.page.locator(".stage-mine").count() for p in (ana, ben)), "one has it")
        time.sleep(0.5)
        has = [p for p in (ana, ben) if p.page.locator(".stage-mine").count()]
        assert len(has) == 1
        first = has[0]
        second = ben if first is ana else ana
        second.see(".panel", f"{first.name} has this robot")
        first.page.locator(".hand-over summary").click()
        first.page.locator(".hand-over .popover").get_by_role("button", name=str(second.name)).click()
        first.see(".note", "Offered to")
        second.see(".offer", "robot 3").get_by_role("button", name="Accept").click()
        second.see(".stage-mine")
        first.page.wait_for_selector(".stage-mine", state="detached")
        first.see(".note", "handed over")
        second.page.keyboard.press("g")
        second.page.wait_for_selector(".stage-mine", state="detached")


HEADINGS = """() => {
  window.__headings = [];
  const note = () => window.__headings.push(document.querySelector(".stage-head")?.textContent ?? "");
  new MutationObserver(note).observe(document.body, { subtree: true, childList: true, characterData: true });
}"""


def test_a_closed_tab_leaves_a_robot_that_holds_and_asks_again(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ben") as ben:
        ben.page.get_by_role("switch").click()  # on a break: nothing is offered to ben
        ana = Person(browser, served.origin, "ana")
        take(ana, 3)
        ben.go("/robot/3")
        ana.page.keyboard.down("ArrowUp")
        ana.see(".view-live")
        ben.see(".stage-head", "Driven by ana")
        time.sleep(1.0)
        ben.page.evaluate(HEADINGS)  # what passes within seconds is noted by the page, not looked for from here
        ana.close()
        until(lambda: ben.page.evaluate("window.__headings.some(text => text.includes('Holding'))"), "the robot holds")
        ben.page.wait_for_function("() => !document.querySelector('.panel')?.textContent.includes('ana has this robot')")
        ben.see(".waiting-row", "robot 4")
        ben.page.get_by_role("switch").click()
    with served.client("ben") as http:
        until(
            lambda: any(row["robot"] == 3 and row["operator"] == "ana" for row in http.get("/api/episodes").json()["rows"]),
            "what ana did can be seen again",
        )


def test_escape_stops_one_robot_then_all_and_going_on_is_confirmed(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        take(ana, 0)
        ana.page.keyboard.press("Escape")
        ana.see(".stage-head", "Stopped")
        ana.page.wait_for_selector(".stage-mine", state="detached")
        time.sleep(1.0)
        assert ana.page.locator(".banner-stop").count() == 0

        def twice() -> int:
            ana.page.keyboard.press("Escape")
            ana.page.keyboard.press("Escape")
            return int(ana.page.locator(".banner-stop").count())

        until(twice, "Esc twice stops all")  # again where the machine was too busy for two presses within 0.8 s
        ana.see(".banner-stop", "All robots are stopped")
        ana.page.locator(".clear-stop").click()
        ana.page.get_by_role("dialog").wait_for()
        assert ana.page.evaluate("document.activeElement.textContent") == "Cancel"
        ana.page.get_by_role("dialog").get_by_role("button", name="Clear the stop").click()
        ana.page.wait_for_selector(".banner-stop", state="detached")
        ana.page.get_by_role("button", name="Emergency stop: all robots").click()
        ana.see(".banner-stop")


def test_keys_alone_do_everything(browser: Any, served: Served) -> None:
    with person(browser, served.origin, None) as ana:
        keys = ana.page.keyboard
        ana.page.wait_for_function("() => document.activeElement?.name === 'username'")
        keys.type("ana")
        keys.press("Tab")
        keys.type("correct horse battery")
        keys.press("Enter")
        ana.page.wait_for_selector(".tile")
        keys.press("Tab")
        assert ana.page.evaluate("document.activeElement.textContent").startswith("Skip")
        outline = (
            "getComputedStyle(document.activeElement).outlineStyle + getComputedStyle(document.activeElement).outlineWidth"
        )
        seen = set()
        for _ in range(40):
            keys.press("Tab")
            seen.add(
                ana.page.evaluate(
                    "document.activeElement.textContent.trim() + ' ' + (document.activeElement.ariaLabel ?? '')"
                )
            )
            # A radio's label shows the focus; after the last element comes the browser's own frame.
            if not ana.page.evaluate("document.activeElement.matches('input[type=radio], body')"):
                assert ana.page.evaluate(outline) == "solid2px"
        for reached in ("Charts", "Emergency stop", "Available", "robot 1"):
            assert any(reached in text for text in seen), reached

        def press() -> int:
            if ana.page.locator(".offer").count():
                keys.press("a")
            return int(ana.page.locator(".stage-mine").count())

        until(press, "an offer is accepted")
        role = "document.activeElement.getAttribute('role')"
        until(lambda: ana.page.evaluate(role) == "application", "the picture has the keys")
        drive(ana, "ArrowUp", 0.5)
        keys.press("g")
        ana.page.wait_for_selector(".stage-mine", state="detached")


def test_a_thumb_drives_on_a_phone(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana", **PHONE) as ana:
        page = ana.page
        for path in ("/", "/queue", "/charts", "/more", "/operators", "/replay", "/audit", "/robot/1"):
            ana.go(path)
            page.wait_for_timeout(400)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{path} is wider than the screen"
            assert page.get_by_role("button", name="Emergency stop: all robots").is_visible()
        take(ana, 1)
        stick = page.locator(".stick svg")
        box = stick.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] < 844, "the stick is on the first screen"
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        touch = page.context.new_cdp_session(page)
        touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
        touch.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{"x": x + 40, "y": y}]})
        ana.see(".view-live")
        ana.see(".stick-on")
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        page.wait_for_selector(".view-live", state="detached")
        page.get_by_role("button", name="Give back").tap()
        page.wait_for_selector(".stage-mine", state="detached")


@pytest.mark.parametrize("size", [(320, 568), (390, 844), (667, 375), (844, 390), (1024, 768), (1181, 800)])
def test_the_emergency_stop_and_its_end_are_whole_on_every_screen(
    browser: Any, served: Served, size: tuple[int, int]
) -> None:
    width, height = size
    with person(browser, served.origin, "ada", **PHONE | {"viewport": {"width": width, "height": height}}) as ada:
        ada.page.get_by_role("button", name="Emergency stop: all robots").tap()
        ada.see(".banner-stop")
        for path in ("/", "/accounts", "/audit", "/robot/1"):
            ada.go(path)
            ada.page.wait_for_timeout(300)
            for button in (".estop", ".clear-stop"):
                box = ada.see(button).bounding_box()
                assert 0 <= box["x"] < box["x"] + box["width"] <= width, f"{button} is cut off at {path}"
            assert ada.page.evaluate("document.documentElement.scrollWidth") <= width, f"{path} is wider than the screen"
        ada.go("/")
        ada.see(".tile-name")
        cut = "[...document.querySelectorAll('.tile-name')].filter(e => e.scrollWidth > e.clientWidth).length"
        assert ada.page.evaluate(cut) == 0, "the names of robots are cut off"


def test_a_phone_on_its_side_shows_picture_stick_and_give_back_together(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana", **PHONE | {"viewport": {"width": 667, "height": 375}}) as ana:
        take(ana, 1)
        ana.see_picture()
        end = ana.see(".tabs").bounding_box()["y"]
        give_back = ana.page.get_by_role("button", name="Give back")
        boxes = [ana.see(".view").bounding_box(), ana.see(".stick svg").bounding_box(), give_back.bounding_box()]
        assert all(box["y"] >= 48 and box["y"] + box["height"] <= end + 1 for box in boxes), (boxes, end)
        give_back.tap()
        ana.page.wait_for_selector(".stage-mine", state="detached")


def test_a_press_on_the_picture_drives(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        take(ana, 1)
        box = ana.see_picture().bounding_box()
        assert box is not None
        ana.page.mouse.move(box["x"] + box["width"] * 0.4, box["y"] + box["height"] * 0.5)
        ana.page.mouse.down()
        ana.page.mouse.move(box["x"] + box["width"] * 0.6, box["y"] + box["height"] * 0.3, steps=4)
        ana.see(".arrow line")
        ana.see(".view-live")
        ana.page.mouse.up()
        ana.page.wait_for_selector(".view-live", state="detached")
        ana.page.keyboard.press("g")
        ana.page.wait_for_selector(".stage-mine", state="detached")


def test_nobody_drives_what_they_do_not_see(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        take(ana, 1)
        ana.go("/charts")
        ana.see(".charts")
        ana.page.wait_for_timeout(300)
        ana.page.keyboard.down("ArrowRight")
        ana.page.wait_for_timeout(500)
        with served.client("ben") as http:
            before = commands(http)
            ana.page.wait_for_timeout(500)
            assert commands(http) == before
        ana.page.keyboard.up("ArrowRight")
        ana.page.keyboard.press("g")


def commands(http: Any) -> int:
    """Commands of ana's that were executed."""
    return int(next(row["commands"] or 0 for row in http.get("/api/operators").json()["rows"] if row["operator"] == "ana"))


PAD = """() => {
  const pad = { connected: true, id: "A pad (Vendor: 1)", axes: [0.9, 0, 0, 0], buttons: [] };
  navigator.getGamepads = () => [pad];
}"""


def test_a_gamepad_drives(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana") as ana:
        take(ana, 1)
        ana.page.evaluate(PAD)
        ana.see(".view-live")
        ana.see(".controls", "Gamepad: A pad")
        ana.page.evaluate("() => { navigator.getGamepads = () => [] }")
        ana.page.wait_for_selector(".view-live", state="detached")
        ana.page.keyboard.press("g")
        ana.page.wait_for_selector(".stage-mine", state="detached")


def test_the_large_picture_may_come_by_webrtc(browser: Any, served: Served) -> None:
    pytest.importorskip("aiortc")
    with person(browser, served.origin, "vic") as vic:
        vic.go("/robot/1")
        vic.see(".way")
        vic.page.locator("input[name=way]").last.check(force=True)
        until(lambda: vic.page.evaluate("document.querySelector('.view video')?.videoWidth ?? 0") > 100, "a picture")
        vic.see(".hud", "Last picture")
        vic.page.locator("input[name=way]").first.check(force=True)
        vic.see_picture()


def test_viewers_look_and_do_nothing(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "vic") as vic:
        vic.go("/robot/0")
        vic.see(".panel", "You watch")
        assert vic.page.get_by_role("button", name=re.compile("stop|Take over", re.I)).count() == 0
        assert vic.page.get_by_role("link", name="Audit").count() == 0
        assert vic.page.get_by_role("link", name="Accounts").count() == 0
        vic.see_picture()


def test_every_page_shows_what_happened(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ada") as ada:
        take(ada, 2)
        drive(ada, seconds=1.0)
        ada.page.keyboard.press("g")
        ada.page.wait_for_selector(".stage-mine", state="detached")

        ada.go("/charts")
        ada.see(".chart", "Successes")
        ada.see(".chart", "Return on human effort")
        ada.see(".chart", "Intervention rate")
        until(lambda: ada.page.locator(".chart path.line").count() >= 8, "eight lines")

        ada.go("/operators")
        ada.see("tbody tr", "ada")

        ada.go("/replay")
        ada.see(".episodes a").click()
        ada.see(".player .chart", "executed")
        until(lambda: ada.page.evaluate("document.querySelector('.player img')?.naturalWidth ?? 0") > 100, "a picture")
        ada.page.get_by_label("Timestep", exact=True).press("End")
        ada.page.get_by_role("button", name="Play").click()
        ada.page.get_by_role("button", name="Pause").wait_for()

        ada.go("/audit")
        ada.see(".audit tbody tr", "Login")
        ada.page.get_by_role("button", name="Verify the chain").click()
        ada.see(".verdict-ok")
        ada.page.get_by_label("Kind").fill("login")
        ada.page.get_by_label("Kind").press("Enter")
        kinds = (
            "[...new Set([...document.querySelectorAll('.audit tbody tr')].map((row) => row.cells[2].textContent))].join()"
        )
        until(lambda: ada.page.evaluate(kinds) == "Login", "only logins are listed")

        ada.go("/accounts")
        ada.page.get_by_label("Name", exact=True).fill("zoe")
        ada.page.get_by_label("Password", exact=True).fill("a long enough one")
        ada.page.get_by_role("button", name="Add").click()
        row = ada.see("tbody tr", "zoe")
        row.get_by_role("combobox").select_option("viewer")
        ada.see(".note", "zoe is viewer now")
        row.get_by_role("button", name="Delete").click()
        ada.page.get_by_role("dialog").get_by_role("button", name="Delete").click()
        ada.page.locator("tbody tr", has_text="zoe").wait_for(state="detached")


def test_wrong_passwords_are_refused_in_words(browser: Any, served: Served) -> None:
    with person(browser, served.origin, None) as nobody:
        nobody.page.get_by_label("Name").fill("ana")
        nobody.page.get_by_label("Password").fill("wrong")
        nobody.page.get_by_role("button", name="Sign in").click()
        assert nobody.see("[role=alert]", re.compile(r"\w{4}")).inner_text()
        assert all("401" in complaint for complaint in nobody.complaints)  # the browser's own line about the refusal
        nobody.complaints.clear()


CONTRAST = """() => {
  const canvas = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const rgba = (text) => {
    canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = text; canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data];
  };
  const light = (c) => {
    const [r, g, b] = c.map((v) => { v /= 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (e) => {
    for (; e; e = e.parentElement) { const c = rgba(getComputedStyle(e).backgroundColor); if (c[3] > 250) return c; }
    return [255, 255, 255, 255];
  };
  const bad = [];
  for (const e of document.querySelectorAll("#app *")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.closest(":disabled, .sr, .tile-age, .view-note, .strip")) continue;
    const style = getComputedStyle(e);
    const color = e instanceof SVGElement ? style.fill : style.color;
    const [a, b] = [light(rgba(color)), light(behind(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) bad.push(`${e.className.baseVal ?? e.className} "${e.textContent.slice(0, 20)}" ${ratio.toFixed(2)}`);
  }
  return [...new Set(bad)];
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_easy_to_read(browser: Any, served: Served, scheme: str) -> None:
    with person(browser, served.origin, "ada", color_scheme=scheme) as ada:
        take(ada, 1)
        assert ada.page.evaluate(CONTRAST) == []
        ada.page.keyboard.press("g")
        ada.page.wait_for_selector(".stage-mine", state="detached")
        for path in ("/", "/charts", "/operators", "/replay", "/audit", "/accounts", "/more"):
            ada.go(path)
            ada.page.wait_for_timeout(300)
            assert ada.page.evaluate(CONTRAST) == [], path


def test_many_robots_are_watched_only_where_they_are_seen(browser: Any, served: Served) -> None:
    with person(browser, served.origin, "ana", viewport={"width": 700, "height": 420}) as ana:
        page, asked = ana.page, list[str]()
        page.on("websocket", lambda socket: socket.on("framesent", lambda said: asked.append(str(said))))
        page.reload()
        page.wait_for_selector(".tile")
        page.locator("input[name=size]").last.check()

        def watched() -> str:
            page.wait_for_timeout(100)
            return next((said for said in reversed(asked) if '"watch"' in said), "")

        until(lambda: 1 <= watched().count('"robot"') < ROBOTS, "only some are watched")
        ana.go("/charts")
        until(lambda: '"streams":[]' in watched(), "none is watched")


def test_a_robot_in_violation_is_set_up_again(browser: Any, served: Served) -> None:
    """Late in this file, as the policy learns from it where to fall."""
    with person(browser, served.origin, "ana") as ana:
        take(ana, 1)
        ana.page.keyboard.down("ArrowLeft")
        ana.see(".stage-head", "Violated")
        ana.page.keyboard.up("ArrowLeft")
        if not ana.page.locator(".stage-mine").count():  # its episode ended, and with it what ana had of it
            take(ana, 1)
        ana.see(".driving", "It needs a hard reset")
        ana.page.keyboard.press("h")
        ana.page.get_by_role("dialog").get_by_role("button", name="Reset").click()
        ana.see(".note", "reset is done")
        ana.page.wait_for_selector(".stage-mine", state="detached")


def test_the_page_comes_back_when_the_server_does(browser: Any, served: Served) -> None:
    somebody = Person(browser, served.origin, "ana")
    try:
        take(somebody, 0)
        served.kill()
        somebody.see(".note", "the robot holds")
        somebody.see(".banner-bad", "connection to the server is lost")
        assert somebody.page.locator(".stage-mine").count() == 0
        again = threading.Thread(target=served.start)
        again.start()
        again.join(120)
        somebody.page.wait_for_selector(".banner-bad", state="detached")
        somebody.see(".link:not(.link-bad)")
    finally:
        somebody.close()
