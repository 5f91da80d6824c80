"""Names of ROS 2 in DDS."""

from __future__ import annotations

import pytest

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros_names import Channel, full_name, full_type, service_channels, topic_channel


def test_topics_and_services_are_mangled_as_ros_2_does():
    assert topic_channel("/arm/joint_states", "sensor_msgs/msg/JointState") == Channel(
        "rt/arm/joint_states", "sensor_msgs::msg::dds_::JointState_", "sensor_msgs/msg/JointState"
    )
    requests, replies = service_channels("/add", "example_interfaces/srv/AddTwoInts")
    assert (requests.topic, requests.dds_type) == ("rq/addRequest", "example_interfaces::srv::dds_::AddTwoInts_Request_")
    assert (replies.topic, replies.dds_type) == ("rr/addReply", "example_interfaces::srv::dds_::AddTwoInts_Response_")
    goal = service_channels("/fold/_action/send_goal", "example_interfaces/action/Fibonacci_SendGoal")[0]
    assert goal.dds_type == "example_interfaces::action::dds_::Fibonacci_SendGoal_Request_"


def test_names_and_types_of_ros_1_style_are_completed():
    assert full_name("chatter") == "/chatter"
    assert full_type("std_msgs/String") == "std_msgs/msg/String"
    assert full_type("std_srvs/Trigger", "srv") == "std_srvs/srv/Trigger"


@pytest.mark.parametrize("name", ["", "/", "//a", "/a/", "/1a", "/a b", "/a__b", "/é", "/" + "a" * 300, "/a\n"])
def test_impossible_names_are_refused(name):
    with pytest.raises(ConfigError, match="is not a ROS 2 name"):
        full_name(name)


@pytest.mark.parametrize("name", ["", "String", "a/b/c/d", "std_msgs/msg/", "Std/msg/String", "std_msgs/msg/Str ing"])
def test_impossible_types_are_refused(name):
    with pytest.raises(ConfigError, match="is not a ROS 2 type"):
        full_type(name)


def test_a_service_is_no_message():
    with pytest.raises(ConfigError, match="is of kind srv, but a msg is needed"):
        full_type("std_srvs/srv/Trigger")
