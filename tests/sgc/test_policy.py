"""The policy: what it lets whom do, that each node is told only its part, and one clear line for every fault."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from members import POLICY, Fleet

from tutelage.errors import ConfigError
from tutelage.sgc.access import Access
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.policy import Policy
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Authenticity, Delivery, Kind, Lane, Role, TopicRule


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    fleet = Fleet(tmp_path_factory.mktemp("fleet"))
    fleet.join("router-1", Role.ROUTER)
    return fleet


def test_a_policy_is_read_with_its_defaults() -> None:
    topics = Policy.parse(POLICY).topics
    camera, teleop, grasp = topics["camera"], topics["teleop"], topics["grasp"]
    assert (camera.kind, camera.authenticity, camera.delivery) == (Kind.STREAM, Authenticity.SIGNATURE, Delivery.RELIABLE)
    assert (camera.max_age, camera.rotate_every) == (None, 3600.0)
    assert (teleop.authenticity, teleop.max_age) == (Authenticity.SESSION, 0.5)
    assert grasp.lanes() == (Lane.REQUEST, Lane.REPLY, Lane.PRESENCE)


def test_wildcards_name_many_nodes() -> None:
    camera = Policy.parse(POLICY).topics["camera"]
    assert camera.may_send("drone-7")
    assert not camera.may_send("server")
    assert camera.may_receive("operator-42")
    assert not camera.may_receive("operator")
    assert camera.is_member("drone-7")
    assert not camera.is_member("arm-3")


def test_a_service_has_two_lanes_with_their_own_senders() -> None:
    grasp = Policy.parse(POLICY).topics["grasp"]
    assert grasp.may_send("drone-1", Lane.REQUEST)
    assert not grasp.may_send("drone-1", Lane.REPLY)
    assert grasp.may_send("server", Lane.REPLY)
    assert grasp.may_receive("drone-1", Lane.REPLY)


def test_all_members_of_a_topic_may_tell_each_other_that_they_are_there_by_signature() -> None:
    teleop = Policy.parse(POLICY).topics["teleop"]
    for node, member in (("operator-7", True), ("drone-1", True), ("drone-2", False)):
        assert teleop.may_send(node, Lane.PRESENCE) == teleop.may_receive(node, Lane.PRESENCE) == member
    assert teleop.authenticity_on(Lane.PRESENCE) == Authenticity.SIGNATURE
    assert teleop.authenticity_on(Lane.STREAM) == Authenticity.SESSION


def test_rules_survive_being_written() -> None:
    for alias, rule in Policy.parse(POLICY).topics.items():
        assert TopicRule.from_table(alias, rule.to_table()) == rule


GOOD = {
    "node": '"a"', "interface": '"/b"', "type": '"t"', "owner": '"a"', "publish": '["a"]', "subscribe": '["b"]',
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"pubish": '["a"]'}, "unknown field 'pubish'; did you mean 'publish'?"),
        ({"owner": None}, "lacks owner"),
        ({"node": '""', "type": None}, "lacks node, type"),
        ({"owner": '"drone-*"'}, "owner must be the name of one node"),
        ({"publish": None}, "needs publish = [...] with at least one name"),
        ({"publish": "[]"}, "needs publish = [...] with at least one name"),
        ({"publish": '"a"'}, "needs publish = [...] with at least one name"),
        ({"publish": '["a b"]'}, "'a b' in publish is no name of a node"),
        ({"publish": '["[ab]"]'}, "'[ab]' in publish is no name of a node"),
        ({"serve": '["a"]'}, "is a stream, which has publish and subscribe, not serve"),
        ({"kind": '"service"'}, "needs serve = [...]"),
        ({"kind": '"topic"'}, "kind must be one of stream, service, not 'topic'"),
        ({"authenticity": '"none"'}, "authenticity must be one of signature, session, chain, not 'none'"),
        ({"delivery": "3"}, "delivery must be one of reliable, lossy, not 3"),
        ({"max_age": "0"}, "max_age must be at least 0.001 and at most 3.16224e+07 seconds, not 0"),
        ({"max_age": "true"}, "max_age must be at least 0.001 and at most 3.16224e+07 seconds, not True"),
        ({"max_age": "nan"}, "max_age must be at least 0.001 and at most 3.16224e+07 seconds, not nan"),
        ({"max_age": "1e300"}, "max_age must be at least 0.001 and at most 3.16224e+07 seconds, not 1e+300"),
        ({"max_age": "inf"}, "max_age must be at least 0.001 and at most 3.16224e+07 seconds, not inf"),
        ({"rotate_every": "0.1"}, "rotate_every must be at least 1 and at most 2.592e+06 seconds, not 0.1"),
        ({"unique": "4"}, "unique of a topic must be text, not 4"),
        ({"kind": '"service"', "publish": None, "subscribe": None, "serve": '["a"]', "request": '["b"]',
          "authenticity": '"chain"'}, 'a service needs authenticity = "signature"'),
        ({"kind": '"service"', "publish": None, "subscribe": None, "serve": '["a"]', "request": '["b"]',
          "delivery": '"lossy"'}, "a service is always reliable"),
    ],
)  # fmt: skip
def test_a_fault_is_one_line_that_names_the_topic(change: dict[str, str | None], says: str) -> None:
    fields = {name: value for name, value in {**GOOD, **change}.items() if value is not None}
    text = "version = 1\n[topics.cam]\n" + "".join(f"{name} = {value}\n" for name, value in fields.items())
    with pytest.raises(ConfigError) as raised:
        Policy.parse(text)
    assert says in str(raised.value)
    assert "topic 'cam' of the policy" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "needs version = 1, not None"),
        ("version = 2", "needs version = 1, not 2"),
        ("version = ", "is not TOML"),
        ("version = 1\ntopic = 3", "unknown field 'topic'"),
        ("version = 1\ntopics = 3", "topics of the policy must be tables"),
        ("version = 1\n[topics]\ncam = 3", "topic 'cam' of the policy must be a table"),
        ("version = 1\n[topics.'../x']\nnode = 'a'", "an alias is 1 to 63 letters"),
    ],
)
def test_a_fault_of_the_file_is_one_line(text: str, says: str, tmp_path) -> None:
    file = tmp_path / "policy.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as raised:
        Policy.load(file)
    assert says in str(raised.value)
    assert str(file) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_two_topics_with_the_same_metadata_need_something_unique() -> None:
    table = "".join(f"{name} = {value}\n" for name, value in GOOD.items())
    with pytest.raises(ConfigError, match="'one' and 'two' of the policy have the same metadata"):
        Policy.parse(f"version = 1\n[topics.one]\n{table}[topics.two]\n{table}")
    assert len(Policy.parse(f"version = 1\n[topics.one]\n{table}[topics.two]\n{table}unique = 'b'\n").topics) == 2


def test_a_node_is_told_only_its_part(fleet: Fleet) -> None:
    assert set(fleet.homes["server"].access.topics) == {"camera", "teleop", "lidar", "grasp"}
    assert set(fleet.homes["drone-2"].access.topics) == {"camera", "lidar", "grasp"}
    assert "teleop" not in fleet.homes["drone-2"].access.to_json()
    assert fleet.homes["drone-2"].access.routes == ()


def test_members_of_a_topic_derive_the_same_name(fleet: Fleet) -> None:
    names = {fleet.homes[node].access.entry("camera").name for node in fleet.homes if node != "router-1"}
    assert len(names) == 1


def test_a_router_is_told_names_and_pseudonyms_but_no_metadata_and_no_secret(fleet: Fleet) -> None:
    router, drone = fleet.homes["router-1"], fleet.homes["drone-1"]
    router.accept(fleet.authority.publish()["router-1"])
    assert router.access.topics == {}
    assert router.access.secret == b""
    assert router.access.control == drone.access.control
    route = next(route for route in router.access.routes if route.name == drone.access.entry("camera").name)
    nodes = {name: home.pseudonym for name, home in fleet.homes.items()}
    assert route.owner == nodes["drone-1"]
    assert route.send == {nodes["drone-1"], nodes["drone-2"]}
    assert route.receive == {nodes["server"], nodes["operator-1"]}
    assert router.access.routers == {nodes.pop("router-1")}
    assert router.access.members == set(nodes.values())
    told = router.access.to_json()
    secrets = [entry.secret.hex() for entry in drone.access.topics.values()]
    assert not [word for word in ("camera", "sensor_msgs", "drone", "server", *secrets) if word in told]


def test_a_part_survives_being_written(fleet: Fleet) -> None:
    for home in fleet.homes.values():
        assert Access.from_json(home.access.to_json()) == home.access


@given(st.text(max_size=20) | st.sampled_from(['{"fleet": 1}', "[]", "null", '{"topics": []}', "[" * 100_000]))
def test_a_part_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(Refused) as raised:
        Access.from_json(text)
    assert raised.value.reason == Reason.MALFORMED


def test_what_is_not_allowed_names_node_and_remedy(fleet: Fleet) -> None:
    with pytest.raises(
        NotAllowed, match=r"gives drone-2 no part in a topic 'teleop' \(its topics are camera, grasp, lidar\)"
    ):
        fleet.sealer("drone-2", "teleop")
    with pytest.raises(NotAllowed, match="server is not in publish of topic 'camera'; add it to the policy of acme, then:"):
        fleet.sealer("server", "camera")
    with pytest.raises(NotAllowed, match="drone-1 is not in subscribe of topic 'camera'"):
        fleet.opener("drone-1", "camera")
    with pytest.raises(NotAllowed, match="camera is a stream in the policy of acme, so it has no request lane"):
        fleet.sealer("drone-1", "camera", Lane.REQUEST)
