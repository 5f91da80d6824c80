"""What every transport promises: the one in this process and the one over Zenoh."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from sgc.fleets import eventually, free_port

from tutelage.errors import ConfigError
from tutelage.sgc.transport.base import NoReply, Transport, check_key, matches
from tutelage.sgc.transport.config import Endpoint, NetworkConfig, Timers, zenoh_config, zenoh_settings
from tutelage.sgc.transport.memory import MemoryTransport, Network

Pair = tuple[Transport, Transport]


@pytest.fixture(params=["memory", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    """Two ends of one network."""
    if request.param == "memory":
        network = Network()
        yield MemoryTransport(network), MemoryTransport(network)
        return
    zenoh = pytest.importorskip("zenoh", reason="needs the extra sgc")
    from tutelage.sgc.transport.zenoh import ZenohTransport

    settings = zenoh_settings("router", Timers(), None)
    port = free_port()
    settings["listen"] = {"endpoints": [f"tcp/127.0.0.1:{port}"]}
    with zenoh.open(zenoh_config(settings)):
        config = NetworkConfig((Endpoint("tcp", "127.0.0.1", port),))
        with ZenohTransport(config, None) as one, ZenohTransport(config, None) as other:
            yield one, other


def until_heard(publish: Callable[[], None], got: list[bytes]) -> None:
    """A subscription takes a moment to be known to the router."""
    eventually(lambda: publish() or got, every=0.02)
    time.sleep(0.1)
    got.clear()


def test_a_packet_reaches_all_subscribers_and_no_other_key(pair: Pair) -> None:
    one, other = pair
    exact, any_lane, elsewhere = [], [], []
    other.subscribe("75e0/stream", exact.append)
    other.subscribe("75e0/*", any_lane.append)
    other.subscribe("75e1/stream", elsewhere.append)
    until_heard(lambda: one.publish("75e0/stream", b"?"), exact)
    any_lane.clear()
    one.publish("75e0/stream", b"1")
    one.publish("75e0/stream", bytearray(b"2"), reliable=False)
    one.publish("75e0/hello", b"3")
    eventually(lambda: exact == [b"1", b"2"] and any_lane == [b"1", b"2", b"3"])
    assert elsewhere == []


def test_a_closed_subscription_hears_nothing(pair: Pair) -> None:
    one, other = pair
    got, still = [], []
    with other.subscribe("75e0/stream", got.append) as handle:
        other.subscribe("75e0/stream", still.append)
        until_heard(lambda: one.publish("75e0/stream", b"?"), got)
    handle.close()  # twice is fine
    still.clear()
    one.publish("75e0/stream", b"1")
    eventually(lambda: still == [b"1"])
    assert got == []


def test_14_mb_pass_in_one_packet(pair: Pair) -> None:
    one, other = pair
    got: list[bytes] = []
    other.subscribe("75e0/stream", got.append)
    until_heard(lambda: one.publish("75e0/stream", b"?"), got)
    payload = bytes(range(256)) * (14 << 12)
    one.publish("75e0/stream", payload)
    eventually(lambda: got == [payload])


def test_a_request_is_answered(pair: Pair) -> None:
    one, other = pair
    with other.serve("75e0/keys", lambda asked: b"key of " + asked):
        eventually(lambda: ask(one, "75e0/keys", b"arm") == b"key of arm")
        assert ask(one, "75e0/grants", b"arm") is None
    assert ask(one, "75e0/keys", b"arm") is None


def ask(transport: Transport, key: str, payload: bytes) -> bytes | None:
    try:
        return transport.request(key, payload, 1.0)
    except NoReply:
        return None


def test_a_server_that_gives_no_answer_or_fails_is_as_if_absent(pair: Pair) -> None:
    one, other = pair
    handled = threading.Event()
    with other.serve("75e0/keys", lambda asked: handled.set()):
        eventually(lambda: ask(one, "75e0/keys", b"") is None and handled.is_set())


def test_slow_answers_do_not_hold_up_others(pair: Pair) -> None:
    one, other = pair
    gate = threading.Event()
    other.serve("75e0/call", lambda asked: b"slow" if gate.wait(5.0) else None, slow=True)
    other.serve("75e0/keys", lambda asked: b"quick")
    eventually(lambda: ask(one, "75e0/keys", b"") == b"quick")
    answers: list[bytes | None] = []
    threads = [threading.Thread(target=lambda: answers.append(ask(one, "75e0/call", b""))) for _ in range(12)]
    for thread in threads:
        thread.start()
    time.sleep(0.1)
    assert ask(one, "75e0/keys", b"") == b"quick"
    gate.set()
    for thread in threads:
        thread.join()
    assert answers == [b"slow"] * 12


def test_presence_comes_and_goes(pair: Pair) -> None:
    one, other = pair
    seen: dict[str, bool] = {}
    with one.announce("75e0/here/ab"):
        time.sleep(0.1)
        other.watch("75e0/here/*", seen.__setitem__)  # those that are there already, too
        eventually(lambda: seen == {"75e0/here/ab": True})
        with one.announce("75e0/here/cd"), one.announce("75e1/here/ef"):
            eventually(lambda: seen == {"75e0/here/ab": True, "75e0/here/cd": True})
        eventually(lambda: seen == {"75e0/here/ab": True, "75e0/here/cd": False})
    eventually(lambda: not any(seen.values()))


def test_a_transport_without_network_loses_packets_and_says_so() -> None:
    pytest.importorskip("zenoh", reason="needs the extra sgc")
    from tutelage.sgc.transport.zenoh import ZenohTransport

    with ZenohTransport(NetworkConfig((Endpoint("tcp", "127.0.0.1", free_port()),)), None) as alone:
        assert not alone.connected
        alone.publish("75e0/stream", b"lost")
        with pytest.raises(NoReply, match="nobody answered within"):
            alone.request("75e0/keys", b"", 0.1)


# -- keys ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["", "a//b", "/a", "a/", "a b", "a/**", "a$*", "ä", "a\n"])
def test_impossible_keys_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match="a key is"):
        check_key(key)
    with pytest.raises(ConfigError, match="a key is"):
        check_key(key, wildcard=True)


def test_a_wildcard_stands_for_one_chunk() -> None:
    assert check_key("a/*/c", wildcard=True) == "a/*/c"
    with pytest.raises(ConfigError):
        check_key("a/*/c")
    assert matches("a/*/c", "a/b/c")
    assert not matches("a/*", "a/b/c")
    assert not matches("a/b", "a/c")


# -- network.toml -----------------------------------------------------------------------------------------------------------


def test_the_file_says_where_the_routers_are(tmp_path) -> None:
    config = NetworkConfig(
        tuple(map(Endpoint.parse, ("quic/robots.example.org:7447", "wss/[::1]:443", "tls/10.0.0.5:7447"))), Timers(lease=3.0)
    )
    config.save(tmp_path)
    assert NetworkConfig.load(tmp_path) == config


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("version = 2\nrouters = ['tls/a:1']", "this program reads version 1, not 2"),
        ("routers = ['tls/a:1']", "this program reads version 1, not None"),
        ("version = 1", "routers must be a list with at least one address"),
        ("version = 1\nrouters = []", "routers must be a list with at least one address"),
        ("version = 1\nrouters = ['tcp/a:1']", "'tcp/a:1' is no address of a router; write it as protocol/host:port"),
        ("version = 1\nrouters = ['tls/a']", "'tls/a' is no address"),
        ("version = 1\nrouters = ['tls/a:99999']", "is no address"),
        ("version = 1\nrouters = [7]", "7 is no address"),
        ("version = 1\nrouters = ['tls/a:1']\nlease = 3", "unknown field 'lease'"),
        ("version = 1\nrouters = ['tls/a:1']\n[timers]\nleash = 3", "unknown timer 'leash'"),
        ("version = 1\nrouters = ['tls/a:1']\ntimers = 3", "unknown timer 'timers'"),
        ("version = 1\nrouters = ['tls/a:1']\n[timers]\nlease = -1", "timer lease must be between 0.01 and 3600 seconds"),
        ("version = 1\nrouters = ['tls/a:1']\n[timers]\nlease = 'x'", "timer lease must be between"),
        ("version = ", "cannot be read"),
    ],
)
def test_faults_of_the_file_are_named(tmp_path, text: str, says: str) -> None:
    (tmp_path / "network.toml").write_text(text)
    with pytest.raises(ConfigError) as fault:
        NetworkConfig.load(tmp_path)
    assert says in str(fault.value)
    assert str(tmp_path / "network.toml") in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_missing_file_is_explained(tmp_path) -> None:
    with pytest.raises(ConfigError, match="so where are the routers"):
        NetworkConfig.load(tmp_path)


def test_shared_memory_and_scouting_are_off() -> None:
    for mode in ("client", "router"):
        settings = zenoh_settings(mode, Timers(), None)
        assert settings["transport"]["shared_memory"]["enabled"] is False
        assert settings["scouting"]["multicast"]["enabled"] is False
        assert settings["scouting"]["gossip"]["enabled"] is False
        assert settings["transport"]["link"]["tls"]["enable_mtls"] is True
