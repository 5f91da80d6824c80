"""What a server makes of one robot's messages, by its own clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tutelage.remote.jpeg import encode
from tutelage.remote.messages import Answer, Description, Flag, Observation, Picture
from tutelage.remote.robots import Robots
from tutelage.remote.slot import Slot
from tutelage.remote.wire import pack_observation, pack_picture

FLEET = Description((2,), "float32", (-1.0,), (1.0,))
SERVER, DEADLINE = 9, 0.5
NOTHING = Flag(0)


def seen(
    number: int,
    *,
    boot: int = 1,
    episode: int = 1,
    flags: Flag = NOTHING,
    heard: int = 0,
    waited: float = 0.0,
    size: int = 2,
) -> bytes:
    obs = np.zeros(size, np.float32)
    return pack_observation(
        Observation(boot, number, episode, 0, flags, SERVER if heard else 0, heard, heard, waited, 0.0, 0, 0, 0, obs)
    )


@pytest.fixture
def slot() -> Slot:
    """Of a robot that is in reach."""
    made = Slot("arm")
    assert made.observe(seen(1), FLEET, SERVER, 10.0)
    made.description = FLEET
    assert made.state(10.1, DEADLINE) == "online"
    return made


def test_a_robot_is_gone_when_nothing_is_heard_and_back_when_something_is(slot: Slot) -> None:
    assert slot.state(10.51, DEADLINE) == "gone"
    slot.observe(seen(2), FLEET, SERVER, 11.0)
    assert slot.state(11.0, DEADLINE) == "online"
    assert Slot("other").state(11.0, DEADLINE) == "never"


def test_only_the_newest_observation_counts(slot: Slot) -> None:
    assert slot.observe(seen(5), FLEET, SERVER, 10.1)
    assert not slot.observe(seen(4), FLEET, SERVER, 10.2)
    assert not slot.observe(seen(5), FLEET, SERVER, 10.2)
    assert slot.counts["replaced"] == 2
    assert slot.heard_at == 10.1  # what is old does not keep a robot in reach


def test_a_robot_that_started_again_is_asked_anew_and_its_earlier_start_is_not_heard_any_more(slot: Slot) -> None:
    assert slot.observe(seen(1, boot=2), FLEET, SERVER, 10.1)
    assert slot.state(10.1, DEADLINE) == "asking"
    assert slot.starts == 2
    assert not slot.observe(seen(99), FLEET, SERVER, 10.2)
    assert slot.counts["other_start"] == 1


def test_a_reset_is_over_with_the_first_observation_of_a_new_episode(slot: Slot) -> None:
    slot.reset, slot.accepted = "soft", Answer(True, 1, 1)
    for number, flags in ((2, Flag(0)), (3, Flag.RESETTING)):
        slot.observe(seen(number, flags=flags), FLEET, SERVER, 10.1)
        assert slot.state(10.1, DEADLINE) == "resetting"
    slot.observe(seen(4, episode=2), FLEET, SERVER, 10.2)
    assert slot.state(10.2, DEADLINE) == "online"


def test_a_reset_is_over_when_the_robot_starts_again_instead(slot: Slot) -> None:
    slot.reset, slot.accepted = "hard", Answer(True, 1, 1)
    slot.observe(seen(1, boot=2), FLEET, SERVER, 10.2)
    assert not slot.reset


def test_a_robot_that_observes_something_else_is_no_part_of_the_fleet(slot: Slot) -> None:
    assert not slot.observe(seen(2, size=3), FLEET, SERVER, 10.1)
    assert slot.state(10.1, DEADLINE) == "misfit"
    assert "observes (3,) float32" in slot.misfit


def test_the_round_trip_leaves_out_what_the_robot_waited_itself(slot: Slot) -> None:
    slot.sent(1, 10.2)
    slot.observe(seen(2, heard=1, waited=0.08), FLEET, SERVER, 10.3)
    assert slot.round_trip == pytest.approx(0.02)


def test_damage_is_counted(slot: Slot) -> None:
    for bad in (b"", seen(2)[:-1]):
        assert not slot.observe(bad, FLEET, SERVER, 10.1)
    assert not slot.look(b"JFIF", "front", 10.1)
    assert not slot.look(pack_picture(Picture(1, 1, 0, 4, 4, b"no picture")), "front", 10.1)
    assert slot.counts["malformed"] == 4


def test_what_does_not_fit_is_forgotten_when_it_becomes_known_what_does(slot: Slot) -> None:
    early = Slot("other")
    assert early.observe(seen(1, size=3), None, SERVER, 10.0)
    early.settle_on(FLEET)
    assert early.newest is None
    assert early.state(10.0, DEADLINE) == "misfit"
    assert early.observe(seen(1, boot=2), FLEET, SERVER, 10.1)  # it was started again, as what it should be
    assert not early.misfit


def test_pictures_go_by_the_cameras_name_as_a_robot_may_lack_one() -> None:
    """The bits of a command count the robot's own cameras; a fleet's order is another one where one of them is broken."""
    made = Slot("arm")
    made.observe(seen(1), FLEET, SERVER, 10.0)
    made.watch("wrist", 10.0)
    assert made.watched(10.0) == 0
    made.description = replace(FLEET, cameras=("wrist",))
    assert made.watched(10.0) == 0b1
    made.description = replace(FLEET, cameras=("front", "wrist"))
    assert made.watched(10.0) == 0b10
    assert made.look(pack_picture(Picture(1, 1, 0, 4, 4, encode(np.zeros((4, 4, 3), np.uint8)))), "wrist", 10.1)
    assert set(made.pictures) == {"wrist"}


def test_a_fleet_has_the_cameras_that_any_of_its_robots_has(tmp_path: Path) -> None:
    robots = Robots(("one", "two"), DEADLINE, tmp_path / "fleet.json")
    for slot, cameras in zip(robots, (("wrist",), ("front", "wrist")), strict=True):
        robots.introduce(slot, replace(FLEET, cameras=cameras))
    assert robots.description is not None
    assert robots.description.cameras == ("wrist", "front")
    again = Robots(("one",), DEADLINE, tmp_path / "fleet.json").description
    assert again is not None
    assert again.cameras == ("wrist", "front")


def test_a_fleet_whose_description_cannot_be_kept_is_one_all_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("in the way")
    robots = Robots(("one",), DEADLINE, tmp_path / "file" / "fleet.json")
    robots.introduce(robots.slots[0], FLEET)
    assert robots.slots[0].description == FLEET
    assert "the next server will have to ask" in caplog.text
