"""Messages as plain values and back, and what comes from clients checked."""

from __future__ import annotations

import json
import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sgc.proxies.ros_ends import STORE, STRING, cdr

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros_input import BadValue
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.ros_values import BadMessage, Codec

TYPES = RosTypes("jazzy")
JOINTS = "sensor_msgs/msg/JointState"
ALL = sorted(STORE.fielddefs)


@pytest.mark.parametrize("type_name", ALL)
def test_every_standard_type_survives_the_way_to_values_and_back(type_name):
    codec = Codec(TYPES, type_name)
    data = codec.serialize({})
    assert codec.serialize(json.loads(json.dumps(codec.values(data), allow_nan=False))) == data


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "name": st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"))),
            "position": st.lists(st.none() | st.floats(allow_nan=False, allow_infinity=False)),
            "header": st.fixed_dictionaries(
                {"stamp": st.fixed_dictionaries({"sec": st.integers(0, 2**31 - 1), "nanosec": st.integers(0, 2**32 - 1)})}
            ),
        },
    )
)
def test_what_a_client_says_is_what_the_message_holds(values):
    codec = Codec(TYPES, JOINTS)
    shown = codec.values(codec.serialize(values))
    for name, value in values.items():
        assert shown[name] == ({**value, "frame_id": ""} if name == "header" else value)


def test_bytes_are_base64_and_numbers_that_json_lacks_are_null():
    image = Codec(TYPES, "sensor_msgs/msg/Image")
    assert image.values(image.serialize({"data": "AAEC/w=="}))["data"] == "AAEC/w=="
    assert image.values(image.serialize({"data": [0, 1, 2, 255]}))["data"] == "AAEC/w=="
    double = Codec(TYPES, "std_msgs/msg/Float64")
    assert double.values(cdr("std_msgs/msg/Float64", data=math.inf)) == {"data": None}
    assert double.values(double.serialize({"data": None})) == {"data": None}


def test_arrays_stay_arrays_for_cbor():
    codec = Codec(TYPES, JOINTS)
    shown = codec.values(codec.serialize({"position": [1, 2.5, None]}), arrays=True)
    assert isinstance(shown["position"], np.ndarray)
    assert math.isnan(shown["position"][2])


def test_times_have_the_names_of_both_ros_versions_and_a_missing_stamp_is_now():
    codec = Codec(TYPES, "std_msgs/msg/Header")
    assert codec.values(codec.serialize({"stamp": {"secs": 5, "nsecs": 6}, "seq": 3}))["stamp"] == {"sec": 5, "nanosec": 6}
    for given_stamp in ({}, {"stamp": "now"}, {"stamp": None}):
        assert abs(codec.values(codec.serialize(given_stamp))["stamp"]["sec"] - time.time()) < 5


def test_services_are_known_with_their_empty_parts():
    asks, answers = (Codec(TYPES, name) for name in TYPES.need_service("std_srvs/srv/Trigger"))
    assert asks.values(asks.serialize({})) == {}
    assert answers.values(answers.serialize({"success": True, "message": "done"})) == {"success": True, "message": "done"}


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ([], "JointState must be an object, not a list"),
        ({"nonsense": 1}, "JointState has no field 'nonsense'"),
        ({"header": {"frame": 1}}, "Header has no field 'header.frame'"),
        ({"header": 1}, "header must be an object, not 1"),
        ({"header": {"stamp": {"sec": 2**31}}}, "header.stamp.sec must be a whole number from -2147483648"),
        ({"header": {"stamp": {"sec": 1.5}}}, "header.stamp.sec must be a whole number"),
        ({"header": {"frame_id": 3}}, "header.frame_id must be text, not 3"),
        ({"header": {"frame_id": "a\0b"}}, "header.frame_id must be text"),
        ({"name": ["\ud800"]}, "surrogates not allowed"),
        ({"name": "abc"}, "name must be a list"),
        ({"position": [True]}, r"position\[0\] must be a number, not True"),
        ({"position": ["1"]}, r"position\[0\] must be a number"),
        ({"position": [[1]]}, r"position\[0\] must be a number, not a list"),
        ({"position": [10**400]}, r"position\[0\] must be a number that a double can hold"),
        ({"position": "AAAA"}, "position must be a list, not"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_name_of_the_field(values, says):
    with pytest.raises(BadValue, match=says):
        Codec(TYPES, JOINTS).serialize(values)


@pytest.mark.parametrize(
    ("type_name", "value", "says"),
    [
        ("std_msgs/msg/UInt8", 256, "data must be a whole number from 0 to 255, not 256"),
        ("std_msgs/msg/Int8", -129, "from -128 to 127"),
        ("std_msgs/msg/Bool", 1, "data must be true or false, not 1"),
        ("std_msgs/msg/Float32", 1e39, "float too large"),
        ("std_msgs/msg/UInt8MultiArray", "not base64!", "data must be base64"),
    ],
)
def test_numbers_stay_within_their_types(type_name, value, says):
    with pytest.raises(BadValue, match=says):
        Codec(TYPES, type_name).serialize({"data": value})


def test_arrays_of_a_fixed_length_have_it():
    codec = Codec(TYPES, "sensor_msgs/msg/CameraInfo")
    assert len(codec.values(codec.serialize({}))["k"]) == 9
    with pytest.raises(BadValue, match="k must have 9 elements, not 8"):
        codec.serialize({"k": [0] * 8})


def test_damaged_messages_are_bad_messages_and_nothing_else():
    codec = Codec(TYPES, JOINTS)
    whole = codec.serialize({"name": ["a"] * 7, "position": [1.0] * 7, "header": {"frame_id": "world"}})
    rng = np.random.Generator(np.random.PCG64(0))
    read = 0
    for _ in range(10_000):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(len(data))] = rng.integers(256)
        try:
            json.dumps(codec.values(bytes(data[: rng.integers(len(data) + 1)])), allow_nan=False)
            read += 1
        except BadMessage:
            pass
    assert 0 < read < 10_000


def test_definitions_come_from_folders_laid_out_as_ros_installs_them(tmp_path):
    for file, text in {
        "arm_msgs/msg/Grip.msg": "float32 force\nFinger[<=3] fingers\nstring<=5 name\n",
        "arm_msgs/msg/Finger.msg": "std_msgs/Header header\nuint8[2] id\n",
        "arm_msgs/srv/Close.srv": "Grip grip\n---\nbool done\n",
    }.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    types = RosTypes("jazzy", [tmp_path])
    grip = Codec(types, "arm_msgs/msg/Grip")
    made = grip.values(grip.serialize({"force": 2.5, "fingers": [{"id": [1, 2]}]}))
    assert (made["force"], made["fingers"][0]["id"]) == (2.5, "AQI=")
    with pytest.raises(BadValue, match="fingers must have 3 elements at most, not 4"):
        grip.serialize({"fingers": [{}] * 4})
    with pytest.raises(BadValue, match="name must have 5 elements at most"):
        grip.serialize({"name": "sixsix"})
    asks, answers = types.need_service("arm_msgs/srv/Close")
    assert (asks, answers) == ("arm_msgs/srv/Close_Request", "arm_msgs/srv/Close_Response")
    assert Codec(types, asks).serialize({"grip": {"force": 1}})


@pytest.mark.parametrize(
    ("distribution", "folder", "type_name", "says"),
    [
        ("noetic", None, STRING, "there is no ROS 2 distribution 'noetic'"),
        ("jazzy", "missing", STRING, "is not a folder of ROS 2 definitions"),
        ("jazzy", None, "arm_msgs/msg/Grip", "the type arm_msgs/msg/Grip is not known; looked in nowhere"),
        ("jazzy", "", "bad_msgs/msg/Bad", "cannot read the definition of bad_msgs/msg/Bad"),
        ("jazzy", "", "bad_msgs/msg/Loop", "goes round in a circle"),
        ("jazzy", "", "bad_msgs/msg/Wide", "the type bad_msgs/msg/wstring is not known"),
    ],
)
def test_what_is_not_known_or_cannot_be_read_is_said(tmp_path, monkeypatch, distribution, folder, type_name, says):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    (tmp_path / "bad_msgs/msg").mkdir(parents=True)
    for name, text in {"Bad": "???", "Loop": "Loop[] again\n", "Wide": "wstring text\n"}.items():
        (tmp_path / f"bad_msgs/msg/{name}.msg").write_text(text)
    with pytest.raises(ConfigError, match=says):
        Codec(RosTypes(distribution, [] if folder is None else [tmp_path / folder]), type_name)
