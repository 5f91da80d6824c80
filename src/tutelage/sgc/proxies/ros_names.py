"""How ROS 2 names appear in DDS: prefixes of topics, mangled names of types.

/chatter, std_msgs/msg/String      topic rt/chatter, type std_msgs::msg::dds_::String_
/add, pkg/srv/AddTwoInts           topics rq/addRequest and rr/addReply, types pkg::srv::dds_::AddTwoInts_Request_, ...
/fold, pkg/action/Fold             three services and two topics under /fold/_action
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from tutelage.errors import ConfigError

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(?:(msg|srv|action)/)?([A-Za-z][A-Za-z0-9_]*)")
MAX_NAME = 248
"""DDS names of topics have at most 255 characters in some vendors; a prefix and a suffix take some of them."""


def full_name(name: str) -> str:
    """A fully qualified ROS name, with or without the leading slash that clients tend to forget.

    Raises:
        ConfigError: not a name that ROS 2 accepts.
    """
    full = name if name.startswith("/") else f"/{name}"
    if len(full) > MAX_NAME or not _NAME.fullmatch(full) or "__" in full:
        raise ConfigError(f"{name[:60]!r} is not a ROS 2 name; names are like /arm/joint_states")
    return full


def full_type(type_name: str, kind: str = "msg") -> str:
    """The name of a type in three parts; "std_msgs/String", as ROS 1 and many web pages write it, is completed.

    kind: msg, srv or action: what is expected here.

    Raises:
        ConfigError: not a name of a type, or of another kind.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None or len(type_name) > MAX_NAME:
        raise ConfigError(f"{type_name[:60]!r} is not a ROS 2 type; types are like std_msgs/{kind}/{'String'}")
    package, given, name = match.groups()
    if (given or kind) != kind:
        raise ConfigError(f"{type_name} is of kind {given}, but a {kind} is needed here")
    return f"{package}/{kind}/{name}"


def dds_type(type_name: str, suffix: str = "") -> str:
    """sensor_msgs/msg/Image -> sensor_msgs::msg::dds_::Image_; `suffix`, such as "_Request", before the last _."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}{suffix}_"


@dataclass(frozen=True)
class Channel:
    """A DDS topic: its name and the name of its type, and the ROS type that the content has."""

    topic: str
    dds_type: str
    ros_type: str


def topic_channel(name: str, type_name: str) -> Channel:
    """The DDS topic of a ROS topic."""
    return Channel(f"rt{name}", dds_type(type_name), type_name)


def service_channels(name: str, type_name: str) -> tuple[Channel, Channel]:
    """The DDS topics of a ROS service: requests, replies. Their content starts with a header, see `services`."""
    return (
        Channel(f"rq{name}Request", dds_type(type_name, "_Request"), f"{type_name}_Request"),
        Channel(f"rr{name}Reply", dds_type(type_name, "_Response"), f"{type_name}_Response"),
    )
