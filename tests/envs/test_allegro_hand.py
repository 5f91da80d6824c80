"""AllegroHand: the hand's published kinematics, goals that follow one another, cubes that drop, and gaits that turn them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from tutelage.checks import check_policy
from tutelage.envs import experts
from tutelage.envs.experts.allegro_hand import CYCLE, RATE, SIDES, Gait, Turner, features, shipped
from tutelage.envs.experts.gait_search import Evolution, SearchConfig, Trial, search
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import TASKS, allegro_hand
from tutelage.envs.tasks.allegro_hand import APART, DROPPED, RANGE, REST, SCALE, TOLERANCE, about_vertical, turn_between

CUBE, TURN, GOAL = slice(16, 19), slice(19, 23), slice(23, 27)
HOME = 2 * (allegro_hand.HOME - RANGE[0]) / (RANGE[1] - RANGE[0]) - 1
"""The actions that keep the hand as it starts."""


@pytest.fixture
def hands() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("AllegroHand", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def drive(fleet: MujocoFleet, actions: Any, steps: int) -> Any:
    for _ in range(steps):
        result = fleet.step(np.broadcast_to(actions, (fleet.num_envs, 16)))
    return result


def work(fleet: MujocoFleet, human: Any, obs: Any, steps: int) -> tuple[Any, Any, Any]:
    """The human goes on from goal to goal: obs, goals reached and cubes dropped, (N,) each."""
    reached, dropped = np.zeros(fleet.num_envs, dtype=int), np.zeros(fleet.num_envs, dtype=int)
    for _ in range(steps):
        obs, _, _, truncated, info = fleet.step(human.act(obs))
        reached += info["success"]
        dropped += info["violation"]
        over = info["success"] | info["violation"] | truncated
        if over.any():
            obs, _ = fleet.reset(options={"reset_mask": over})
    return obs, reached, dropped


def put_cubes(fleet: MujocoFleet, place: Any, turn: Any) -> None:
    """Cubes at rest at places (N, 3), m, turned by quaternions (N, 4), with goals on the other side."""
    qpos = fleet.physics.frame["qpos"].copy()
    qpos[:, GOAL] = turn @ np.array([[0, 0, 0, 1.0], [0, 0, 1, 0], [0, -1, 0, 0], [-1, 0, 0, 0]])
    qpos[:, CUBE], qpos[:, TURN] = place, turn
    fleet.physics.restart(np.arange(fleet.num_envs), qpos, np.zeros((fleet.num_envs, 25)))


# -- the hand -------------------------------------------------------------------------------------------------------


def test_the_hand_has_the_published_kinematics(hands: MujocoFleet) -> None:
    """Lengths of the links, where fingers and thumb begin, their axes, and the ranges of the joints."""
    model = hands.physics.model
    data = mujoco.MjData(model)
    np.testing.assert_allclose(model.jnt_range[:16].T, RANGE)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("middle distal").xpos, [0.0164 + 0.054 + 0.0384, 0, 0], atol=1e-4)
    for name, side in (("index", -1), ("ring", 1)):
        np.testing.assert_allclose(data.body(f"{name} base").xpos, [0, side * 0.0435, 0], atol=1e-4)
        level = data.body(f"{name} base").xmat.reshape(3, 3) @ [0, 1, 0]
        assert np.arcsin(level[2]) == pytest.approx(-side * np.radians(5), abs=0.001), "outer fingers lean out"
    thumb = {"thumb proximal": (-0.0764, -0.0567), "thumb medial": (-0.0779, -0.0744), "thumb distal": (-0.0824, -0.1256)}
    for name, (x, y) in thumb.items():
        np.testing.assert_allclose(data.body(name).xpos, [x, y, -0.0132], atol=2e-4)
    data.qpos[:] = hands.physics.qpos0
    data.qpos[:16] = [0, np.pi / 2, 0, 0] * 3 + [np.pi / 2, 0, 0, 0]
    mujoco.mj_kinematics(model, data)
    for finger in ("index", "middle", "ring"):
        assert data.body(f"{finger} medial").xpos[2] == pytest.approx(0.054, abs=0.001), "a bent finger points up"
    assert data.body("thumb distal").xpos[2] > 0.08, "so does the thumb"


def test_a_cube_lies_still_in_a_hand_that_rests(hands: MujocoFleet) -> None:
    put_cubes(hands, REST, about_vertical(np.zeros(4)))
    obs, _, _, _, info = drive(hands, HOME, 60)
    after = hands.physics.frame["qpos"][:, CUBE].copy()
    drive(hands, HOME, 40)
    np.testing.assert_allclose(hands.physics.frame["qpos"][:, CUBE], after, atol=1e-3)
    assert not info["violation"].any()
    assert np.abs(obs[:, 55:61]).max() < 0.05


def test_the_corners_on_which_a_cube_stands_do_not_lift_it(hands: MujocoFleet) -> None:
    put_cubes(hands, REST, about_vertical(np.full(4, 0.3)))
    drive(hands, -np.ones(16), 20)
    np.testing.assert_allclose(hands.physics.frame["qpos"][:, 18], REST[2], atol=1e-3)


# -- observations, goals, violation -----------------------------------------------------------------------------------


def test_observations_are_what_the_task_says(hands: MujocoFleet) -> None:
    actions = np.clip(HOME + np.linspace(-0.3, 0.3, 16), -1, 1)
    obs = drive(hands, actions, 3)[0] / SCALE
    assert obs.shape == (4, 88)
    for data, row in zip(hands.physics.datas, obs, strict=True):
        np.testing.assert_allclose(row[:16], 2 * (data.qpos[:16] - RANGE[0]) / (RANGE[1] - RANGE[0]) - 1)
        np.testing.assert_allclose(row[16:32], data.qvel[:16])
        np.testing.assert_allclose(row[32:48], data.actuator_force)
        np.testing.assert_allclose(row[48:51], data.qpos[CUBE])
        np.testing.assert_allclose(np.abs(row[51:55] @ data.qpos[TURN]), 1)
        np.testing.assert_allclose(row[55:61], data.qvel[16:22])
        np.testing.assert_allclose(row[61:64], REST)
        np.testing.assert_allclose(np.abs(row[64:68] @ data.qpos[GOAL]), 1)
        rotations = [np.zeros(9), np.zeros(9), np.zeros(9)]
        for rotation, quaternion in zip(rotations, (row[68:72], row[64:68], row[51:55]), strict=True):
            mujoco.mju_quat2Mat(rotation, quaternion)
        turn, goal, cube = (rotation.reshape(3, 3) for rotation in rotations)
        np.testing.assert_allclose(turn @ goal, cube, atol=1e-6)
        np.testing.assert_allclose(row[72:88], actions, atol=1e-6)
        assert (row[[51, 64, 68]] >= 0).all()


def test_the_angle_to_a_goal_counts_every_axis() -> None:
    task, frame = TASKS["AllegroHand"](), {"qpos": np.zeros((5, 27))}
    assert isinstance(task, allegro_hand.AllegroHand)
    angles = np.array([0.0, 0.9 * TOLERANCE, 1.1 * TOLERANCE, np.pi, 2 * np.pi])
    frame["qpos"][:, TURN] = about_vertical(angles)
    frame["qpos"][:, GOAL] = about_vertical(np.zeros(5))
    np.testing.assert_allclose(task.angle(frame), [*angles[:4], 0], atol=1e-9)
    assert task.success(frame).tolist() == [True, True, False, False, True]
    frame["qpos"][:, TURN] = [np.cos(0.2), np.sin(0.2), 0, 0]
    np.testing.assert_allclose(task.angle(frame), 0.4)
    assert not task.success(frame).any(), "a cube that leans is not turned as it should be"
    here = frame["qpos"][:, TURN]
    np.testing.assert_allclose(turn_between(here, here), np.tile([1.0, 0, 0, 0], (5, 1)), atol=1e-12)


def test_reward_is_more_near_the_goal_and_most_on_it() -> None:
    task, frame = TASKS["AllegroHand"](), {"qpos": np.zeros((4, 27))}
    assert isinstance(task, allegro_hand.AllegroHand)
    frame["qpos"][:, CUBE] = REST
    frame["qpos"][3, 16] += 0.05
    frame["qpos"][:, TURN], frame["qpos"][:, GOAL] = about_vertical(np.array([0.0, 1, 2, 2])), about_vertical(np.zeros(4))
    reward = task.reward(frame, np.zeros(4), np.zeros((4, 16)))
    assert reward[0] > 250
    assert reward[1] > reward[2] > reward[3]


def test_new_goals_are_about_the_vertical_and_some_way_off() -> None:
    fleet = MujocoFleet("AllegroHand", 200, disturbance="none", threads=1)
    task = fleet.task
    assert isinstance(task, allegro_hand.AllegroHand)
    fleet.reset(seed=0)
    frame = fleet.physics.frame
    angle = task.angle(frame)
    assert (angle > APART - 1e-9).all()
    assert angle.max() > 3
    assert np.abs(frame["qpos"][:, [24, 25]]).max() == 0
    fleet.close()


def test_after_a_goal_comes_the_next_and_nothing_else_changes(hands: MujocoFleet) -> None:
    qpos = hands.physics.frame["qpos"].copy()
    qpos[1:3, GOAL] = qpos[1:3, TURN]
    hands.physics.place(np.array([1, 2]), qpos[1:3])
    _, _, _, _, info = drive(hands, HOME, 1)
    assert info["success"].tolist() == [False, True, True, False]
    before, velocity = hands.physics.frame["qpos"].copy(), hands.physics.frame["qvel"].copy()
    commands = [data.ctrl.copy() for data in hands.physics.datas]
    obs, _ = hands.reset(options={"reset_mask": info["success"]})
    after = hands.physics.frame["qpos"]
    np.testing.assert_array_equal(after[:, :23], before[:, :23])
    np.testing.assert_array_equal(hands.physics.frame["qvel"], velocity)
    np.testing.assert_array_equal([data.ctrl for data in hands.physics.datas], commands)
    assert (after[:, GOAL] != before[:, GOAL]).any(axis=1).tolist() == [False, True, True, False]
    np.testing.assert_array_equal(obs, hands.task.observe(hands.physics.frame))
    _, _, _, _, info = drive(hands, HOME, 1)
    assert info["elapsed"].tolist() == [2, 1, 1, 2]


def test_a_cube_beside_the_hand_was_dropped_and_comes_back_to_it(hands: MujocoFleet) -> None:
    places = np.tile(REST, (4, 1))
    places[1, 1] -= 0.2
    places[2, 2] -= DROPPED + 0.01
    put_cubes(hands, places, about_vertical(np.zeros(4)))
    _, _, _, _, info = drive(hands, HOME, 1)
    assert info["violation"].tolist() == [False, True, True, False]
    hands.reset(options={"reset_mask": info["violation"]})
    assert np.linalg.norm(hands.physics.frame["qpos"][:, CUBE] - REST, axis=1).max() < 0.01


def test_a_fleet_goes_on_bit_for_bit_from_a_checkpoint_across_goals() -> None:
    human, rows = Turner(), []
    fleet = MujocoFleet("AllegroHand", 6, threads=1)
    obs, _ = fleet.reset(seed=5)
    obs, reached, _ = work(fleet, human, obs, 60)
    assert reached.any()
    state = fleet.state_dict()
    for threads in (1, 2):
        other = MujocoFleet("AllegroHand", 6, threads=threads)
        other.reset(seed=9)
        other.load_state_dict(state)
        rows.append(work(other, human, obs, 40)[0])
        other.close()
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_array_equal(work(fleet, human, obs, 40)[0], rows[0])
    fleet.close()


# -- the human --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES)
def test_each_gait_turns_the_cube_its_way(side: str) -> None:
    trial = Trial(1, 8, 100, side)
    turned, lost = trial.run(shipped()[side].numbers[None, None], np.random.default_rng(0), 0.0)
    assert np.median(turned) > 1.8
    assert (lost < 1).mean() >= 0.75


def test_the_human_goes_the_shorter_way_round_and_on_from_the_previous_action(hands: MujocoFleet) -> None:
    obs, human = hands.task.observe(hands.physics.frame).copy(), Turner()
    obs[:, 68:72] = about_vertical(np.array([1.0, -1.0, 3.0, -3.0])) * SCALE[68:72]
    reaches = np.full(4, np.inf)
    for k in range(2 * CYCLE):
        action = np.asarray(human.act(obs), dtype=np.float64)
        if k:
            assert np.abs(action - obs[:, 72:88]).max() < RATE + 1e-5
            heed = features(obs[:, 48:51] / SCALE[48:51], obs[:, 51:55])
            for row, side in zip(range(4), ("right", "left", "right", "left"), strict=True):
                gait = shipped()[side]
                choices = (gait.period + heed[row] @ gait.feedback).clip(-1, 1)
                gap = np.abs(choices - action[row]).max(axis=1).min()
                reaches[row] = min(reaches[row], gap)
        obs[:, 72:88] = action
    assert (reaches < 0.05).all(), "each hand is in its gait after a while"
    assert np.abs(np.asarray(human.act(obs)) - action).max() > 0.05, "it does not stand still"


def test_the_human_reaches_goal_after_goal_in_calm() -> None:
    fleet = MujocoFleet("AllegroHand", 10, disturbance="none", threads=1)
    _, reached, dropped = work(fleet, Turner(), fleet.reset(seed=1)[0], 200)
    fleet.close()
    assert (reached > 0).mean() >= 0.9
    assert reached.sum() > 5 * max(1, dropped.sum())


def test_the_task_names_its_human_and_what_it_scores(hands: MujocoFleet) -> None:
    actor, card = experts.load("AllegroHand")
    assert isinstance(actor, Turner)
    check_policy(actor, hands)
    for level in ("none", TASKS["AllegroHand"].disturbance):
        assert card["scores"][level]["success"] > 0.9


# -- how it was found -------------------------------------------------------------------------------------------------


def test_evolution_finds_the_top_of_a_hill() -> None:
    top = np.array([1.0, -2.0, 0.5])
    evolution = Evolution(np.zeros(3), np.ones(3), 0.3, 12, np.random.default_rng(0))
    for _ in range(120):
        evolution.tell(-np.square((evolution.ask() - top) * [1, 3, 10]).sum(axis=1))
    np.testing.assert_allclose(evolution.mean, top, atol=1e-3)


def test_candidates_are_tried_from_the_same_starts() -> None:
    gait = shipped()["left"].numbers
    trial = Trial(2, 3, 20, "left")
    turned, lost = trial.run(np.stack([gait, gait])[:, None], np.random.default_rng(0), 0.2)
    np.testing.assert_array_equal(turned[0], turned[1])
    np.testing.assert_array_equal(lost[0], lost[1])


def test_a_search_writes_a_gait_beside_the_other_one_and_begins_from_it_again(tmp_path: Path) -> None:
    out = tmp_path / "gaits.json"
    out.write_text(json.dumps({"right": {"numbers": [0.0]}}))
    small = {"calm": 2, "noisy": 1, "candidates": 4, "starts": 1, "steps": 5, "out": out}
    found = search(SearchConfig("left", **small))  # type: ignore[arg-type]
    written = json.loads(out.read_text())
    assert set(written) == {"left", "right"}
    np.testing.assert_allclose(Gait.of(written["left"]["numbers"]).numbers, found[0], atol=1e-4)
    again = search(SearchConfig("left", again=True, **small))  # type: ignore[arg-type]
    assert 0 < np.abs(again - found).max() < 1
    out.write_text(json.dumps(written | {"right": written["left"]}))
    assert search(SearchConfig("both", **small)).shape == (2, *again[0].shape)  # type: ignore[arg-type]
    assert json.loads(out.read_text())["right"] != written["left"]


def test_both_gaits_take_turns_from_goal_to_goal() -> None:
    trial = Trial(1, 6, 120, None)
    turned, _ = trial.run(np.stack([shipped()[side].numbers for side in SIDES])[None], np.random.default_rng(0), 0.0)
    assert np.median(turned) > 2.5
