"""What strangers, and people with too small a role, can do to a running console: nothing."""

from __future__ import annotations

import contextlib
import json
import logging
import sqlite3
import statistics
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from consoles import PASSWORD, Running, Socket
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

PROTECTED = [
    ("GET", "/api/me"), ("GET", "/api/fleet"), ("GET", "/api/metrics"), ("GET", "/api/operators"), ("GET", "/api/audit"),
    ("GET", "/api/audit/verify"), ("GET", "/api/episodes"), ("GET", "/api/episodes/1"), ("GET", "/api/episodes/1/frames/0.jpg"),
    ("GET", "/api/accounts"), ("POST", "/api/accounts"), ("PATCH", "/api/accounts/ana"), ("DELETE", "/api/accounts/ana"),
    ("POST", "/api/estop"), ("POST", "/api/estop/clear"), ("POST", "/api/logout"), ("POST", "/api/password"),
]  # fmt: skip
BODY = {"robot": None, "name": "eve", "role": "admin", "password": PASSWORD, "old": PASSWORD, "new": PASSWORD}
SOCKETS = ["/api/live", "/api/video"]


def ask(client: httpx.Client, method: str, path: str, **options: Any) -> httpx.Response:
    return client.request(method, path, **({"json": {}} if method in ("POST", "PATCH") else {}) | options)


@pytest.fixture
def stranger(running: Running) -> Iterator[httpx.Client]:
    with contextlib.closing(running.client()) as client:
        yield client


def refusal(running: Running, path: str, origin: str | None, cookie: str | None) -> int:
    """The status with which a socket is refused, or 101."""
    headers = {"cookie": cookie} if cookie else {}
    try:
        with connect(f"ws://127.0.0.1:{running.port}{path}", origin=origin, additional_headers=headers):  # type: ignore[arg-type]
            return 101
    except InvalidStatus as error:
        return error.response.status_code


# -- who is not logged in ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "path"), PROTECTED)
def test_nothing_without_a_session(stranger: httpx.Client, method: str, path: str) -> None:
    assert ask(stranger, method, path).status_code == 401


def test_every_route_under_api_is_protected_or_meant_for_strangers(running: Running) -> None:
    from tutelage.console import account_api, fleet_api, study_api, webrtc

    routers = (account_api.router, fleet_api.router, study_api.router, webrtc.router)
    routes = {(m, r.path) for router in routers for r in router.routes for m in r.methods}  # type: ignore[attr-defined]
    open_to_all = {("POST", "/api/login"), ("POST", "/api/setup"), ("GET", "/healthz"), ("GET", "/metrics")}
    named = {(m, p.replace("/ana", "/{name}").replace("/1", "/{id}").replace("/0.jpg", "/{k}.jpg")) for m, p in PROTECTED}
    study = {("GET", "/api/study"), *(("POST", f"/api/study/{name}") for name in ("next", "turn", "answers"))}
    assert routes - open_to_all == named | study | {("POST", "/api/webrtc")}  # these have tests of their own


@pytest.mark.parametrize("path", SOCKETS)
def test_no_socket_without_a_session(running: Running, path: str) -> None:
    assert refusal(running, path, running.origin, None) == 401
    assert refusal(running, path, running.origin, "tutelage_session=forged") == 401
    assert refusal(running, "/api/other", running.origin, running.cookie("ana")) == 404


def test_forged_tokens_are_nobody(running: Running, stranger: httpx.Client) -> None:
    token = running.cookie("ana").split("=")[1]
    hashed = sqlite3.connect(running.accounts.path).execute("SELECT hex(token) FROM sessions").fetchone()[0]
    for forged in (token[:-1], token + "A", token.swapcase(), hashed, "' OR 1=1 --", "x" * 4000):
        answer = stranger.get("/api/me", headers={"cookie": f"tutelage_session={forged}"})
        assert answer.status_code == 401


def test_an_expired_session_ends_requests_and_sockets(running: Running) -> None:
    with running.socket("ben", cookie=expire_later(running)) as socket:
        socket.hear("hello")
        with sqlite3.connect(running.accounts.path) as database:
            database.execute("UPDATE sessions SET expires = 1 WHERE name = 'operator'")
        assert socket.closed() == 4401


def expire_later(running: Running) -> str:
    return running.cookie("operator")


def test_a_removed_account_is_out_at_once(running: Running) -> None:
    running.accounts.add("gone", running.accounts.all()[0].role, PASSWORD)
    cookie = running.cookie("gone")
    with running.socket("gone", cookie=cookie) as socket:
        socket.hear("hello")
        running.accounts.remove("gone")
        assert socket.closed() == 4401
    assert httpx.get(f"{running.origin}/api/me", headers={"cookie": cookie}).status_code == 401


# -- roles ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "method", "path"),
    [("viewer", "POST", "/api/estop"), ("viewer", "POST", "/api/estop/clear"), ("viewer", "GET", "/api/audit"),
     ("viewer", "GET", "/api/audit/verify"), ("operator", "GET", "/api/accounts"), ("operator", "POST", "/api/accounts"),
     ("operator", "PATCH", "/api/accounts/operator"), ("operator", "DELETE", "/api/accounts/viewer"),
     ("viewer", "PATCH", "/api/accounts/viewer")],
)  # fmt: skip
def test_a_role_that_is_too_small_is_refused(running: Running, name: str, method: str, path: str) -> None:
    with contextlib.closing(running.client(name)) as client:
        assert ask(client, method, path, **({} if method in ("GET", "DELETE") else {"json": BODY})).status_code == 403
    assert {account.name for account in running.accounts.all()} >= {"viewer", "operator", "admin", "ana"}


def test_viewers_only_look(running: Running) -> None:
    with running.socket("viewer") as viewer:
        assert viewer.hear("hello")["me"] == {"name": "viewer", "role": "viewer", "seat": None}
        calls = len(running.supervision.calls)
        for message in (
            {"type": "take", "robot": 0}, {"type": "estop", "robot": None}, {"type": "available", "yes": True},
            {"type": "command", "robot": 0, "lease": "x", "seq": 1, "action": [1]}, {"type": "renew", "lease": "x"},
            {"type": "hand_over", "robot": 0, "to": "ana"},
        ):  # fmt: skip
            viewer.say(**message, ref=5)
            assert viewer.hear("error", ref=5)["code"] == "forbidden"
        assert len(running.supervision.calls) == calls
        viewer.say("ping", n=1)
        viewer.hear("pong")


def test_a_socket_ends_when_its_role_changes(running: Running) -> None:
    from tutelage.console.accounts import Role

    running.accounts.add("climber", Role.OPERATOR, PASSWORD)
    with running.socket("climber") as socket:
        socket.hear("hello")
        running.accounts.set_role("climber", Role.VIEWER)
        assert socket.closed() == 4403


# -- other sites ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [{"origin": "https://evil.example"}, {"origin": "null"}, {"origin": ""}, {"x-tutelage": ""}, {"x-tutelage": "2"},
     {"sec-fetch-site": "cross-site"}, {"sec-fetch-site": "same-site"}, {"origin": "http://127.0.0.1"},
     {"origin": "http://127.0.0.1:1"}],
)  # fmt: skip
def test_requests_of_other_sites_change_nothing(running: Running, headers: dict[str, str]) -> None:
    with contextlib.closing(running.client("admin")) as client:
        before = len(running.supervision.calls)
        for method, path in PROTECTED:
            if method != "GET":
                assert (
                    ask(client, method, path, headers=headers, **({"json": BODY} if method != "DELETE" else {})).status_code
                    == 403
                )
        assert client.post("/api/login", json={"name": "ana", "password": PASSWORD}, headers=headers).status_code == 403
        assert len(running.supervision.calls) == before
        assert client.get("/api/me").status_code == 200


def test_a_request_without_an_origin_is_refused(running: Running) -> None:
    cookie = running.cookie("admin")
    answer = httpx.post(f"{running.origin}/api/estop", json={"robot": None}, headers={"cookie": cookie, "x-tutelage": "1"})
    assert answer.status_code == 403


@pytest.mark.parametrize("path", SOCKETS)
@pytest.mark.parametrize("origin", ["https://evil.example", "http://127.0.0.1:1", "null", None])
def test_sockets_of_other_sites_are_refused(running: Running, path: str, origin: str | None) -> None:
    assert refusal(running, path, origin, running.cookie("ana")) == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8800", "127.0.0.1.evil.example", "", "[", "192.0.2.1"])
def test_names_that_were_made_to_point_here_are_refused(running: Running, host: str) -> None:
    answer = httpx.get(f"{running.origin}/api/me", headers={"host": host})
    assert answer.status_code in (400, 421)
    assert "set-cookie" not in answer.headers


def test_no_other_site_may_read_or_frame(running: Running) -> None:
    with contextlib.closing(running.client("ana")) as client:
        answer = client.get("/api/fleet", headers={"origin": "https://evil.example"})
        assert not [name for name in answer.headers if name.startswith("access-control")]
        preflight = client.options(
            "/api/estop", headers={"origin": "https://evil.example", "access-control-request-method": "POST"}
        )
        assert preflight.status_code == 403


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/", 200), ("GET", "/assets/console-abc.js", 200), ("GET", "/nothing", 404), ("GET", "/api/me", 401),
     ("POST", "/api/login", 422), ("GET", "/healthz", 200), ("PUT", "/", 405), ("GET", "/api/episodes/x", 401)],
)  # fmt: skip
def test_every_answer_carries_the_headers(stranger: httpx.Client, method: str, path: str, status: int) -> None:
    answer = ask(stranger, method, path)
    assert answer.status_code == status
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["x-frame-options"] == "DENY"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cross-origin-resource-policy"] == "same-origin"
    assert "server" not in answer.headers
    assert answer.headers["cache-control"] == {
        "/": "no-cache",
        "/assets/console-abc.js": "public, max-age=31536000, immutable",
    }.get(path if status == 200 else "", "no-store")


# -- logging in -------------------------------------------------------------------------------------------------


def test_the_cookie_is_for_the_server_only(running: Running, stranger: httpx.Client) -> None:
    answer = stranger.post("/api/login", json={"name": "ana", "password": PASSWORD})
    cookie = answer.headers["set-cookie"].lower()
    for part in ("httponly", "samesite=strict", "path=/", "max-age=43200"):
        assert part in cookie
    assert "domain" not in cookie


def test_a_session_that_was_planted_is_not_taken_over(running: Running) -> None:
    planted = "A" * 43
    headers = {"cookie": f"tutelage_session={planted}", "origin": running.origin, "x-tutelage": "1"}
    answer = httpx.post(f"{running.origin}/api/login", json={"name": "ana", "password": PASSWORD}, headers=headers)
    assert planted not in answer.headers["set-cookie"]
    assert httpx.get(f"{running.origin}/api/me", headers={"cookie": f"tutelage_session={planted}"}).status_code == 401


def test_logging_in_again_ends_the_session_before(running: Running, stranger: httpx.Client) -> None:
    stranger.post("/api/login", json={"name": "ana", "password": PASSWORD})
    old = stranger.cookies["tutelage_session"]
    stranger.post("/api/login", json={"name": "viewer", "password": PASSWORD})
    assert stranger.cookies["tutelage_session"] != old
    assert httpx.get(f"{running.origin}/api/me", headers={"cookie": f"tutelage_session={old}"}).status_code == 401


def test_guessing_is_slowed_down_and_reveals_no_names(running: Running, stranger: httpx.Client) -> None:
    def guess(name: str) -> tuple[int, str]:
        answer = stranger.post("/api/login", json={"name": name, "password": "a wrong password"})
        return answer.status_code, answer.json()["error"].split(";")[0]

    known, unknown = ([guess(name) for _ in range(7)] for name in ("operator", "somebody"))
    assert known == unknown
    assert [status for status, _ in known] == [401] * 5 + [429] * 2
    answer = stranger.post("/api/login", json={"name": "operator", "password": PASSWORD})
    assert answer.status_code == 429
    assert 0 < answer.json()["retry_after"] <= 301
    assert int(answer.headers["retry-after"]) == answer.json()["retry_after"]
    forget_attempts(running)


def forget_attempts(running: Running) -> None:
    for window, _ in running.accounts._windows:
        window._times.clear()


def test_known_and_unknown_names_take_as_long(running: Running, stranger: httpx.Client) -> None:
    times: dict[str, list[float]] = {"ana": [], "zoe": []}
    for _ in range(15):
        for name, taken in times.items():
            forget_attempts(running)
            began = time.perf_counter()
            stranger.post("/api/login", json={"name": name, "password": "a wrong password"})
            taken.append(time.perf_counter() - began)
    forget_attempts(running)
    known, unknown = (statistics.median(taken) for taken in times.values())
    assert 0.4 < known / unknown < 2.5


def test_a_flood_of_logins_leaves_the_emergency_stop_alone(running: Running) -> None:
    import threading

    with contextlib.closing(running.client("ana")) as client:
        done = threading.Event()

        def flood() -> None:
            with contextlib.closing(running.client()) as other:
                while not done.is_set():
                    other.post("/api/login", json={"name": "x", "password": "y" * 900})

        threads = [threading.Thread(target=flood) for _ in range(8)]
        for thread in threads:
            thread.start()
        slowest = 0.0
        for _ in range(10):
            began = time.perf_counter()
            assert client.post("/api/estop", json={"robot": 1}).status_code == 200
            slowest = max(slowest, time.perf_counter() - began)
        done.set()
        for thread in threads:
            thread.join()
        client.post("/api/estop/clear", json={"robot": None})
    forget_attempts(running)
    assert slowest < 1.0


def test_secrets_are_never_logged(running: Running, stranger: httpx.Client, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    secret = "a very secret passphrase"
    stranger.post("/api/login", json={"name": secret, "password": secret})
    stranger.post("/api/login", json={"name": "ana", "password": secret, "more": secret})
    stranger.post("/api/login", content=b"{" + secret.encode())
    stranger.post("/api/setup", json={"token": secret, "name": "eve", "password": secret})
    token = running.cookie("ana").split("=")[1]
    running.audit.flush()
    record = b"".join(path.read_bytes() for path in running.folder.glob("record.sqlite*"))
    ours = [r.getMessage() for r in caplog.records if not r.name.startswith(("http", "websockets"))]  # not the clients'
    for hidden in (secret, token, PASSWORD):
        assert not [line for line in ours if hidden in line]
        assert hidden.encode() not in record


def test_errors_do_not_repeat_what_was_sent(stranger: httpx.Client) -> None:
    secret = "a very secret passphrase"
    for body in ({"name": 5, "password": secret}, {"name": "ana", "password": secret, secret: secret}, [secret]):
        answer = stranger.post("/api/login", json=body)
        assert answer.status_code == 422
        assert secret not in answer.text


def test_a_set_up_link_is_worth_nothing_once_there_are_accounts(running: Running, stranger: httpx.Client) -> None:
    for token in ("", "x", "x" * 43):
        answer = stranger.post("/api/setup", json={"token": token, "name": "eve", "password": PASSWORD})
        assert answer.status_code == 401
    assert "eve" not in {account.name for account in running.accounts.all()}


# -- bad input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    ["/../accounts.sqlite", "/..%2faccounts.sqlite", "/%2e%2e/accounts.sqlite", "/assets/../../accounts.sqlite", "//etc/passwd",
     "/assets/..%5c..%5caccounts.sqlite", "/assets/%00", "/.", "/assets", "/assets/", "/index.html/", "/%252e%252e/x", "/\\..\\x"],
)  # fmt: skip
def test_no_path_leads_out_of_the_page(running: Running, path: str) -> None:
    import socket

    with socket.create_connection(("127.0.0.1", running.port), timeout=5) as raw:
        raw.sendall(f"GET {path} HTTP/1.1\r\nhost: 127.0.0.1:{running.port}\r\nconnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: raw.recv(65536), b""))
    assert answer.split()[1] in (b"404", b"400")
    assert b"SQLite" not in answer
    assert b"root:" not in answer


@pytest.mark.parametrize("path", ["/api/login", "/api/setup"])
def test_large_bodies_are_refused_whether_announced_or_not(running: Running, stranger: httpx.Client, path: str) -> None:
    assert stranger.post(path, content=b"x" * 70_000).status_code == 413
    answer = stranger.post(path, content=(b"x" * 10_000 for _ in range(50)))
    assert answer.status_code in (400, 413, 422)
    assert stranger.get("/healthz").status_code == 200


@pytest.mark.parametrize("length", ["-1", "1e9", "99999999999999999999", "abc"])
def test_strange_lengths_are_refused(running: Running, length: str) -> None:
    import socket

    with socket.create_connection(("127.0.0.1", running.port), timeout=5) as raw:
        raw.sendall(
            f"POST /api/login HTTP/1.1\r\nhost: 127.0.0.1:{running.port}\r\norigin: {running.origin}\r\nx-tutelage: 1\r\n"
            f"content-length: {length}\r\nconnection: close\r\n\r\n".encode()
        )
        assert raw.recv(65536).split()[1] in (b"400", b"413")


@pytest.mark.parametrize("begun", [b"", b"GET / HT", b"POST /api/login HTTP/1.1\r\ncontent-length: 10\r\n\r\nab"])
def test_half_a_request_does_not_hold_a_connection(running: Running, monkeypatch: pytest.MonkeyPatch, begun: bytes) -> None:
    import socket

    monkeypatch.setattr("tutelage.console.protocol.REQUEST_SECONDS", 0.3)
    with socket.create_connection(("127.0.0.1", running.port), timeout=5) as raw:
        raw.sendall(begun)
        began = time.monotonic()
        with contextlib.suppress(ConnectionResetError):
            while raw.recv(65536):
                pass
        assert time.monotonic() - began < 3
    with contextlib.closing(running.client()) as client:  # between requests a connection may wait
        assert client.get("/healthz").status_code == 200
        time.sleep(0.6)
        assert client.get("/healthz").status_code == 200


def test_one_place_has_a_limited_number_of_connections(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    from tutelage.console import protocol

    monkeypatch.setattr(protocol, "EACH_MAX", sum(protocol._open.values()) + 5)
    with running.socket("ana") as ana:  # a socket is no request
        ana.hear("hello")
        with contextlib.ExitStack() as stack:
            raws = [stack.enter_context(socket.create_connection(("127.0.0.1", running.port), timeout=5)) for _ in range(20)]
            refused = 0
            for raw in raws:
                raw.settimeout(0.3)
                with contextlib.suppress(TimeoutError):
                    try:
                        refused += raw.recv(1) == b""
                    except ConnectionResetError:
                        refused += 1
            assert 12 <= refused < 20
        ana.say("ping", n=3)
        ana.hear("pong", n=3)
    deadline = time.monotonic() + 5
    while sum(protocol._open.values()) > 3:
        assert time.monotonic() < deadline
        time.sleep(0.05)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(json_values)
def test_any_body_gets_a_clear_answer(stranger: httpx.Client, body: Any) -> None:
    content = json.dumps(body).encode()
    for path in ("/api/login", "/api/setup"):
        answer = stranger.post(path, content=content, headers={"content-type": "application/json"})
        assert answer.status_code in (401, 422)
        assert set(answer.json()) == {"error"}


@pytest.mark.parametrize(
    "query", ["since=-1", "since=x", "since=9999999999999999999999", "limit=0", "limit=1e9", "before=-5", "robot=a"]
)
def test_bad_queries_are_told(running: Running, query: str) -> None:
    with contextlib.closing(running.client("ana")) as client:
        path = "/api/metrics" if query.startswith("since") else "/api/audit"
        answer = client.get(f"{path}?{query}")
        assert answer.status_code == 422
        assert answer.json().keys() == {"error"}


def test_sql_is_only_text(running: Running) -> None:
    with contextlib.closing(running.client("ana")) as client:
        for value in ("' OR 1=1 --", "x'; DROP TABLE record; --", "%"):
            assert client.get("/api/audit", params={"who": value}).json()["rows"] == []
    assert running.audit.verify().ok


fields = st.sampled_from(["robot", "lease", "seq", "action", "push", "assist", "to", "yes", "ref", "n", "time", "sent", "x"])
kinds = st.sampled_from(
    ["accept", "decline", "take", "give_back", "reset", "hand_over", "available", "estop", "estop_clear", "command", "renew", "ping",
     "hello", "watch", "got", ""]
)  # fmt: skip
messages = (
    st.builds(lambda kind, more: {"type": kind} | more, kinds, st.dictionaries(fields, json_values, max_size=5))
    | json_values
)


@pytest.fixture
def ana(running: Running) -> Iterator[Socket]:
    with running.socket("ana") as socket:
        socket.hear("hello")
        yield socket


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(messages, max_size=8))
def test_any_message_gets_an_answer_and_none_breaks_the_server(running: Running, said: list[Any]) -> None:
    with running.socket("ana", cookie=shared_cookie(running)) as socket:
        for message in said:
            socket.connection.send(json.dumps(message))
        socket.say("ping", n=77)
        socket.hear("pong", n=77)
        assert not [m for m in socket.seen if m.get("code") == "internal"]
    for _, robot, seq, action, _, push in running.supervision.commands:
        assert isinstance(robot, int)
        assert isinstance(seq, int)
        for number in [*(action or ()), *(push or ())]:
            assert abs(number) < float("inf")
    running.supervision.estop("ana", None)
    running.supervision.clear_estop("ana", None)


_cookies: dict[int, str] = {}


def shared_cookie(running: Running) -> str:
    return _cookies.setdefault(running.port, running.cookie("ana"))


@pytest.mark.parametrize(
    "text",
    ["", "{", "null", "[]", '"ping"', '{"type": "ping"', '{"type": "estop"}', '{"type": "estop", "robot": "all"}', "[" * 5000,
     '{"type": "take", "robot": true}', '{"type": "take", "robot": -1}', '{"type": "take", "robot": 1.0}', '{"type": "ping", "x": 1}',
     '{"type": "command", "robot": 0, "lease": "x", "seq": 1, "action": [NaN]}',
     '{"type": "command", "robot": 0, "lease": "x", "seq": 1, "action": [1e999]}',
     '{"type": "command", "robot": 0, "lease": "x", "seq": 1, "action": ' + str([0] * 65) + "}",
     '{"type": "hand_over", "robot": 0, "to": "' + "a" * 65 + '"}', '{"type": "ping", "n": ' + "9" * 400 + "}"],
)  # fmt: skip
def test_malformed_messages_are_told_and_the_socket_stays(ana: Socket, text: str) -> None:
    ana.connection.send(text)
    error = ana.hear("error")
    assert error["code"] == "malformed"
    assert len(error["text"]) <= 200
    ana.say("ping", n=5)
    ana.hear("pong", n=5)


def test_bytes_are_malformed(ana: Socket) -> None:
    ana.connection.send(b"\x00\x01")
    assert ana.hear("error")["code"] == "malformed"


def test_twenty_malformed_messages_end_the_socket(ana: Socket) -> None:
    for _ in range(20):
        ana.connection.send("{")
    assert ana.closed() == 1008


def test_an_oversized_message_ends_the_socket(ana: Socket) -> None:
    ana.connection.send("x" * 70_000)
    assert ana.closed() == 1009


def test_a_flood_is_slowed_down_then_ended_and_a_stop_goes_through(ana: Socket, running: Running) -> None:
    ping = json.dumps({"type": "ping", "n": 1})
    for _ in range(700):
        ana.connection.send(ping)
    ana.say("estop", robot=3, ref="stop")
    ana.hear("ack", ref="stop")
    assert [m for m in ana.seen if m.get("code") == "too_many"]
    assert len([m for m in ana.seen if m["type"] == "pong"]) < 600
    assert running.supervision.stopped[3]
    running.supervision.clear_estop("ana", None)
    with contextlib.suppress(Exception):
        for _ in range(3000):
            ana.connection.send(ping)
    assert ana.closed() == 1008


def test_a_flood_on_one_socket_leaves_the_others_alone(running: Running) -> None:
    ping = json.dumps({"type": "ping", "n": 1})
    with running.socket("operator") as flooder, running.socket("ana") as ana:
        ana.hear("hello")
        with contextlib.suppress(Exception):
            for _ in range(1200):
                flooder.connection.send(ping)
        began = time.perf_counter()
        ana.say("ping", n=9)
        ana.hear("pong", n=9)
        assert time.perf_counter() - began < 0.5


def test_one_account_has_eight_sockets_at_most(running: Running) -> None:
    cookie = running.cookie("operator")
    with contextlib.ExitStack() as stack:
        for _ in range(8):
            stack.enter_context(running.socket("operator", cookie=cookie)).hear("hello")
        assert refusal(running, "/api/live", running.origin, cookie) == 429
        stack.enter_context(running.socket("ana")).hear("hello")


def test_somebody_elses_robot_and_lease_are_refused(running: Running) -> None:
    with running.socket("ana") as ana, running.socket("operator") as other:
        ana.say("take", robot=1, ref=1)
        lease = ana.hear("lease", robot=1)["id"]
        other.hear("hello")
        other.say("take", robot=1, ref=2)
        assert other.hear("error", ref=2)["code"] == "taken"
        for message in (
            {"type": "command", "robot": 1, "lease": lease, "seq": 1, "action": [1.0]}, {"type": "give_back", "robot": 1},
            {"type": "reset", "robot": 1}, {"type": "hand_over", "robot": 1, "to": "operator"},
        ):  # fmt: skip
            other.say(**message, ref=3)
            assert other.hear("error", ref=3)["code"] == "not_yours"
        other.say("renew", lease=lease, ref=4)
        assert other.hear("error", ref=4)["code"] == "stale_lease"
        assert all(command[0] != "operator" for command in running.supervision.commands)
        ana.say("give_back", robot=1)
        ana.hear("lease_end", robot=1)
