"""Quality of service and USER_DATA as Cyclone DDS has them."""

from __future__ import annotations

from typing import Any

from tutelage.sgc.proxies.ros_qos import QosProfile

_POLICIES = {2: "durability", 4: "deadline", 8: "liveliness", 11: "reliability", 23: "data representation"}
MARK = "tutelage"
"""Key in the USER_DATA of what a proxy writes. No proxy takes what a proxy has written, so nothing goes round in circles."""
_WRITE_TIMEOUT = 100_000_000  # nanoseconds that a reliable writer may wait for slow readers


def user_data(pairs: dict[str, str]) -> bytes:
    """USER_DATA as the middlewares of ROS 2 write it: key=value;key=value;"""
    return "".join(f"{key}={value};" for key, value in pairs.items()).encode()


def parse_user_data(data: bytes) -> dict[str, str]:
    """The other way round; what is not of that form is left out."""
    pairs = (part.partition("=") for part in data.decode("utf-8", "replace").split(";"))
    return {key: value for key, equals, value in pairs if equals}


def policy_name(number: int) -> str:
    """Of a dds_qos_policy_id_t."""
    return _POLICIES.get(number, "other")


def mark_of(qos: Any) -> str:
    """Of the proxy whose writer or reader this is; "" if it is nobody's."""
    from cyclonedds.core import Policy

    policy = qos[Policy.Userdata] if Policy.Userdata in qos else None  # noqa: SIM401 - a Qos has no get
    return parse_user_data(bytes(policy.data)).get(MARK, "") if policy is not None else ""


def dds_qos(profile: QosProfile, pairs: dict[str, str], *, writes: bool) -> Any:
    """The profile as Cyclone DDS's. Lifespan and deadline are promises of writers; a reader that asks for none fits all."""
    from cyclonedds.core import Policy, Qos

    keep_all = profile.history == "keep_all"
    history = Policy.History.KeepAll if keep_all else Policy.History.KeepLast(profile.depth)
    reliable = profile.reliability == "reliable"
    policies: list[Any] = [
        history,
        Policy.Reliability.Reliable(_WRITE_TIMEOUT) if reliable else Policy.Reliability.BestEffort,
        Policy.Userdata(user_data(pairs)),
        Policy.IgnoreLocal.Participant,
    ]
    if profile.durability == "transient_local":
        policies += [Policy.Durability.TransientLocal, Policy.DurabilityService(0, history, -1, -1, -1)]
    if writes:
        policies.append(Policy.WriterDataLifecycle(autodispose=False))
        if profile.lifespan is not None:
            policies.append(Policy.Lifespan(round(profile.lifespan * 1e9)))
        if profile.deadline is not None:
            policies.append(Policy.Deadline(round(profile.deadline * 1e9)))
    return Qos(*policies)
