"""The list of what a proxy carries, checked against the policy."""

from __future__ import annotations

import pytest
from sgc.fleets import Fleet, service, topic

from tutelage.errors import ConfigError
from tutelage.sgc.access import Access
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.proxies.ros_qos import PROFILES
from tutelage.sgc.proxies.routes import ServiceRoute, TopicRoute, all_routes, load_routes, parse_routes

POLICY = (
    topic("camera", ["robot"], ["server"], type="sensor_msgs/msg/Image", interface="/camera/image_raw", delivery="lossy")
    + topic("chat", ["robot", "server"], ["robot", "server"])
    + service("grasp", ["robot"], ["server"])
    + topic("no-name", ["robot"], ["server"])
    + topic("fold-feedback", ["robot"], ["server"], interface="/f1")
    + topic("fold-status", ["robot"], ["server"], interface="/f2")
    + "".join(
        service(f"fold-{part}", ["robot"], ["server"], interface=f"/{part}")
        for part in ("send_goal", "cancel_goal", "get_result")
    )
)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    return Fleet(tmp_path_factory.mktemp("fleet"), POLICY, ["robot", "server"])


@pytest.fixture
def robot(fleet) -> Access:
    return fleet["robot"].access


def routes(access, **content):
    return parse_routes({"version": 1, **content}, access)


def test_name_type_and_direction_come_from_the_policy_unless_given(robot):
    one, other = routes(
        robot, topic=[{"alias": "camera"}, {"alias": "chat", "name": "/talk", "domain": 3, "queue": 7}]
    ).topics
    assert one == TopicRoute("camera", "/camera/image_raw", "sensor_msgs/msg/Image", True, False, queue=1)
    assert other == TopicRoute("chat", "/talk", "std_msgs/msg/String", True, True, domain=3, queue=7)


def test_a_service_says_on_which_side_its_server_is(fleet, robot):
    entry = {"alias": "grasp", "direction": "out", "timeout": 2}
    assert routes(robot, service=[entry]).services == (ServiceRoute("grasp", "/grasp", "std_srvs/srv/Trigger", True, 2),)
    entry["direction"] = "in"
    assert not routes(fleet["server"].access, service=[entry]).services[0].outward


def test_an_action_is_three_services_and_two_topics(robot):
    entry = {
        "alias": "fold",
        "name": "/fold",
        "type": "example_interfaces/action/Fibonacci",
        "direction": "out",
        "domain": 2,
    }
    made = routes(robot, action=[entry])
    assert [(s.alias, s.name, s.type) for s in made.services] == [
        ("fold-send_goal", "/fold/_action/send_goal", "example_interfaces/action/Fibonacci_SendGoal"),
        ("fold-cancel_goal", "/fold/_action/cancel_goal", "action_msgs/srv/CancelGoal"),
        ("fold-get_result", "/fold/_action/get_result", "example_interfaces/action/Fibonacci_GetResult"),
    ]
    assert [(t.alias, t.type, t.qos) for t in made.topics] == [
        ("fold-feedback", "example_interfaces/action/Fibonacci_FeedbackMessage", PROFILES["default"]),
        ("fold-status", "action_msgs/msg/GoalStatusArray", PROFILES["action_status"]),
    ]
    assert {route.domain for route in (*made.services, *made.topics)} == {2}
    assert {service.through for service in made.services} == {"dds"}
    through = routes(robot, action=[{**entry, "through": "rclpy"}])
    assert {service.through for service in through.services} == {"rclpy"}
    assert through.topics == made.topics


def test_several_topics_of_the_fleet_may_meet_on_one_name(robot):
    assert len(routes(robot, topic=[{"alias": "chat", "name": "/x"}, {"alias": "fold-feedback", "name": "/x"}]).topics) == 2


def test_all_of_a_nodes_topics_and_services_without_a_file_but_for_those_that_ros_cannot_name(fleet):
    made = all_routes(fleet["server"].access)
    assert {(route.alias, route.outward, route.inward) for route in made.topics} == {
        ("camera", False, True),
        ("chat", True, True),
        ("fold-feedback", False, True),
        ("fold-status", False, True),
    }
    assert not any(route.outward for route in made.services)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"version": 2}, "version must be 1"),
        ({"surprise": 1}, "unknown setting surprise"),
        ({"topic": [{}]}, "a topic needs alias"),
        ({"topic": ["camera"]}, "a topic must be a table"),
        ({"topic": {"alias": "camera"}}, "topic cannot be"),
        ({"topic": [{"alias": "grasp"}]}, "topic grasp is a service"),
        ({"service": [{"alias": "chat", "direction": "in"}]}, "service chat is no service"),
        ({"service": [{"alias": "grasp"}]}, "service grasp needs direction"),
        ({"service": [{"alias": "grasp", "direction": "in"}]}, "does not let robot request"),
        ({"service": [{"alias": "grasp", "direction": "out", "through": "ros"}]}, "service grasp: through is dds or rclpy"),
        ({"topic": [{"alias": "camera", "direction": "in"}]}, "does not let robot subscribe to it"),
        ({"topic": [{"alias": "camera", "direction": "up"}]}, "direction is out, in or both"),
        ({"topic": [{"alias": "camera", "name": "no name"}]}, "topic camera: 'no name' is not a ROS 2 name"),
        ({"topic": [{"alias": "camera", "type": "Image"}]}, "topic camera: 'Image' is not a ROS 2 type"),
        ({"topic": [{"alias": "camera", "domain": 233}]}, "domain must be from 0 to 232"),
        ({"topic": [{"alias": "camera", "domain": True}]}, "domain cannot be True"),
        ({"topic": [{"alias": "camera", "qos": "loud"}]}, "topic camera: there is no QoS profile"),
        ({"topic": [{"alias": "camera", "qos": "latched"}]}, "topic camera: a transient_local topic must be reliable"),
        ({"topic": [{"alias": "camera", "colour": 1}]}, "topic camera: unknown setting colour"),
        ({"topic": [{"alias": "chat"}, {"alias": "chat"}]}, "with alias chat is listed twice"),
    ],
)
def test_what_cannot_work_is_one_line_that_names_the_topic(robot, content, says):
    with pytest.raises(ConfigError, match=says):
        routes(robot, **content)


def test_a_topic_of_others_is_not_ours_to_carry(robot):
    with pytest.raises(NotAllowed, match="robot no part in a topic 'secret'"):
        routes(robot, topic=[{"alias": "secret"}])


def test_the_file_is_named(robot, tmp_path):
    file = tmp_path / "routes.toml"
    with pytest.raises(ConfigError, match=r"cannot read .*routes.toml"):
        load_routes(file, robot)
    file.write_text("version = ")
    with pytest.raises(ConfigError, match=r"routes.toml is not TOML"):
        load_routes(file, robot)
    file.write_text('version = 1\n[[topic]]\nalias = "camera"\nqueue = 0\n')
    with pytest.raises(ConfigError, match=r"routes.toml: topic camera: queue must be from 1"):
        load_routes(file, robot)
    file.write_text("version = 1\n")
    with pytest.raises(ConfigError, match=r"routes.toml: nothing is listed; list what is to be carried under"):
        load_routes(file, robot)
