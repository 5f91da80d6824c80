"""Which topics and services a proxy carries: an explicit list (TOML), checked against the node's part of the policy.

version = 1
distribution = "jazzy"            # of ROS 2; which versions of the standard types are meant

[[topic]]
alias = "camera"                  # of the policy
direction = "out"                 # out: from here to the fleet; in: to here; both. Default: what is allowed
name = "/camera/image_raw"        # on this side; default: the interface of the policy
type = "sensor_msgs/msg/Image"    # default: the type of the policy
qos = "sensor_data"               # ROS 2: a profile, or a table of policies
domain = 0                        # ROS 2: the DDS domain
queue = 64                        # messages that wait each way; default: 64, on a lossy topic 1, the newest

[[service]]
alias = "grasp"
direction = "in"                  # out: the server is here; in: the clients are here
timeout = 5.0                     # seconds
through = "rclpy"                 # ROS 2: dds, the default, for rmw_cyclonedds; rclpy for every middleware, needs ROS 2 here

[[action]]                        # its parts: fold-send_goal, -cancel_goal, -get_result, -feedback, -status
alias = "fold"
name = "/fold"
type = "example_interfaces/action/Fibonacci"
through = "rclpy"                 # its services; its topics always go through DDS
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from tutelage.errors import ConfigError
from tutelage.sgc.access import Access, Delivery, Kind, Lane
from tutelage.sgc.proxies.ros_names import full_name, full_type
from tutelage.sgc.proxies.ros_qos import PROFILES, QosProfile
from tutelage.sgc.proxies.toml_table import Table

log = logging.getLogger(__name__)
MAX_DOMAIN = 232
"""The highest DDS domain for which there are UDP ports."""
MAX_QUEUE = 100_000
Through = Literal["dds", "rclpy"]


@dataclass(frozen=True)
class TopicRoute:
    """A topic that a proxy carries.

    Attributes:
        alias: in the policy.
        name, type: in ROS 2, fully qualified.
        outward: from here to the fleet.
        inward: from the fleet to here.
        qos, domain: of ROS 2.
        queue: messages that wait, each way.
    """

    alias: str
    name: str
    type: str
    outward: bool
    inward: bool
    qos: QosProfile = PROFILES["default"]
    domain: int = 0
    queue: int = 64


@dataclass(frozen=True)
class ServiceRoute:
    """A service that a proxy carries.

    Attributes:
        alias, name, type, qos, domain: see `TopicRoute`.
        outward: the server is here; otherwise the clients are.
        timeout: seconds after which a request is given up.
        through: dds: as rmw_cyclonedds has services; rclpy: as the middleware of the ROS 2 installed here has them.
    """

    alias: str
    name: str
    type: str
    outward: bool
    timeout: float = 5.0
    qos: QosProfile = PROFILES["services_default"]
    domain: int = 0
    through: Through = "dds"


@dataclass(frozen=True)
class Routes:
    """All that a proxy carries. `distribution` of ROS 2, "" if not given."""

    topics: tuple[TopicRoute, ...]
    services: tuple[ServiceRoute, ...]
    distribution: str = ""


def load_routes(path: Path, access: Access) -> Routes:
    """Read a file of routes.

    Raises:
        ConfigError: not TOML, an unknown or impossible setting; the message names file and topic.
        NotAllowed: the policy gives this node no part in a topic, or not in that direction.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not TOML: {error}") from None
    try:
        return parse_routes(content, access)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def parse_routes(content: Mapping[str, Any], access: Access) -> Routes:
    """See `load_routes`."""
    table = Table(dict(content), "the file")
    if table.take("version", int) != 1:
        raise ConfigError("version must be 1")
    distribution = table.take("distribution", str, "")
    topics = [_topic(Table(entry, "a topic"), access) for entry in table.tables("topic")]
    services = [_service(Table(entry, "a service"), access) for entry in table.tables("service")]
    for entry in table.tables("action"):
        more_topics, more_services = _action(Table(entry, "an action"), access)
        topics += more_topics
        services += more_services
    table.finish()
    if not topics and not services:
        raise ConfigError("nothing is listed; list what is to be carried under [[topic]], [[service]] or [[action]]")
    _refuse_twice([f"topic {t.name} of domain {t.domain} with alias {t.alias}" for t in topics])
    _refuse_twice([f"service {s.name} of domain {s.domain}" for s in services])
    return Routes(tuple(topics), tuple(services), distribution)


def all_routes(access: Access) -> Routes:
    """Everything that the policy gives this node a part in, under the policy's own names.

    Topics whose interface or type ROS 2 does not know are left out, with a warning; a file of routes can name them.
    """
    topics, services = [], []
    for alias, entry in access.topics.items():
        try:
            if entry.rule.kind is Kind.STREAM:
                topics.append(_topic(Table({"alias": alias}, "a topic"), access))
            else:
                direction = "out" if entry.rule.may_receive(access.node, Lane.REQUEST) else "in"
                services.append(_service(Table({"alias": alias, "direction": direction}, "a service"), access))
        except ConfigError as error:
            log.warning("left out: %s", error)
    return Routes(tuple(topics), tuple(services))


def _topic(table: Table, access: Access) -> TopicRoute:
    alias = table.take("alias", str)
    rule = access.entry(alias).rule
    if rule.kind is not Kind.STREAM:
        raise ConfigError(f"{table.what} is a service in the policy; list it under [[service]]")
    may = {"out": rule.may_send(access.node), "in": rule.may_receive(access.node)}
    direction = table.take("direction", str, "both" if all(may.values()) else "out" if may["out"] else "in")
    if direction not in ("out", "in", "both"):
        raise ConfigError(f"{table.what}: direction is out, in or both, not {direction!r}")
    for way in ("out", "in") if direction == "both" else (direction,):
        if not may[way]:
            verb = "publish" if way == "out" else "subscribe to"
            raise ConfigError(
                f"{table.what}: direction {direction}, but the policy does not let {access.node} {verb} it; "
                f"change the direction, or the policy of {access.fleet}"
            )
    qos = table.qos("default")
    if qos.durability == "transient_local" and rule.delivery is not Delivery.RELIABLE:
        raise ConfigError(f"{table.what}: a transient_local topic must be reliable in the policy, not {rule.delivery}")
    route = TopicRoute(
        alias=alias,
        name=_name(table, rule.topic.interface),
        type=_type(table, rule.topic.type, "msg"),
        outward=direction in ("out", "both"),
        inward=direction in ("in", "both"),
        qos=qos,
        domain=table.number("domain", 0, 0, MAX_DOMAIN),
        queue=table.number("queue", 64 if rule.delivery is Delivery.RELIABLE else 1, 1, MAX_QUEUE),
    )
    table.finish()
    return route


def _service(table: Table, access: Access) -> ServiceRoute:
    alias = table.take("alias", str)
    rule = access.entry(alias).rule
    if rule.kind is not Kind.SERVICE:
        raise ConfigError(f"{table.what} is no service in the policy; list it under [[topic]]")
    direction = table.take("direction", str)
    if direction not in ("out", "in"):
        raise ConfigError(f"{table.what}: direction is out (the server is here) or in (clients are here), not {direction!r}")
    allowed = rule.may_receive(access.node, Lane.REQUEST) if direction == "out" else rule.may_send(access.node, Lane.REQUEST)
    if not allowed:
        verb = "serve" if direction == "out" else "request"
        raise ConfigError(f"{table.what}: the policy of {access.fleet} does not let {access.node} {verb} it")
    route = ServiceRoute(
        alias=alias,
        name=_name(table, rule.topic.interface),
        type=_type(table, rule.topic.type, "srv"),
        outward=direction == "out",
        timeout=table.number("timeout", 5.0, 0.01, 86_400, (int, float)),
        qos=table.qos("services_default"),
        domain=table.number("domain", 0, 0, MAX_DOMAIN),
        through=_through(table),
    )
    table.finish()
    return route


def _through(table: Table) -> Any:
    through = table.take("through", str, "dds")
    if through not in get_args(Through):
        raise ConfigError(f"{table.what}: through is {' or '.join(get_args(Through))}, not {through!r}")
    return through


def _name(table: Table, default: str) -> str:
    try:
        return full_name(table.take("name", str, default))
    except ConfigError as error:
        raise ConfigError(f"{table.what}: {error}; give it a name in the file of routes") from None


def _type(table: Table, default: str, kind: str) -> str:
    given = table.take("type", str, default)
    try:
        return full_type(given, "action" if "/action/" in given else kind)  # the parts of an action are of its own kind
    except ConfigError as error:
        raise ConfigError(f"{table.what}: {error}") from None


def _action(table: Table, access: Access) -> tuple[list[TopicRoute], list[ServiceRoute]]:
    """The three services and two topics that a ROS 2 action is made of."""
    alias = table.take("alias", str)
    name = full_name(table.take("name", str))
    action = full_type(table.take("type", str), "action")
    direction = table.take("direction", str)
    domain = table.take("domain", int, 0)
    timeout = table.take("timeout", (int, float), 3600.0)
    through = _through(table)
    table.finish()
    common = {"direction": direction, "domain": domain}

    def part(suffix: str, kind: str, **settings: Any) -> Table:
        given = {"alias": f"{alias}-{suffix}", "name": f"{name}/_action/{suffix}", **common, **settings}
        return Table(given, kind)

    def service(suffix: str, **settings: Any) -> ServiceRoute:
        return _service(part(suffix, "a service", through=through, **settings), access)

    services = [
        service("send_goal", type=f"{action}_SendGoal"),
        service("cancel_goal", type="action_msgs/srv/CancelGoal"),
        service("get_result", type=f"{action}_GetResult", timeout=timeout),
    ]
    topics = [
        _topic(part("feedback", "a topic", type=f"{action}_FeedbackMessage"), access),
        _topic(part("status", "a topic", type="action_msgs/msg/GoalStatusArray", qos="action_status"), access),
    ]
    return topics, services


def _refuse_twice(keys: list[str]) -> None:
    for key in keys:
        if keys.count(key) > 1:
            raise ConfigError(f"{key} is listed twice")
