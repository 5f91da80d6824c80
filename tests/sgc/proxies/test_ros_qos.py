"""Quality of service by name or policy by policy."""

from __future__ import annotations

import pytest

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros_qos import PROFILES, QosProfile, parse_qos


def test_a_profile_by_name_and_with_policies_of_its_own():
    assert parse_qos("sensor_data", "topic camera") == QosProfile(reliability="best_effort", depth=5)
    assert parse_qos({"profile": "latched", "depth": 100}, "t") == QosProfile(durability="transient_local", depth=100)
    assert parse_qos({"history": "keep_all", "lifespan": 0.5}, "t") == QosProfile(history="keep_all", lifespan=0.5)
    assert parse_qos({}, "t") == PROFILES["default"]


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("sensor", "topic camera: there is no QoS profile 'sensor'"),
        (5, "topic camera: qos is a profile"),
        ({"profile": 1}, "no QoS profile 1"),
        ({"reliable": True}, "no QoS policy 'reliable'"),
        ({"reliability": "maybe"}, "reliability must be reliable or best_effort, not 'maybe'"),
        ({"depth": 0}, "depth must be a whole number from 1, not 0"),
        ({"depth": True}, "depth must be a whole number"),
        ({"depth": 1.5}, "depth must be a whole number"),
        ({"deadline": -1}, "deadline must be seconds above 0"),
    ],
)
def test_what_is_not_known_is_named(value, says):
    with pytest.raises(ConfigError, match=says):
        parse_qos(value, "topic camera")
