"""What a router lets pass: Zenoh's access control, made from the routes of the policy. Everything else is denied.

A router knows names and pseudonyms, no metadata and no keys. Its rules keep strangers and members apart on the network; that
they could not read or forge anything if the router let them is the business of sealing, and holds without any rule.

Rules count in both directions: what comes from a node (ingress) and what goes to it (egress). Without rules on egress, a
subscription that slips in through another router would be served. A wildcard such as "**" lies within no rule, so nobody can
listen to everything or ask for everybody's presence.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Set
from typing import Any

from tutelage.sgc import lanes
from tutelage.sgc.access import Kind, Route
from tutelage.sgc.names import Name

PUBLISH = (("ingress", "put"), ("egress", "declare_subscriber"))
SUBSCRIBE = (("ingress", "declare_subscriber"), ("egress", "put"))
ASK = (("ingress", "query"), ("egress", "reply"), ("egress", "declare_queryable"))
SERVE = (("ingress", "declare_queryable"), ("egress", "query"), ("ingress", "reply"))
ANNOUNCE = (("ingress", "liveliness_token"),)
WATCH = (
    ("ingress", "declare_liveliness_subscriber"),
    ("ingress", "liveliness_query"),
    ("ingress", "query"),  # of the router's roll
    ("egress", "liveliness_token"),
    ("egress", "reply"),
)
MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)

_Grants = dict[str, dict[tuple[str, str], list[str]]]  # pseudonym -> (flow, message) -> keys


def access_control(
    routes: Iterable[Route],
    members: Set[str],
    routers: Set[str],
    control: Name,
    denied: Set[str] = frozenset(),
    office: str = "",
) -> dict[str, Any]:
    """The tree that Zenoh's configuration calls `access_control`.

    members: pseudonyms of all nodes. routers: of the other routers, who may pass on anything. denied: revoked, of any kind.
    office: the node that renews certificates, "" if nobody does.
    """
    grants: _Grants = defaultdict(lambda: defaultdict(list))
    for route in routes:
        _of_route(grants, route)
    for who in members:
        _allow(grants, {who}, (*PUBLISH, *SUBSCRIBE), lanes.key(control, lanes.DENY))
        _allow(grants, {who}, ASK, lanes.key(control, lanes.RULES))  # the router itself answers
        _allow(grants, {who}, SERVE if who == office else ASK, lanes.key(control, lanes.RENEW))
    rules, subjects, policies = [], [], []
    for who in sorted(set(grants) - denied):
        allowed = grants[who]
        own = [f"*/*/*/{lanes.HERE}/{who}"], [f"*/*/*/{lanes.ECHO}/{who}"]  # under a name that only members know
        for grant, keys in zip((ANNOUNCE, SERVE), own, strict=True):
            for flow, message in grant:
                allowed[flow, message] += keys
        names = []
        for (flow, message), keys in sorted(allowed.items()):
            names.append(f"{who}-{flow}-{message}")
            rules.append(_rule(names[-1], [flow], [message], sorted(set(keys))))
        subjects.append({"id": who, "cert_common_names": [who]})
        policies.append({"rules": names, "subjects": [who]})
    trusted = sorted(routers - denied)
    if trusted:
        rules.append(_rule("routers", ["ingress", "egress"], list(MESSAGES), ["**"]))
        subjects.append({"id": "routers", "cert_common_names": trusted})
        policies.append({"rules": ["routers"], "subjects": ["routers"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(identifier: str, flows: list[str], messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": identifier, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}


def _of_route(grants: _Grants, route: Route) -> None:
    owner = {route.owner} - {""}
    everyone = route.send | route.receive | owner

    def key(lane: str, of: str = "") -> str:
        return lanes.key(route.name, lane, of)

    if route.kind == Kind.STREAM:
        for lane, sends, receives in (
            (lanes.STREAM, route.send, route.receive),
            (lanes.HELLO, route.receive, route.send),
            (lanes.OFFER, route.receive, route.send),
            (lanes.ANSWER, route.send, route.receive),
        ):
            _allow(grants, sends, PUBLISH, key(lane))
            _allow(grants, receives, SUBSCRIBE, key(lane))
        _allow(grants, route.receive, ASK, key(lanes.REPLAY, "*"))
        _allow(grants, route.send, SERVE, key(lanes.REPLAY, "*"))
    else:
        _allow(grants, route.send, ASK, key(lanes.CALL))
        _allow(grants, route.receive, SERVE, key(lanes.CALL))
    _allow(grants, everyone, ASK, key(lanes.KEYS))
    _allow(grants, owner, SERVE, key(lanes.KEYS))
    _allow(grants, owner, PUBLISH, key(lanes.GRANTS))
    _allow(grants, everyone, SUBSCRIBE, key(lanes.GRANTS))
    _allow(grants, everyone, WATCH, key(lanes.HERE, "*"))
    _allow(grants, everyone, ASK, key(lanes.ECHO, "*"))


def _allow(grants: _Grants, who: Iterable[str], grant: Iterable[tuple[str, str]], key: str) -> None:
    for pseudonym in who:
        for flow, message in grant:
            grants[pseudonym][flow, message].append(key)
