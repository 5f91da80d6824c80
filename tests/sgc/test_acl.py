"""What a router is told to let pass."""

from __future__ import annotations

from typing import Any

from tutelage.sgc import lanes
from tutelage.sgc.access import Kind, Route
from tutelage.sgc.acl import access_control
from tutelage.sgc.names import Name

CAMERA, GRASP, CONTROL = Name(b"c" * 32), Name(b"g" * 32), Name(b"n" * 32)
ROUTES = (
    Route(CAMERA, Kind.STREAM, "arm", frozenset({"arm"}), frozenset({"server"})),
    Route(GRASP, Kind.SERVICE, "server", frozenset({"arm"}), frozenset({"server"})),
)
NODES = {"arm", "server", "other"}


def allowed(tree: dict[str, Any], who: str) -> set[tuple[str, str, str]]:
    """Flow, message and key of everything that a pseudonym may do."""
    rules = {rule["id"]: rule for rule in tree["rules"]}
    names = {subject["id"] for subject in tree["subjects"] if who in subject["cert_common_names"]}
    mine = [rules[name] for policy in tree["policies"] if names & set(policy["subjects"]) for name in policy["rules"]]
    assert all(rule["permission"] == "allow" for rule in mine)
    return {(f, m, k) for rule in mine for f in rule["flows"] for m in rule["messages"] for k in rule["key_exprs"]}


def test_everything_else_is_denied() -> None:
    tree = access_control(ROUTES, NODES, set(), CONTROL)
    assert tree["enabled"] is True
    assert tree["default_permission"] == "deny"
    assert allowed(tree, "stranger") == set()
    assert not any("**" in key for who in NODES for _, _, key in allowed(tree, who))


def test_a_stream_goes_one_way() -> None:
    tree = access_control(ROUTES, NODES, set(), CONTROL)
    stream = lanes.key(CAMERA, lanes.STREAM)
    assert ("ingress", "put", stream) in allowed(tree, "arm")
    assert ("egress", "put", stream) not in allowed(tree, "arm")
    assert ("egress", "put", stream) in allowed(tree, "server")
    assert ("ingress", "declare_subscriber", stream) in allowed(tree, "server")
    assert ("ingress", "put", stream) not in allowed(tree, "server")


def test_only_the_owner_answers_for_keys_and_only_servers_serve() -> None:
    tree = access_control(ROUTES, NODES, set(), CONTROL)
    keys, call = lanes.key(CAMERA, lanes.KEYS), lanes.key(GRASP, lanes.CALL)
    assert ("ingress", "declare_queryable", keys) in allowed(tree, "arm")
    assert ("ingress", "declare_queryable", keys) not in allowed(tree, "server")
    assert ("ingress", "query", keys) in allowed(tree, "server")
    assert ("ingress", "declare_queryable", call) in allowed(tree, "server")
    assert ("ingress", "declare_queryable", call) not in allowed(tree, "arm")


def test_a_node_without_topics_hears_only_notices_and_announces_only_itself() -> None:
    keys = {key for _, _, key in allowed(access_control(ROUTES, NODES, set(), CONTROL), "other")}
    assert keys == {lanes.key(CONTROL, lane) for lane in (lanes.DENY, lanes.RENEW, lanes.RULES)} | {
        "*/*/*/here/other",
        "*/*/*/echo/other",
    }


def test_nobody_announces_another() -> None:
    for who in NODES:
        tokens = {
            key
            for flow, message, key in allowed(access_control(ROUTES, NODES, set(), CONTROL), who)
            if (flow, message) == ("ingress", "liveliness_token")
        }
        assert tokens == {f"*/*/*/here/{who}"}


def test_members_of_a_topic_ask_for_its_presence_and_nobody_for_that_of_all() -> None:
    tree = access_control(ROUTES, NODES, set(), CONTROL)
    here = lanes.key(CAMERA, lanes.HERE, "*")
    for who in ("arm", "server"):
        mine = {(flow, message) for flow, message, key in allowed(tree, who) if key == here}
        assert {("ingress", "query"), ("egress", "reply")} <= mine
        assert not {("ingress", "declare_queryable"), ("ingress", "reply"), ("egress", "query")} & mine
    assert not any(
        key.startswith("*") or key == here
        for who in NODES - {"arm", "server"}
        for _, message, key in allowed(tree, who)
        if message in ("query", "liveliness_query", "declare_liveliness_subscriber")
        and not key.startswith(f"*/*/*/{lanes.ECHO}/")  # which is answered, never asked
    )


def test_routers_pass_on_anything_and_the_revoked_nothing() -> None:
    tree = access_control(ROUTES, NODES, {"router-2", "router-3"}, CONTROL, {"server", "router-3"})
    assert ("ingress", "put", "**") in allowed(tree, "router-2")
    assert allowed(tree, "router-3") == set()
    assert allowed(tree, "server") == set()
    assert allowed(tree, "arm")


def test_a_topic_whose_owner_has_no_certificate_is_served_by_nobody() -> None:
    route = Route(CAMERA, Kind.STREAM, "", frozenset({"arm"}), frozenset({"server"}))
    tree = access_control([route], NODES, set(), CONTROL)
    for who in NODES:
        assert ("ingress", "declare_queryable", lanes.key(CAMERA, lanes.KEYS)) not in allowed(tree, who)
