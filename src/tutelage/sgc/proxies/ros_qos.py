"""Quality of service: the profiles of ROS 2 by name, or their policies one by one, and how they look to Cyclone DDS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

from tutelage.errors import ConfigError

Reliability = Literal["reliable", "best_effort"]
Durability = Literal["volatile", "transient_local"]
History = Literal["keep_last", "keep_all"]


@dataclass(frozen=True)
class QosProfile:
    """Policies as in ROS 2.

    Attributes:
        reliability: reliable: lost messages are sent again; best_effort: they are not.
        durability: transient_local: who subscribes late still gets the last `depth` messages ("latching").
        history, depth: how many messages wait.
        lifespan: seconds after which a message is no longer delivered; None for ever.
        deadline: seconds within which a writer promises a message; None without promise.
    """

    reliability: Reliability = "reliable"
    durability: Durability = "volatile"
    history: History = "keep_last"
    depth: int = 10
    lifespan: float | None = None
    deadline: float | None = None


PROFILES: Mapping[str, QosProfile] = {
    "default": QosProfile(),
    "sensor_data": QosProfile(reliability="best_effort", depth=5),
    "services_default": QosProfile(),
    "parameters": QosProfile(depth=1000),
    "latched": QosProfile(durability="transient_local", depth=1),
    "action_status": QosProfile(durability="transient_local", depth=1),
}
"""rmw's profiles by their names; latched is what /map, /tf_static and /robot_description use."""


def parse_qos(value: object, where: str) -> QosProfile:
    """A profile by name, or a table: `profile` (default "default") with policies that replace its own.

    where: what the message names, such as "topic camera".

    Raises:
        ConfigError: unknown profile, policy or value.
    """
    if isinstance(value, str):
        value = {"profile": value}
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: qos is a profile ({', '.join(PROFILES)}) or a table, not {value!r}")
    given = dict(value)
    name = given.pop("profile", "default")
    if not isinstance(name, str) or name not in PROFILES:
        raise ConfigError(f"{where}: there is no QoS profile {name!r}; there are {', '.join(PROFILES)}")
    known = {field.name for field in fields(QosProfile)}
    for key, setting in given.items():
        if key not in known:
            raise ConfigError(f"{where}: there is no QoS policy {key!r}; there are {', '.join(sorted(known))}")
        _check(key, setting, where)
    return replace(PROFILES[name], **given)


def _check(key: str, setting: Any, where: str) -> None:
    choices = {"reliability": get_args(Reliability), "durability": get_args(Durability), "history": get_args(History)}
    number = isinstance(setting, int | float) and not isinstance(setting, bool)
    if key in choices:
        good, needed = setting in choices[key], " or ".join(choices[key])
    elif key == "depth":
        good, needed = number and isinstance(setting, int) and 1 <= setting <= 100_000, "a whole number from 1"
    else:
        good, needed = number and setting > 0, "seconds above 0"
    if not good:
        raise ConfigError(f"{where}: QoS policy {key} must be {needed}, not {setting!r}")
