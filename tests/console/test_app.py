"""The web application, running: people, HTTP, the live socket."""

from __future__ import annotations

import contextlib
import json
import re
import threading
import time
from pathlib import Path

import httpx
import pytest
from consoles import PASSWORD, Running

from tutelage.console.supervision import Notice


def test_a_person_logs_in_sees_the_fleet_and_logs_out(running: Running) -> None:
    with contextlib.closing(running.client()) as client:
        assert client.get("/api/me").status_code == 401
        answer = client.post("/api/login", json={"name": "ana", "password": PASSWORD})
        assert answer.json() == {"name": "ana", "role": "operator"}
        assert client.get("/api/me").json() == {"name": "ana", "role": "operator", "seat": None}
        fleet = client.get("/api/fleet").json()
        assert fleet["task"] == "Points"
        assert len(fleet["robots"]) == 4
        assert abs(fleet["server_time"] - time.time()) < 5
        client.post("/api/logout")
        assert client.get("/api/me").status_code == 401
    running.audit.flush()
    kinds = [(row.kind, row.who) for row in running.audit.rows()]
    assert ("logout", "ana") in kinds
    assert ("login", "ana") in kinds


def test_the_page_and_its_files(running: Running) -> None:
    page = httpx.get(f"{running.origin}/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert "Tutelage" in page.text
    again = httpx.get(f"{running.origin}/", headers={"if-none-match": page.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert httpx.get(f"{running.origin}/assets/console-abc.js").headers["content-type"].startswith("text/javascript")
    assert httpx.head(f"{running.origin}/").status_code == 200
    missing = httpx.get(f"{running.origin}/api/nothing")
    assert (missing.status_code, missing.json()) == (404, {"error": "there is nothing here"})


def test_what_the_fleet_tells_is_json_without_nan(running: Running) -> None:
    with contextlib.closing(running.client("viewer")) as client:
        rows = client.get("/api/metrics", params={"since": 3}).json()["rows"]
        assert rows[0]["t"] == 4
        assert rows[0]["rohe"] is None
        assert client.get("/api/episodes").json()["rows"][0]["outcome"] == "given_back"
        assert client.get("/api/episodes/1").json()["frames"] == [{"t": 0, "wanted": [None, 1.0]}]
        assert client.get("/api/episodes/9").status_code == 404
        picture = client.get("/api/episodes/1/frames/0.jpg")
        assert picture.headers["content-type"] == "image/jpeg"
        assert picture.content.startswith(b"\xff\xd8")
        assert client.get("/api/episodes/1/frames/7.jpg").status_code == 404


def test_admins_manage_accounts(running: Running) -> None:
    with contextlib.closing(running.client("admin")) as client:
        new = {"name": "Dora", "role": "viewer", "password": "some long password"}
        assert client.post("/api/accounts", json=new).status_code == 200
        assert client.post("/api/accounts", json=new).json() == {"error": "there is an account dora already"}
        assert client.post("/api/accounts", json=new | {"name": "x y"}).status_code == 400
        assert client.post("/api/accounts", json=new | {"name": "emil", "role": "king"}).status_code == 400
        rows = {row["name"]: row for row in client.get("/api/accounts").json()["rows"]}
        assert rows["dora"]["role"] == "viewer"
        assert rows["dora"]["last_login"] is None
        assert "password" not in rows["dora"]
        assert client.patch("/api/accounts/dora", json={"role": "operator", "password": "short"}).status_code == 400
        rows = {row["name"]: row for row in client.get("/api/accounts").json()["rows"]}
        assert rows["dora"]["role"] == "viewer", "a change that is refused changes nothing"
        assert client.patch("/api/accounts/dora", json={"role": "operator", "password": PASSWORD}).status_code == 200
        with contextlib.closing(running.client("dora")) as dora:
            assert dora.get("/api/me").json()["role"] == "operator"
            assert client.delete("/api/accounts/dora").status_code == 200
            assert dora.get("/api/me").status_code == 401
        assert client.delete("/api/accounts/admin").json() == {"error": "admin is the only admin; make another one first"}
        rows = client.get("/api/audit", params={"kind": "account"}).json()["rows"]
        assert [row["fields"]["action"] for row in rows] == ["remove", "password", "role", "add"]


def test_people_change_their_password(running: Running) -> None:
    from tutelage.console.accounts import Role

    running.accounts.add("fred", Role.VIEWER, PASSWORD)
    with contextlib.closing(running.client("fred")) as here, contextlib.closing(running.client("fred")) as elsewhere:
        assert here.post("/api/password", json={"old": "wrong wrong", "new": "another password"}).status_code == 403
        assert here.post("/api/password", json={"old": PASSWORD, "new": "short"}).status_code == 400
        assert here.post("/api/password", json={"old": PASSWORD, "new": "another password"}).status_code == 200
        assert here.get("/api/me").status_code == 200
        assert elsewhere.get("/api/me").status_code == 401


def test_the_record_is_shown_and_verified(running: Running) -> None:
    with contextlib.closing(running.client("ana")) as client:
        rows = client.get("/api/audit", params={"limit": 2}).json()
        assert len(rows["rows"]) == 2
        assert rows["head"]["rows"] >= rows["rows"][0]["id"]
        older = client.get("/api/audit", params={"limit": 2, "before": rows["rows"][-1]["id"]}).json()["rows"]
        assert all(row["id"] < rows["rows"][-1]["id"] for row in older)
        assert {row["who"] for row in client.get("/api/audit", params={"who": "ana"}).json()["rows"]} == {"ana"}
        verdict = client.get("/api/audit/verify").json()
        assert verdict["ok"]
        assert verdict["broken_at"] is None


def test_health_and_numbers_for_this_machine(running: Running) -> None:
    assert httpx.get(f"{running.origin}/healthz").json() == {"ok": True}
    lines = httpx.get(f"{running.origin}/metrics").text.splitlines()
    numbers = dict(line.split() for line in lines if not line.startswith("#"))
    assert float(numbers["tutelage_online"]) == 4
    assert "tutelage_console_sockets" in numbers
    assert all(float(value) == float(value) for value in numbers.values())


def test_prometheus_takes_every_name_and_gets_every_digit(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{"t": 12345678, "loss/risk": 0.25, "time": 1795381200.5}]  # one bad name and Prometheus takes none
    monkeypatch.setattr(running.supervision, "metrics", lambda since=0: rows)
    lines = [line for line in httpx.get(f"{running.origin}/metrics").text.splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[a-zA-Z_:][a-zA-Z0-9_:]* \S+", line) for line in lines)
    assert {"tutelage_fleet_t 12345678", "tutelage_fleet_loss_risk 0.25", "tutelage_fleet_time 1795381200.5"} <= set(lines)


# -- the live socket --------------------------------------------------------------------------------------------


def test_a_request_from_offer_to_give_back(running: Running) -> None:
    with running.socket("ana") as ana:
        hello = ana.hear("hello")
        assert hello["me"] == {"name": "ana", "role": "operator", "seat": 0}
        assert hello["fleet"]["robots"][0] == "point-0"
        assert 0 < len(hello["metrics"]) <= 600
        state = ana.hear("state")
        assert len(state["mode"]) == 4
        running.supervision.offer(2, "ana")
        ana.hear("offer", robot=2, reason="uncertain")
        ana.say("accept", robot=2, ref=7)
        lease = ana.hear("lease", robot=2)
        ana.hear("ack", ref=7)
        ana.say("command", robot=2, lease=lease["id"], seq=1, sent=1.5, action=[0.5], assist=False, push=None)
        ana.say("renew", lease=lease["id"])
        ana.say("ping", n=3, time=12.5)
        pong = ana.hear("pong", n=3)
        assert pong["time"] == 12.5
        assert abs(pong["server_time"] - time.time()) < 5
        assert running.supervision.commands[-1] == ("ana", 2, 1, [0.5], False, None)
        link = ana.hear("link")
        assert link["commands"] == 1
        assert 0 < link["command_latency_ms"]["p50"] < 100
        ana.say("give_back", robot=2, ref="back")
        assert ana.hear("lease_end", robot=2)["why"] == "given_back"


@pytest.mark.parametrize(
    ("message", "code"),
    [({"type": "accept", "robot": 0}, "not_offered"), ({"type": "decline", "robot": 0}, "not_offered"),
     ({"type": "take", "robot": 99}, "unknown_robot"), ({"type": "give_back", "robot": 0}, "not_yours"),
     ({"type": "renew", "lease": "none"}, "stale_lease"), ({"type": "estop", "robot": 99}, "unknown_robot"),
     ({"type": "command", "robot": 0, "lease": "none", "seq": 1, "action": [1]}, "not_yours")],
)  # fmt: skip
def test_what_is_not_possible_is_told(running: Running, message: dict[str, object], code: str) -> None:
    with running.socket("ana") as ana:
        ana.say(**message, ref=4)  # type: ignore[arg-type]
        error = ana.hear("error", ref=4)
        assert error["code"] == code
        assert error["text"]


def test_everybody_who_may_help_is_listed(running: Running) -> None:
    with running.socket("ana") as ana, running.socket("viewer") as viewer:
        ana.hear("hello")
        viewer.hear("hello")
        with contextlib.closing(running.client("operator")) as client, running.socket("operator") as other:
            other.hear("hello")
            rows = client.get("/api/operators").json()["rows"]
    assert {(row["name"], row["operator"], row["online"]) for row in rows} == {(n, n, True) for n in ("ana", "operator")}


def test_events_go_to_those_they_are_for(running: Running) -> None:
    with running.socket("ana") as ana, running.socket("operator") as other:
        ana.hear("hello")
        other.hear("hello")
        running.supervision.offer(1, "ana")
        running.supervision.tell(Notice(None, "info", "for all"))
        ana.hear("offer", robot=1)
        ana.hear("notice", text="for all")
        other.hear("notice", text="for all")
        assert not [m for m in other.seen if m["type"] == "offer"]
        ana.say("decline", robot=1)


def test_the_seats_are_taken_until_somebody_goes(running: Running) -> None:
    with running.socket("admin") as late:
        with running.socket("ana") as ana, running.socket("operator") as other:
            assert late.hear("hello")["me"]["seat"] == 0
            assert other.hear("hello")["me"]["seat"] is None or ana.hear("hello")["me"]["seat"] is None
            loser = other if not ana.seen or ana.seen[0]["me"]["seat"] is not None else ana
            assert loser.hear("error")["code"] == "no_seat"
            loser.say("available", yes=True, ref=1)
            assert loser.hear("error", ref=1)["code"] == "no_seat"
        wait_until(lambda: len(running.supervision.seats) == 1)
        with running.socket("ana") as ana:
            assert ana.hear("hello")["me"]["seat"] == 1


def wait_until(what: object, seconds: float = 5.0) -> None:
    deadline = time.monotonic() + seconds
    while not what():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_somebody_leaves_with_their_last_socket_and_finds_their_robot_again(running: Running) -> None:
    cookie = running.cookie("ana")
    with running.socket("ana", cookie=cookie) as one:
        one.say("take", robot=3)
        lease = one.hear("lease", robot=3)["id"]
        with running.socket("ana", cookie=cookie) as two:
            assert two.hear("lease", robot=3)["id"] == lease
            running.supervision.offer(0, "ana")
            two.hear("offer", robot=0)
        time.sleep(0.2)
        assert running.supervision.leases[3].operator == "ana"
        with running.socket("ana", cookie=cookie) as three:
            assert three.hear("offer")["robot"] == 0
    wait_until(lambda: 3 not in running.supervision.leases)
    assert running.supervision.calls[-1][:2] == ("ana", "leave")
    running.supervision.offered.clear()


def test_who_is_silent_for_five_seconds_is_gone(running: Running) -> None:
    with running.socket("ana") as ana:
        ana.hear("hello")
        began = time.monotonic()
        assert ana.closed() == 4408
        assert 4.0 < time.monotonic() - began < 7.0
    wait_until(lambda: running.supervision.calls[-1][:2] == ("ana", "leave"))


def test_a_page_that_does_not_read_is_let_go_and_harms_nobody(running: Running) -> None:
    """It gets the newest state when it reads again, and events wait for it up to a limit."""
    with running.socket("operator", max_queue=1) as slow, running.socket("ana") as ana:
        ana.hear("hello")
        text = "x" * 20_000
        for i in range(900):
            running.supervision.tell(Notice("operator", "info", text))
            if i % 100 == 0:
                ana.say("ping", n=i)
                ana.hear("pong", n=i, timeout=1.0)
        wait_until(lambda: "operator" not in running.supervision.seats, 10)
        del slow


def test_a_slow_page_gets_the_newest_state_and_no_backlog(running: Running) -> None:
    with running.socket("ana", max_queue=1) as ana:
        ana.hear("hello")
        for _ in range(3):
            time.sleep(0.9)
            ana.say("ping", n=1)
            state = ana.hear("state")
            seen = len(ana.seen)
            deadline = time.monotonic() + 0.3
            while time.monotonic() < deadline:
                with contextlib.suppress(TimeoutError):
                    message = json.loads(ana.connection.recv(0.05))
                    ana.seen.append(message)
                    state = message if message["type"] == "state" else state
            assert running.supervision.snapshot().t - state["t"] <= 4
            assert len(ana.seen) - seen < 40


def test_an_emergency_stop_waits_for_nothing_else(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many other requests hang."""
    let_go = threading.Event()
    monkeypatch.setattr(running.supervision, "available", lambda operator, yes: let_go.wait(20))
    cookie = running.cookie("ana")
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(running.socket("ana", cookie=cookie)) for _ in range(6)]
        for socket in sockets:
            socket.hear("hello")
            socket.say("available", yes=True, ref=1)
        time.sleep(0.2)
        sockets[0].say("estop", robot=1, ref="stop")
        sockets[0].say("estop_clear", robot=1, ref="clear")
        sockets[0].say("estop", robot=1, ref="again")
        sockets[0].hear("ack", timeout=1, ref="again")
        assert running.supervision.stopped[1]
        running.supervision.stopped[1] = False
        with contextlib.closing(running.client("operator")) as client:
            began = time.monotonic()
            assert client.post("/api/estop", json={"robot": 2}).status_code == 200
            assert time.monotonic() - began < 1
            assert running.supervision.stopped[2]
            assert client.post("/api/estop/clear", json={"robot": 2}).status_code == 200
        let_go.set()
        for socket in sockets:
            socket.hear("ack", ref=1)


def test_what_a_page_said_before_it_went_is_done(running: Running) -> None:
    for k in range(10):
        with running.socket("ana") as ana:
            ana.hear("hello")
            ana.say("take", robot=3)
            ana.say("give_back", robot=3)
            ana.say("estop", robot=k % 4)
            ana.connection.close()
        wait_until(lambda: running.supervision.stopped.any())
        assert running.supervision.stopped.tolist() == [robot == k % 4 for robot in range(4)]
        wait_until(lambda: running.supervision.calls[-1][:2] == ("ana", "leave"))
        assert 3 not in running.supervision.leases
        running.supervision.stopped[:] = False


def test_a_full_disk_refuses_what_must_be_recorded_and_lets_people_look(tmp_path: Path) -> None:
    server = Running(tmp_path)
    try:
        with server.socket("ana") as ana:
            ana.hear("hello")
            ana.say("take", robot=0)
            ana.hear("lease", robot=0)
            server.audit.flush()
            server.audit._error = "the record cannot be written: disk full"
            ana.say("take", robot=1, ref=1)
            assert ana.hear("error", ref=1)["code"] == "held"
            ana.hear("state")
            with contextlib.closing(server.client()) as client:
                assert client.get("/healthz").status_code == 503
                answer = client.post("/api/login", json={"name": "ana", "password": PASSWORD})
                assert answer.status_code == 503
                assert "disk full" in answer.json()["error"]
                assert "set-cookie" not in answer.headers
            server.audit._error = None
    finally:
        server.close()
