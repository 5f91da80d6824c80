"""Accounts, sessions and limits."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.console.accounts import SESSION_SECONDS, SETUP_SECONDS, Accounts, LoginError, Role, TooManyAttemptsError
from tutelage.console.limits import Bucket, Window, is_loopback, network_of
from tutelage.console.passwords import Passwords
from tutelage.errors import ConfigError

GOOD = "correct horse battery"
HERE = "192.0.2.1"


class Clock:
    """Time that a test moves."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def accounts(tmp_path: Path, clock: Clock) -> Iterator[Accounts]:
    made = Accounts(tmp_path, Passwords(time_cost=1, memory_cost=1024), clock, clock)
    made.add("ana", Role.OPERATOR, GOOD)
    made.add("root", Role.ADMIN, GOOD)
    yield made
    made.close()


def test_a_session_stands_for_its_account_until_it_expires(accounts: Accounts, clock: Clock) -> None:
    token, session = accounts.login("Ana ", GOOD, HERE)
    assert (session.name, session.role) == ("ana", Role.OPERATOR)
    assert accounts.session(token) == session
    clock.now += SESSION_SECONDS - 1
    assert accounts.session(token)
    clock.now += 1
    assert accounts.session(token) is None


def test_sessions_end_with_logout_removal_and_a_new_password(accounts: Accounts) -> None:
    accounts.add("ben", Role.VIEWER, GOOD)
    one, _ = accounts.login("ben", GOOD, HERE)
    two, kept = accounts.login("ben", GOOD, HERE)
    accounts.logout(one)
    assert accounts.session(one) is None
    three, _ = accounts.login("ben", GOOD, HERE)
    accounts.set_password("ben", "another good one", keep=kept.key)
    assert accounts.session(three) is None
    assert accounts.session(two)
    accounts.remove("ben")
    assert accounts.session(two) is None


def test_a_changed_role_holds_from_the_next_request_on(accounts: Accounts) -> None:
    token, _ = accounts.login("ana", GOOD, HERE)
    accounts.set_role("ana", Role.VIEWER)
    session = accounts.session(token)
    assert session
    assert session.role is Role.VIEWER


def test_a_login_ends_the_session_it_replaces_and_never_takes_its_token(accounts: Accounts) -> None:
    old, _ = accounts.login("ana", GOOD, HERE)
    new, _ = accounts.login("ana", GOOD, HERE, replaces=old)
    assert new != old
    assert accounts.session(old) is None
    chosen = "a token that somebody else chose"
    given_, _ = accounts.login("ana", GOOD, HERE, replaces=chosen)
    assert given_ != chosen
    assert accounts.session(chosen) is None


def test_the_files_hold_neither_passwords_nor_tokens(accounts: Accounts, tmp_path: Path) -> None:
    token, _ = accounts.login("ana", GOOD, HERE)
    content = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert b"$argon2id$" in content
    assert GOOD.encode() not in content
    assert token.encode() not in content
    assert accounts.path.stat().st_mode & 0o077 == 0


def test_who_is_unknown_and_who_is_wrong_hear_the_same_after_the_same_work(accounts: Accounts) -> None:
    calls = []
    check = accounts.passwords._hasher.verify
    accounts.passwords._hasher = type("Counting", (), {"verify": lambda _, *a: (calls.append(a), check(*a))[1]})()  # type: ignore[assignment]
    said = set()
    for name in ("ana", "nobody-here"):
        with pytest.raises(LoginError) as error:
            accounts.login(name, "wrong but long enough", HERE)
        said.add(str(error.value))
    assert len(said) == 1
    assert len(calls) == 2
    assert calls[0][0].rsplit("$", 2)[0] == calls[1][0].rsplit("$", 2)[0]  # the same kind, version and costs


@pytest.mark.parametrize("name", ["ana", "nobody-here"])
def test_attempts_are_limited_by_name_and_place(accounts: Accounts, clock: Clock, name: str) -> None:
    for _ in range(5):
        with pytest.raises(LoginError, match="wrong name or password"):
            accounts.login(name, "wrong", HERE)
    with pytest.raises(TooManyAttemptsError) as error:
        accounts.login(name, GOOD, HERE)
    assert 0 < error.value.retry_after <= 300
    clock.now += 301
    if name == "ana":
        accounts.login(name, GOOD, HERE)


def test_a_stranger_elsewhere_does_not_lock_somebody_out(accounts: Accounts) -> None:
    for _ in range(7):
        with pytest.raises(LoginError):
            accounts.login("ana", "wrong", "203.0.113.9")
    accounts.login("ana", GOOD, HERE)


def test_many_names_from_one_place_and_many_places_for_one_name_are_limited(accounts: Accounts) -> None:
    for i in range(30):
        with pytest.raises(LoginError, match="wrong name"):
            accounts.login(f"name{i}", "wrong", HERE)
    with pytest.raises(TooManyAttemptsError):
        accounts.login("other", "wrong", HERE)
    for i in range(50):
        with pytest.raises(LoginError, match="wrong name"):
            accounts.login("ana", "wrong", f"198.51.100.{i}")
    with pytest.raises(TooManyAttemptsError):
        accounts.login("ana", GOOD, "203.0.113.77")


def test_parallel_attempts_do_not_slip_past_the_limit(accounts: Accounts) -> None:
    looked = []

    def attempt() -> None:
        try:
            accounts.login("ana", "wrong", HERE)
        except TooManyAttemptsError:
            pass
        except LoginError:
            looked.append(1)

    threads = [threading.Thread(target=attempt) for _ in range(30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(looked) == 5


def test_good_logins_are_not_counted(accounts: Accounts) -> None:
    for _ in range(40):
        accounts.login("ana", GOOD, HERE)


@pytest.mark.parametrize(
    "name", ["", "Ana", "a b", "-a", "a" * 33, "server", "a\n", "ána", "../x", "a'; DROP TABLE accounts; --"]
)
def test_bad_names_are_refused(accounts: Accounts, name: str) -> None:
    with pytest.raises(ConfigError):
        accounts.add(name, Role.VIEWER, GOOD)


@pytest.mark.parametrize("password", ["", "short", "x" * 257, "aaaaaaaaaaaaaaaa"])
def test_bad_passwords_are_refused(accounts: Accounts, password: str) -> None:
    with pytest.raises(ConfigError):
        accounts.add("carl", Role.VIEWER, password)
    assert "carl" not in {account.name for account in accounts.all()}


def test_the_last_admin_stays(accounts: Accounts) -> None:
    with pytest.raises(ConfigError, match="only admin"):
        accounts.remove("root")
    with pytest.raises(ConfigError, match="only admin"):
        accounts.set_role("root", Role.VIEWER)
    accounts.add("carl", Role.ADMIN, GOOD)
    accounts.remove("root")


@pytest.mark.parametrize(
    "call",
    [lambda a: a.remove("carl"), lambda a: a.set_role("carl", Role.VIEWER), lambda a: a.set_password("carl", GOOD)],
)
def test_unknown_accounts_are_told(accounts: Accounts, call: object) -> None:
    with pytest.raises(ConfigError, match="no account carl"):
        call(accounts)  # type: ignore[operator]


def test_a_name_is_taken_once(accounts: Accounts) -> None:
    with pytest.raises(ConfigError, match="already"):
        accounts.add("ana", Role.ADMIN, GOOD)


def test_a_password_typed_on_another_keyboard_is_the_same(accounts: Accounts) -> None:
    accounts.add("carl", Role.VIEWER, "grüße aus münchen")
    accounts.login("carl", "gru\u0308ße aus mu\u0308nchen", HERE)


def test_weaker_hashes_are_renewed_at_login(accounts: Accounts, tmp_path: Path, clock: Clock) -> None:
    stronger = Accounts(tmp_path, Passwords(time_cost=2, memory_cost=1024), clock, clock)
    stronger.login("ana", GOOD, HERE)
    with sqlite3.connect(accounts.path) as database:
        (kept,) = database.execute("SELECT password FROM accounts WHERE name = 'ana'").fetchone()
    assert ",t=2," in kept
    stronger.close()


def test_a_set_up_link_makes_the_first_admin_once(tmp_path: Path, clock: Clock) -> None:
    accounts = Accounts(tmp_path / "new", Passwords(time_cost=1, memory_cost=1024), clock)
    stale = accounts.invite()
    token = accounts.invite()
    assert token
    assert stale
    with pytest.raises(LoginError):
        accounts.set_up(stale, "ana", GOOD)
    with pytest.raises(ConfigError):
        accounts.set_up(token, "ana", "short")
    assert accounts.set_up(token, "ana", GOOD).role is Role.ADMIN
    with pytest.raises(LoginError):
        accounts.set_up(token, "eve", GOOD)
    assert accounts.invite() is None
    accounts.close()


def test_a_set_up_link_expires(tmp_path: Path, clock: Clock) -> None:
    accounts = Accounts(tmp_path / "new", Passwords(time_cost=1, memory_cost=1024), clock)
    token = accounts.invite()
    clock.now += SETUP_SECONDS + 1
    with pytest.raises(LoginError):
        accounts.set_up(token or "", "ana", GOOD)
    accounts.close()


@given(st.text(max_size=50))
def test_any_token_is_nobody(tmp_path_factory: pytest.TempPathFactory, token: str) -> None:
    assert _shared(tmp_path_factory).session(token) is None


_kept: list[Accounts] = []


def _shared(factory: pytest.TempPathFactory) -> Accounts:
    if not _kept:
        _kept.append(Accounts(factory.mktemp("accounts"), Passwords(time_cost=1, memory_cost=1024)))
    return _kept[0]


@given(st.lists(st.floats(0, 3), max_size=40))
def test_no_window_of_time_holds_more_than_the_limit(gaps: list[float]) -> None:
    clock = Clock()
    window, allowed = Window(3, 5.0, clock), []
    for gap in gaps:
        clock.now += gap
        wait = window.attempt("x")
        if wait == 0:
            allowed.append(clock.now)
        else:
            assert 0 < wait <= 5.0
    for i, begin in enumerate(allowed):
        assert sum(begin <= time < begin + 5.0 for time in allowed[i:]) <= 3


def test_a_window_forgets_the_oldest_keys_only() -> None:
    window = Window(1, 1e9, Clock())
    for i in range(30_000):
        window.attempt(str(i))
    assert len(window._times) == 20_000
    assert window.attempt("29999") > 0
    assert window.attempt("0") == 0


def test_a_bucket_lets_through_its_rate() -> None:
    clock = Clock()
    bucket = Bucket(10.0, 5, clock)
    assert sum(bucket.take() for _ in range(20)) == 5
    clock.now += 1.0
    assert sum(bucket.take() for _ in range(20)) == 5
    clock.now += 0.25
    assert sum(bucket.take() for _ in range(20)) == 2


@pytest.mark.parametrize(
    ("address", "place"),
    [("192.0.2.1", "192.0.2.1"), ("::ffff:192.0.2.1", "192.0.2.1"), ("2001:db8::1:2", "2001:db8::/64"),
     ("2001:db8::ffff", "2001:db8::/64"), ("fe80::1%eth0", "fe80::/64"), ("testclient", "testclient")],
)  # fmt: skip
def test_one_household_is_one_place(address: str, place: str) -> None:
    assert network_of(address) == place


@pytest.mark.parametrize(
    ("host", "mine"),
    [("127.0.0.1", True), ("127.8.8.8", True), ("::1", True), ("[::1]", True), ("localhost", True), ("::ffff:127.0.0.1", True),
     ("0.0.0.0", False), ("::", False), ("192.0.2.1", False), ("localhost.evil.example", False), ("", False)],
)  # fmt: skip
def test_what_is_this_machine_only(host: str, mine: bool) -> None:
    assert is_loopback(host) == mine
