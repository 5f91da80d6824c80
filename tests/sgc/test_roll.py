"""The roll that routers keep of who is present, and how nodes ask it: nobody is missed, nobody stays who has left."""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

zenoh = pytest.importorskip("zenoh", reason="needs the extra sgc")

from sgc.fleets import Fleet, eventually, free_port, topic  # noqa: E402

from tutelage.sgc import lanes, roll  # noqa: E402
from tutelage.sgc.home import Home  # noqa: E402
from tutelage.sgc.names import Name  # noqa: E402
from tutelage.sgc.roll import Roll, read  # noqa: E402
from tutelage.sgc.router import Router, RouterConfig  # noqa: E402
from tutelage.sgc.transport.config import Endpoint, Identity, NetworkConfig, Timers, zenoh_config, zenoh_settings  # noqa: E402
from tutelage.sgc.transport.watch import Watch  # noqa: E402
from tutelage.sgc.transport.zenoh import ZenohTransport  # noqa: E402

NAME, OTHER = Name(b"n" * 32), Name(b"o" * 32)
AB, CD = "ab" * 16, "cd" * 16


class Query:
    """What Zenoh hands to a router."""

    def __init__(self, key: str, payload: bytes | None = None) -> None:
        self.key_expr, self.payload = key, payload
        self.answers: list[frozenset[str] | None] = []
        self.dropped = threading.Event()
        self.fails = False

    def reply(self, key: str, answer: bytes) -> None:
        assert not self.dropped.is_set()
        if self.fails:
            raise zenoh.ZError("the session is closed")
        assert key == self.key_expr
        self.answers.append(read(answer))

    def drop(self) -> None:
        self.dropped.set()


class Fed(Roll):
    """A roll that a test tells who comes and goes."""

    def __init__(self, **limits: Any) -> None:
        self.feed: deque[tuple[str, bool]] = deque()
        super().__init__(self._fed, **limits)

    def _fed(self) -> Iterator[tuple[str, bool]]:
        while self.feed:
            yield self.feed.popleft()

    def changed(self, key: str, present: bool) -> None:
        self.feed.append((key, present))


def here(who: str, name: Name = NAME) -> str:
    return lanes.key(name, lanes.HERE, who)


@pytest.fixture
def kept() -> Iterator[Callable[..., Fed]]:
    """Makes rolls."""
    made: list[Fed] = []

    def make(**limits: Any) -> Fed:
        made.append(Fed(**limits))
        return made[-1]

    yield make
    for each in made:
        each.close()


def ask(of: Roll, key: str = "", payload: bytes | None = None) -> Query:
    query = Query(key or here("*"), payload)
    of.asked(query)
    return query


# -- a router's ------------------------------------------------------------------------------------------------------------


def test_a_question_is_answered_at_once_even_if_nobody_is_there(kept) -> None:
    one = kept()
    assert ask(one).answers == [frozenset()]
    one.changed(here(AB), True)
    one.changed(here(CD, OTHER), True)
    assert ask(one).answers == [{AB}]
    one.changed(here(AB), False)
    assert ask(one).answers == [frozenset()]
    assert len(one) == 1


def test_who_comes_or_goes_after_an_answer_is_in_the_next_one(kept) -> None:
    one = kept(hold=60.0)
    query, other = ask(one), ask(one, here("*", OTHER))
    one.changed(here(AB), True)
    eventually(lambda: query.answers == [set(), {AB}])
    one.changed(here(AB), True)  # no news
    one.changed(here(CD), False)
    time.sleep(3 * roll.PERIOD)
    one.changed(here(CD), True)
    eventually(lambda: query.answers == [set(), {AB}, {AB, CD}])
    one.changed(here(AB), False)
    eventually(lambda: query.answers == [set(), {AB}, {AB, CD}, {CD}])
    assert other.answers == [set()]
    one.close()
    assert query.dropped.is_set()
    assert other.dropped.is_set()
    late = ask(one)
    assert late.dropped.is_set()
    assert late.answers == []


def test_a_question_is_let_go_after_a_while(kept) -> None:
    one = kept(hold=0.05)
    query = ask(one)
    assert query.dropped.wait(5.0)
    one.changed(here(AB), True)
    time.sleep(0.1)
    assert query.answers == [set()]


def test_of_many_questions_the_oldest_is_let_go(kept) -> None:
    one = kept(hold=60.0, held=3)
    asked = [ask(one) for _ in range(5)]
    assert [query.dropped.is_set() for query in asked] == [True, True, False, False, False]
    one.changed(here(AB), True)
    eventually(lambda: [query.answers[1:] for query in asked] == [[], [], [{AB}], [{AB}], [{AB}]])


@pytest.mark.parametrize(
    "key",
    [
        "*/*/*/here/*",
        f"**/here/{AB}",
        "**",
        here("*").replace("6e/", "*/", 1),
        here("**"),
        here(AB),
        lanes.key(NAME, lanes.STREAM),
        here("*").upper(),
        here("*") + "/x",
        "here/*",
    ],
)
def test_names_cannot_be_searched_for(kept, key: str) -> None:
    one = kept()
    one.changed(here(AB), True)
    query = ask(one, key)
    assert query.answers == []
    assert query.dropped.is_set()


def test_a_question_with_a_payload_is_none(kept) -> None:
    query = ask(kept(), payload=bytes(1 << 20))
    assert query.answers == []
    assert query.dropped.is_set()


def test_an_asker_who_has_gone_harms_nobody(kept) -> None:
    one = kept(hold=60.0)
    gone, query = ask(one), ask(one)
    gone.fails = True
    one.changed(here(AB), True)
    eventually(lambda: query.answers == [set(), {AB}])
    first = Query(here("*"))
    first.fails = True
    one.asked(first)
    assert first.dropped.is_set()


@pytest.mark.parametrize("token", [f"aa/here/{AB}", here("ab"), here("x" * 32), here(AB) + "/x", "", "here"])
def test_other_tokens_are_not_kept(kept, token: str) -> None:
    one = kept()
    one.changed(token, True)
    one.changed(token, False)
    assert len(one) == 0


def test_a_roll_that_is_full_answers_nothing_rather_than_half(kept) -> None:
    one = kept(known=2)
    for k in range(3):
        one.changed(here(f"{k:032x}"), True)
    assert ask(one).dropped.is_set()
    assert ask(one, here("*", OTHER)).answers == []
    assert len(one) == 0


def test_a_name_with_too_many_is_not_answered_for(kept, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roll, "MOST", 2)
    one = kept()
    for k in range(3):
        one.changed(here(f"{k:032x}"), True)
    assert ask(one).answers == []
    assert ask(one, here("*", OTHER)).answers == [set()]


@given(st.binary(max_size=100))
def test_an_answer_is_pseudonyms_or_none(answer: bytes) -> None:
    there = read(answer)
    assert (there is None) == (len(answer) % 16 != 0)
    assert all(len(who) == 32 and set(who) <= set("0123456789abcdef") for who in there or ())


def test_an_answer_is_bounded() -> None:
    assert read(bytes(16 * roll.MOST)) is not None
    assert read(bytes(16 * (roll.MOST + 1))) is None


# -- a node's --------------------------------------------------------------------------------------------------------------

WHO = ("00" * 16, "11" * 16, "22" * 16)


class Asked:
    """A watch on a session whose router says what a test likes."""

    def __init__(self) -> None:
        self.present: set[str] = set()
        self.told: list[tuple[str, bool]] = []
        self.later: list[Callable[[], None]] = []
        self.subscriptions: list[bool] = []
        session = SimpleNamespace(liveliness=lambda: SimpleNamespace(declare_subscriber=self._subscribe), get=self._get)
        self.watch = Watch(zenoh, session, here("*"), self._changed, self.later.append)

    def _subscribe(self, key: str, handler: Any, history: bool) -> Any:
        self.hear = handler.callback
        self.subscriptions.append(history)
        return SimpleNamespace(undeclare=lambda: None)

    def _get(self, key: str, handler: Any, **options: Any) -> None:
        self.reply, self.final = handler.callback, handler.drop

    def _changed(self, key: str, present: bool) -> None:
        who = key.rpartition("/")[2]
        assert key == here(who)
        self.told.append((who, present))
        (self.present.add if present else self.present.discard)(who)

    def heard(self, who: str, present: bool) -> None:
        kind = zenoh.SampleKind.PUT if present else zenoh.SampleKind.DELETE
        self.hear(SimpleNamespace(key_expr=here(who), kind=kind))

    def answer(self, payload: bytes) -> None:
        self.reply(SimpleNamespace(ok=SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload))))


CHANGES = st.tuples(st.sampled_from(WHO), st.booleans())
ANSWERS = st.frozensets(st.sampled_from(WHO))


@given(st.lists(CHANGES | ANSWERS, max_size=12), st.lists(CHANGES, max_size=5))
def test_the_last_word_of_the_subscription_counts_and_else_the_last_answer(asking: list[Any], after: list[Any]) -> None:
    node = Asked()
    said: dict[str, bool] = {}
    last: frozenset[str] = frozenset()
    for event in asking:
        if isinstance(event, frozenset):
            last = event
            node.answer(b"".join(map(bytes.fromhex, event)))
        else:
            said[event[0]] = event[1]
            node.heard(*event)
        assert node.present == {who for who in WHO if said.get(who, who in last)}
    node.final()
    for event in after:
        said[event[0]] = event[1]
        node.heard(*event)
    assert node.present == {who for who in WHO if said.get(who, who in last)}
    assert len(node.later) == (not any(isinstance(event, frozenset) for event in asking))
    node.watch.cut_off()  # Zenoh reports those whom it knows as gone; it never heard of the others
    assert node.present == {who for who in WHO if said.get(who)}


@given(st.lists(st.binary(max_size=70), max_size=8))
def test_a_hostile_router_may_answer_anything(answers: list[bytes]) -> None:
    node = Asked()
    for answer in answers:
        node.answer(answer)
    node.reply(SimpleNamespace(ok=None))
    node.heard(WHO[0], True)
    assert WHO[0] in node.present
    node.heard(WHO[0], False)
    assert WHO[0] not in node.present
    node.final()
    assert len(node.later) == all(len(answer) % 16 for answer in answers)


def test_a_router_without_a_roll_is_asked_through_zenoh() -> None:
    node = Asked()
    node.heard(AB, True)
    node.final()
    assert node.subscriptions == [False]
    node.later.pop()()
    assert node.subscriptions == [False, True]
    node.heard(AB, False)
    assert node.present == set()


def test_a_listener_that_fails_hears_of_the_next_change() -> None:
    node = Asked()
    node.watch._on_change = lambda key, present: node._changed(key, present) or 1 // 0
    node.answer(bytes.fromhex(AB + CD))
    node.heard(AB, False)
    assert node.present == {CD}


def test_a_watch_that_has_ended_tells_nothing_and_asks_no_more() -> None:
    node = Asked()
    node.watch.undeclare()
    node.answer(bytes.fromhex(AB))
    node.heard(AB, True)
    node.final()
    assert node.told == []
    assert node.later == []


# -- both ------------------------------------------------------------------------------------------------------------------

POLICY = topic("log", ["arm"], ["server"]) + topic("camera", ["arm"], ["server"])


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, POLICY, ("arm", "server", "thief"), ("router-1", "router-2"))


def address() -> str:
    return f"tls/127.0.0.1:{free_port()}"


def transport(home: Home, *routers: str) -> ZenohTransport:
    identity = Identity(home.root_file, home.leaf_file, home.key_file)
    return ZenohTransport(NetworkConfig(tuple(map(Endpoint.parse, routers))), identity)


class Seen(dict[str, bool]):
    """Who is present, by the word of a watch."""

    def __init__(self, on: ZenohTransport, name: Name) -> None:
        super().__init__()
        self.handle = on.watch(here("*", name), lambda key, present: self.__setitem__(key.rpartition("/")[2], present))

    @property
    def present(self) -> set[str]:
        return {who for who, present in self.items() if present}


def hears_of(router: Router, tokens: int) -> None:
    """Wait until the roll of a router holds so many."""
    eventually(lambda: router._roll is not None and len(router._roll) == tokens)


def names(fleet: Fleet) -> tuple[Name, Name]:
    return fleet["arm"].access.entry("log").name, fleet["arm"].access.entry("camera").name


def test_presence_through_a_router(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    where, (log, camera), arm = address(), names(fleet), fleet["arm"].pseudonym
    fallen: list[Watch] = []
    monkeypatch.setattr(Watch, "_fall_back", fallen.append)
    with (
        Router(fleet["router-1"], RouterConfig.of([where])) as router,
        transport(fleet["arm"], where) as one,
        transport(fleet["server"], where) as other,
    ):
        assert router._roll is not None
        token = one.announce(here(arm, log))
        eventually(lambda: len(router._roll) == 1)
        there, empty = Seen(other, log), Seen(other, camera)
        eventually(lambda: there.present == {arm})
        assert empty == {}
        token.close()
        eventually(lambda: there == {arm: False})
        with one.announce(here(arm, log)), one.announce(here(arm, camera)):
            eventually(lambda: there.present == empty.present == {arm})
            empty.handle.close()
            time.sleep(0.1)
        eventually(lambda: there == {arm: False})
        assert empty == {arm: True}  # it was closed before
        time.sleep(2 * roll.HOLD)
        assert fallen == []


def test_who_dies_is_gone(fleet: Fleet) -> None:
    where, (log, _), arm = address(), names(fleet), fleet["arm"].pseudonym
    with Router(fleet["router-1"], RouterConfig.of([where])) as router, transport(fleet["server"], where) as other:
        with transport(fleet["arm"], where) as one:
            one.announce(here(arm, log))
            hears_of(router, 1)
            seen = Seen(other, log)
            eventually(lambda: seen.present == {arm})
        eventually(lambda: seen == {arm: False})


def test_a_mesh_knows_who_is_at_another_router(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, (log, camera), arm = address(), address(), names(fleet), fleet["arm"].pseudonym
    asked: list[Roll] = []
    answer = Roll.asked
    monkeypatch.setattr(Roll, "asked", lambda roll, query: (asked.append(roll), answer(roll, query))[1])
    with (
        Router(fleet["router-1"], RouterConfig.of([first])),
        Router(fleet["router-2"], RouterConfig.of([second], [first])) as near,
        transport(fleet["arm"], first) as one,
        transport(fleet["server"], second) as other,
    ):
        with one.announce(here(arm, log)):
            eventually(lambda: near._roll is not None and len(near._roll) == 1)
            seen, later = Seen(other, log), Seen(other, camera)
            eventually(lambda: seen.present == {arm})
            with one.announce(here(arm, camera)):
                eventually(lambda: later.present == {arm})
        eventually(lambda: seen.present == later.present == set())
        assert set(asked) == {near._roll}


def test_a_stranger_learns_nothing_from_the_roll(fleet: Fleet) -> None:
    where, (log, _), arm = address(), names(fleet), fleet["arm"].pseudonym
    with (
        Router(fleet["router-1"], RouterConfig.of([where])) as router,
        transport(fleet["arm"], where) as one,
        transport(fleet["thief"], where) as thief,
        transport(fleet["server"], where) as member,
    ):
        one.announce(here(arm, log))
        hears_of(router, 1)
        for pattern in (here("*", log), "*/*/*/here/*", *roll.EVERYBODY[:2], "**", here("**", log), here(arm, log)):
            for asker in (thief, member):
                replies = asker._session.get(pattern, timeout=0.5)
                found = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
                assert found == ([bytes.fromhex(arm)] if (asker, pattern) == (member, here("*", log)) else [])
        stolen = Seen(thief, log)
        time.sleep(0.5)
        assert stolen == {}


def test_who_left_while_the_router_was_away_is_gone(fleet: Fleet) -> None:
    where, (log, camera), arm = address(), names(fleet), fleet["arm"].pseudonym
    with transport(fleet["server"], where) as other:
        router = Router(fleet["router-1"], RouterConfig.of([where]))
        with router, transport(fleet["arm"], where) as one:
            eventually(lambda: other.connected)
            one.announce(here(arm, log))
            one.announce(here(arm, camera))
            hears_of(router, 2)
            seen, stays = Seen(other, log), Seen(other, camera)
            eventually(lambda: seen.present == stays.present == {arm})
            router._end()
            eventually(lambda: not other.connected)
        eventually(lambda: seen == stays == {arm: False})
        with Router(fleet["router-1"], RouterConfig.of([where])), transport(fleet["arm"], where) as one:
            one.announce(here(arm, camera))
            eventually(lambda: stays.present == {arm})
            assert seen.present == set()
            one.announce(here(arm, log))
            eventually(lambda: seen.present == {arm})


def test_a_watch_survives_a_renewed_certificate(fleet: Fleet) -> None:
    where, (log, camera), arm = address(), names(fleet), fleet["arm"].pseudonym
    with (
        Router(fleet["router-1"], RouterConfig.of([where])) as router,
        transport(fleet["arm"], where) as one,
        transport(fleet["server"], where) as other,
    ):
        stays, leaves = one.announce(here(arm, log)), one.announce(here(arm, camera))
        hears_of(router, 2)
        seen, gone = Seen(other, log), Seen(other, camera)
        eventually(lambda: seen.present == gone.present == {arm})
        other.renew()
        time.sleep(1.0)
        assert seen.present == gone.present == {arm}
        leaves.close()
        eventually(lambda: gone.present == set())
        assert seen.present == {arm}
        stays.close()
        eventually(lambda: seen.present == set())


@pytest.mark.parametrize("answer", [b"", b"x", bytes(16), bytes(1 << 20)], ids=["nobody", "junk", "invented", "huge"])
def test_a_router_that_answers_wrongly_hides_no_change(answer: bytes) -> None:
    port = free_port()
    settings = zenoh_settings("router", Timers(), None)
    settings["listen"] = {"endpoints": [f"tcp/127.0.0.1:{port}"]}
    config = NetworkConfig((Endpoint("tcp", "127.0.0.1", port),))

    def asked(query: Any) -> None:
        with query:
            for _ in range(3):
                query.reply(query.key_expr, answer)

    with (
        zenoh.open(zenoh_config(settings)) as router,
        ZenohTransport(config, None) as one,
        ZenohTransport(config, None) as other,
    ):
        router.declare_queryable("**", asked)
        there = Seen(other, NAME)
        time.sleep(0.1)
        with one.announce(here(AB)):
            eventually(lambda: AB in there.present)
        eventually(lambda: AB not in there.present)


def test_presence_of_whoever_comes_and_goes_while_many_ask(fleet: Fleet) -> None:
    """Arrivals and departures race with questions; in the end every watch knows the truth."""
    where, (log, _), arm = address(), names(fleet), fleet["arm"].pseudonym
    with (
        Router(fleet["router-1"], RouterConfig.of([where])),
        transport(fleet["arm"], where) as one,
        transport(fleet["server"], where) as other,
    ):
        for _ in range(25):
            token = one.announce(here(arm, log))
            time.sleep(secrets.randbelow(4) / 1000)
            came = Seen(other, log)
            eventually(lambda came=came: came.present == {arm})
            token.close()
            time.sleep(secrets.randbelow(4) / 1000)
            gone = Seen(other, log)
            time.sleep(0.02)
            eventually(lambda gone=gone: gone.present == set())
            came.handle.close()
            gone.handle.close()
