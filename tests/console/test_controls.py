"""How people drive: every task has a way, and it means what it says."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from tutelage.console.controls import Controls, Driver, controls_of
from tutelage.console.states import Denied
from tutelage.envs import experts
from tutelage.envs.registry import make_fleet
from tutelage.envs.tasks import TASKS


def driver(task: str, n: int = 1) -> tuple[Driver, Any]:
    fleet: Any = make_fleet(task, n, disturbance="none", threads=1)
    obs, _ = fleet.reset(seed=0)
    return Driver(controls_of(task, fleet, assist=True), fleet, experts.load(task)[0]), (fleet, obs)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_can_be_driven(task: str) -> None:
    drive, (fleet, obs) = driver(task, 2)
    controls = drive.controls
    assert controls.assist
    assert controls.help
    assert json.loads(json.dumps(controls.to_json()))["axes"] is not None
    for axis in controls.axes:
        assert fleet.action_low[axis.index] <= axis.low < axis.high <= fleet.action_high[axis.index]
    keys = [key for axis in controls.axes for key in axis.keys if key]
    assert len(set(keys)) == len(keys), "no key means two things"
    assert controls.assist_key not in keys
    actions = drive.assist(obs, np.arange(2), np.arange(2))
    assert actions.shape == (2, len(fleet.action_low))
    assert np.isfinite(actions).all()
    fleet.close()


def test_the_expert_of_a_task_with_several_kinds_is_the_persons_own() -> None:
    drive, (_, obs) = driver("ObstaclePushing", 2)
    one, other = drive.assist(obs[:1], np.array([0]), np.array([0])), drive.assist(obs[:1], np.array([0]), np.array([1]))
    assert not np.allclose(one, other), "one goes round the obstacle clockwise, the other one does not"


def test_a_drag_pushes_the_block_that_way() -> None:
    drive, (fleet, obs) = driver("ObstaclePushing")
    block = fleet.states[0, :2].copy()
    away = block / np.linalg.norm(block)  # off the obstacle
    action = drive.action(None, (0.01, -0.03, *(0.02 * away + [0.01, -0.03])), obs[0], 0)
    assert action == pytest.approx(0.02 * away / 0.03, abs=1e-3)
    fleet.step(action[None])
    moved = fleet.states[0, :2] - block
    assert moved @ away > 0.005


def test_a_long_drag_is_a_push_of_full_length_in_its_direction() -> None:
    drive, (_, obs) = driver("ObstaclePushing")
    action = drive.action(None, (-0.12, 0.0, 0.12, -0.03), obs[0], 0)
    assert action is not None
    assert np.abs(action).max() == pytest.approx(1.0)
    assert action[1] < 0 < action[0]


@pytest.mark.parametrize(
    ("drag", "face"),
    [((0.0, 0.0, 0.05, 0.0), 0), ((0.0, 0.0, 0.0, 0.1), 1), ((0.0, 0.0, -0.05, 0.01), 2), ((0.0, 0.0, 0.02, -0.1), 3)],
)
def test_of_four_pushes_the_nearest_to_the_drag(drag: tuple[float, ...], face: int) -> None:
    drive, (fleet, obs) = driver("BlockPushing")
    before = fleet.states[0, :2].copy()
    action = drive.action(None, drag, obs[0], 0)
    assert action is not None
    assert int(np.argmax(action)) == face
    fleet.step(action[None])
    moved = fleet.states[0, :2] - before
    assert int(np.argmax(moved @ np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]).T)) == face


def test_no_key_and_no_drag_is_no_push() -> None:
    drive, (_, obs) = driver("BlockPushing")
    assert drive.controls.once
    assert drive.action(np.zeros(4), None, obs[0], 0) is None
    assert drive.action(None, (0.1, 0.1, 0.1, 0.1), obs[0], 0) is None


def test_a_robot_in_the_maze_goes_to_where_one_points() -> None:
    drive, (fleet, obs) = driver("Navigation")
    target = np.array([12.0, 27.0])
    for _ in range(8):
        action = drive.action(None, (0.0, 0.0, *target), obs[0], 0)
        obs, *_ = fleet.step(action[None])
    assert obs[0] == pytest.approx(target)


@pytest.mark.parametrize(("width", "height"), [(320, 180), (320, 240), (200, 200), (180, 320)])
@pytest.mark.parametrize(("task", "colour"), [("Navigation", (214, 70, 50)), ("ObstaclePushing", (40, 80, 200))])
def test_a_picture_of_any_shape_shows_the_view_whole_and_not_stretched(
    task: str, colour: tuple[int, int, int], width: int, height: int
) -> None:
    """In its middle and as large as it fits: from that the page knows where on the plane people point."""
    drive, (fleet, _) = driver(task)
    pointer = drive.controls.pointer
    assert pointer is not None
    view = pointer.view
    found = np.abs(fleet.render_robot(0, width, height).astype(int) - colour).sum(axis=2) < 10
    rows, columns = np.nonzero(found)
    pixel = max(view.width / width, view.height / height)
    x = view.x + (columns.mean() + 0.5 - width / 2) * pixel
    y = view.y - (rows.mean() + 0.5 - height / 2) * pixel
    assert [x, y] == pytest.approx(fleet.states[0, :2], abs=pixel)
    assert abs(np.ptp(rows) - np.ptp(columns)) <= 1, "as wide as high"


@pytest.mark.parametrize("push", [[0.1] * 3, "push", [0.1, 0.2, 0.3, float("nan")], [9.0, 0.0, 0.0, 0.0], [None] * 4])
def test_bad_pushes_are_refused(push: Any) -> None:
    drive, _ = driver("ObstaclePushing")
    with pytest.raises(Denied) as denied:
        drive.check_push(push)
    assert denied.value.code == "bad_command"


def test_a_task_that_somebody_made_of_one_of_ours_is_driven_like_it() -> None:
    from tutelage.envs.mujoco_fleet import MujocoFleet
    from tutelage.envs.tasks import PegInsertion

    class Mine(PegInsertion):
        name = "Mine"

    fleet = MujocoFleet(Mine(), 1, threads=1)
    assert controls_of("my_pkg:robots", fleet, assist=False).axes[4].label == "gripper"
    fleet.close()


def test_a_fleet_of_somebody_else_has_an_axis_for_each_number() -> None:
    from fakes import PointFleet

    controls = controls_of("my_pkg:robots", PointFleet(1), assist=False)
    assert isinstance(controls, Controls)
    assert [axis.index for axis in controls.axes] == [0]
    assert not controls.assist
