"""Robots in processes of their own, a router, and all of it as one fleet."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from remote.field import Field, drive
from sgc.fleets import eventually

from tutelage.errors import ConfigError, ContractError
from tutelage.remote.fleet import RemoteFleet

STILL = np.zeros((3, 2), np.float32)


def test_robots_do_what_the_fleet_says_a_timestep_for_a_step(field: Field, fleet: RemoteFleet) -> None:
    began = time.monotonic()
    seen = [fleet.step(np.array([[0.2, 0.0], [0.0, 0.3], [0.0, 0.0]], np.float32)) for _ in range(20)]
    assert 0.9 < time.monotonic() - began < 1.3  # 20 Hz, by the clock
    first, last = seen[4][0], seen[-1][0]
    assert last.shape == (3, 2)
    assert last.dtype == np.float32
    assert (last - first)[:2].diagonal() == pytest.approx([15 * 0.02, 15 * 0.03], abs=0.09)
    assert last[2] == pytest.approx(first[2])
    info = seen[-1][-1]
    assert info["online"].all()
    assert not info["violation"].any()
    assert (info["elapsed"] > 10).all()
    acts = field.notes(1, began, "act")
    gaps = np.diff([note.time for note in acts])
    assert len(acts) in range(18, 23)
    assert np.median(gaps) == pytest.approx(0.05, abs=0.01)


def test_what_a_fleet_returns_belongs_to_the_caller(fleet: RemoteFleet) -> None:
    obs = fleet.step(STILL)[0]
    kept = obs.copy()
    obs += 1
    assert fleet.step(STILL)[0] == pytest.approx(kept, abs=1e-6)


def test_actions_are_clamped_on_the_robot(field: Field, fleet: RemoteFleet) -> None:
    began = time.monotonic()
    for _ in range(5):
        fleet.step(np.array([[0.0, -0.5], [50.0, -50.0], [0.0, 0.0]], np.float32))
    acts = field.notes(2, began + 0.1, "act")
    assert {note.words for note in acts} == {("1.0", "-1.0")}


def test_robots_outside_active_hold(field: Field, fleet: RemoteFleet) -> None:
    for _ in range(4):
        fleet.step(STILL, active=np.array([True, False, True]))
    began = time.monotonic()
    for _ in range(10):
        info = fleet.step(STILL, active=np.array([True, False, True]))[-1]
    assert info["online"].all()
    assert info["held"].tolist() == [False, True, False]
    assert not field.moves(2, began)
    assert field.moves(1, began)


def test_an_action_that_is_not_a_number_is_refused_here(fleet: RemoteFleet) -> None:
    with pytest.raises(ContractError, match=r"actions of robots \[1\] are not finite"):
        fleet.step(np.array([[0, 0], [np.nan, 0], [0, 0]], np.float32))


def test_success_is_told_once_and_a_soft_reset_goes_on_beside_the_loop(field: Field, fleet: RemoteFleet) -> None:
    go = STILL.copy()

    def home() -> tuple[np.ndarray, ...]:
        go[0] = np.clip(10 * (1 - fleet._obs[0]), -1, 1)
        return fleet.step(go)

    told = 0
    for _ in range(80):
        obs, _, _, _, info = home()
        told += info["success"][0]
        if info["success"][0]:
            assert np.linalg.norm(obs[0] - 1) < 0.1
            began = time.monotonic()
            _, info = fleet.reset(options={"reset_mask": info["success"]})
            assert time.monotonic() - began < 0.02
            assert info["online"].tolist() == [False, True, True]
            assert info["resetting"].tolist() == [True, False, False]
            break
    assert told == 1
    drive(lambda: fleet.step(STILL), lambda: fleet.status()[0]["state"] == "online")
    obs, *_, info = fleet.step(STILL)
    assert info["online"].all()
    assert obs[0] == pytest.approx([0, 0], abs=0.2)
    assert info["elapsed"][0] < 20
    assert [note.words for note in field.notes(1, began, "reset")] == [("soft",)]


def test_a_robot_in_violation_stands_still_until_a_hard_reset(field: Field, fleet: RemoteFleet) -> None:
    out = np.array([[0, 0], [-1, 0], [0, 0]], np.float32)
    drive(lambda: fleet.step(out), lambda: fleet.step(out)[-1]["violation"][1])
    began = time.monotonic() + 0.1
    for _ in range(5):
        info = fleet.step(out)[-1]
    assert info["violation"].tolist() == [False, True, False]
    assert info["online"].all()
    assert not field.moves(2, began)
    _, info = fleet.reset(options={"reset_mask": info["violation"]})
    assert not info["violation"].any()
    drive(lambda: fleet.step(STILL), lambda: fleet.step(STILL)[-1]["online"].all())
    assert [note.words for note in field.notes(2, began, "reset")] == [("hard",)]


def test_pictures_come_while_somebody_looks(fleet: RemoteFleet) -> None:
    assert fleet.description.cameras == ("front",)
    fleet.picture(2)
    drive(lambda: fleet.step(STILL), lambda: fleet.picture(2) is not None)
    when, rgb = fleet.picture(2)  # type: ignore[misc]
    assert abs(time.time() - when) < 1.0
    assert rgb.shape == (48, 64, 3)
    assert rgb[20, 30, 0] > 150 > rgb[20, 30, 1]
    drive(lambda: fleet.step(STILL), lambda: fleet.jpeg(2)[0] > when)  # type: ignore[index]
    assert fleet.jpeg(0) is None  # nobody looked at that one


def test_the_emergency_stop_is_latched_until_it_is_cleared(field: Field, fleet: RemoteFleet) -> None:
    drive(lambda: fleet.step(STILL), lambda: not fleet.step(STILL)[-1]["held"].any())
    began = time.monotonic()
    fleet.stop(0)
    eventually(lambda: field.notes(1, began, "stop"), 1.0)
    assert field.notes(1, began, "stop")[0].time - began < 0.1
    for _ in range(5):
        info = fleet.step(STILL)[-1]
    assert info["online"].tolist() == [False, True, True]
    assert info["stopped"].tolist() == [True, False, False]
    after = time.monotonic()
    for _ in range(5):
        fleet.step(STILL)
    assert not field.moves(1, after)
    fleet.clear()
    drive(lambda: fleet.step(STILL), lambda: fleet.step(STILL)[-1]["online"].all())
    assert field.notes(1, began, "release")
    drive(lambda: fleet.step(STILL), lambda: field.moves(1, after))


def test_a_robot_stopped_by_an_earlier_server_stays_stopped_for_the_next(field: Field, fleet: RemoteFleet) -> None:
    fleet.stop(1)
    drive(lambda: fleet.step(STILL), lambda: fleet.status()[1]["state"] == "stopped")
    eventually(lambda: (field.made.robots[1] / "stopped").exists())
    fleet.close()
    other = RemoteFleet.connect(field.server, hz=20.0)
    try:
        other.reset()
        drive(lambda: other.step(STILL), lambda: other.status()[1]["state"] == "stopped")
        assert other.step(STILL)[-1]["stopped"].tolist() == [False, True, False]
        other.clear(1)
        drive(lambda: other.step(STILL), lambda: other.step(STILL)[-1]["online"].all())
    finally:
        other.close()


def test_steps_end_when_all_have_answered_where_there_is_no_rate(field: Field, fleet: RemoteFleet) -> None:
    fleet.close()
    quick = RemoteFleet.connect(field.server, hz=None)
    try:
        quick.reset()
        drive(lambda: quick.step(STILL), lambda: quick.step(STILL)[-1]["online"].all())

        def ten_steps() -> bool:
            """Did each robot make ten timesteps in ten steps? A step also ends at its deadline, on a busy machine."""
            before = quick.step(STILL)[-1]["elapsed"]
            for _ in range(10):
                after = quick.step(STILL)[-1]["elapsed"]
            return bool((after - before == 10).all())

        assert any(ten_steps() for _ in range(5))
    finally:
        quick.close()


def test_what_the_policy_does_not_name_is_no_robot(fleet: RemoteFleet) -> None:
    with pytest.raises(ConfigError, match="has no robot arm-9; it has robot-1, robot-2, robot-3"):
        RemoteFleet(fleet.node, ["arm-9"])
    with pytest.raises(ConfigError, match="cannot be checkpointed"):
        fleet.state_dict()


def test_a_server_without_robots_says_so(tmp_path: Path) -> None:
    from tutelage.remote.setup import new_fleet

    made = new_fleet(tmp_path / "fleet", 1, connect="tls/127.0.0.1:9")
    with pytest.raises(ConfigError, match=r"no robot of robot-1 answered within 0.1 s; start one: tutelage robot"):
        RemoteFleet.connect(made.server, wait=0.1)
