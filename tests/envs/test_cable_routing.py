"""Cable routing: a cable that pegs hold, logical obstacles, a goal that is a matter of geometry, images, and a human."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env, check_policy
from tutelage.envs import experts
from tutelage.envs.experts.cable_routing import CableRouter, stages, way
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.registry import make_fleet
from tutelage.envs.tasks import TASKS, GoalTask
from tutelage.envs.tasks.cable_routing import (
    KEEP_OUT,
    LINK,
    LINKS,
    PEGS,
    REACH,
    START,
    STEP,
    CableRouting,
    figure_eight,
    project,
    splits,
    turns,
)
from tutelage.errors import ConfigError
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.prepare import demonstrations


@pytest.fixture
def cables() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("CableRouting", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def work(fleet: MujocoFleet, obs: Any, steps: int) -> tuple[Any, Any, int]:
    """The human works until all have succeeded or violated: last observation, who succeeded, timesteps."""
    human, complete = CableRouter(), np.zeros(fleet.num_envs, dtype=bool)
    for t in range(steps):
        obs, _, _, _, info = fleet.step(human.act(obs))
        complete |= info["success"]
        if (complete | info["violation"]).all():
            return obs, complete, t + 1
    return obs, complete, steps


def cable_of(obs: Any) -> Any:
    """Joints of the cable, (N, 30, 2), from the gripper to the free end."""
    return np.concatenate([obs[:, :2], obs[:, 10:]], axis=1).reshape(-1, LINKS, 2)


def path(*corners: tuple[float, float], points: int = 20) -> Any:
    """A path (1, P, 2), m, along straight lines between corners in cm."""
    pieces = [np.linspace(a, b, points, endpoint=False) for a, b in zip(corners, corners[1:], strict=False)]
    return np.concatenate([*pieces, [corners[-1]]])[None] / 100


# The pegs stand at (+-2, +-2) cm. In through the gate on the left, counter-clockwise around the upper pair.
UPPER = [(-9, 0), (0, 0), (3, 1), (3, 3), (-3, 3), (-3, 1)]
LOWER = [(0, -0.5), (3, -1), (3, -3), (-3, -3), (-3, -1)]
CLOSED = [(-1, 0.3), (1, 0.3)]


# -- success --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("corners", "good"),
    [
        pytest.param([*UPPER, *LOWER, *CLOSED], True, id="figure eight"),
        pytest.param([(x, -y) for x, y in [*UPPER, *LOWER, *CLOSED]], True, id="lower loop first"),
        pytest.param([(-x, y) for x, y in [*UPPER, *LOWER, *CLOSED]], True, id="from the right"),
        pytest.param([*UPPER, (3, 0), *UPPER[2:], *LOWER, *CLOSED], True, id="twice around the upper pegs"),
        pytest.param([*UPPER, *LOWER[:-1], (-3, -2.5)], False, id="not closed"),
        pytest.param([*UPPER, *LOWER[:3]], False, id="half of the lower loop"),
        pytest.param([*UPPER, (0, 0)], False, id="one loop"),
        pytest.param([(-9, 0), (-3, -3), (3, -3), (3, 3), (-3, 3), (-3, -3), (0, -4)], False, id="one loop around all"),
        pytest.param(
            [*UPPER, (0, 0), (-3, -1), (-3, -3), (3, -3), (3, -1), (0, -0.5), (-3, -1), (-2, -3)],
            False,
            id="loops, not an eight",
        ),
        pytest.param(
            [*UPPER[:4], (0, 3), (0, 1), (-1, 1), (-1, 3), *UPPER[4:], *LOWER, *CLOSED], False, id="between a pair"
        ),
        pytest.param([(-9, 0), (4, 0)], False, id="straight"),
        pytest.param([(-30, -10), (-4, 0)], False, id="as it starts"),
    ],
)
def test_a_figure_eight(corners: list[tuple[float, float]], good: bool) -> None:
    assert figure_eight(path(*corners)).tolist() == [good]
    if all(abs(y) > 0.5 or x < 5 for x, y in corners):
        moved = path(*corners) + np.random.default_rng(0).uniform(-1e-4, 1e-4, (1, 1, 2))
        assert figure_eight(moved).tolist() == [good], "not a matter of tenths of a millimetre"


def test_a_figure_eight_does_not_depend_on_how_finely_the_path_is_drawn() -> None:
    corners = [*UPPER, *LOWER, *CLOSED]
    for points in (2, 3, 7, 100):
        assert figure_eight(path(*corners, points=points)).all()


def test_turns_are_signed_and_counted_from_end_to_end() -> None:
    angle = np.linspace(0, 2 * np.pi * 1.75, 60)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = np.stack([PEGS[1] + 0.01 * circle, PEGS[1] + 0.01 * circle[::-1]])
    np.testing.assert_allclose(turns(around)[:, 1], [1.75, -1.75])
    assert (np.abs(turns(around)[:, [0, 2, 3]]) < 0.2).all(), "the others are not inside"
    np.testing.assert_allclose(turns(path(*UPPER, *LOWER, *CLOSED)).round(), [[1, 1, -1, -1]])


def test_a_line_splits_a_pair_only_between_its_pegs() -> None:
    start, end = np.array([[0, 0], [0, 0], [-3, 0], [0, 0], [0, 3]]), np.array([[0, 3], [0, 1.9], [-3, 3], [0, -3], [0, -3]])
    assert splits(start / 100, end / 100).tolist() == [True, False, False, True, True]


def test_success_ends_the_episode_with_reward_one() -> None:
    fleet = MujocoFleet("CableRouting", 2, disturbance="none", threads=1)
    obs, human, total = fleet.reset(seed=0)[0], CableRouter(), np.zeros(2)
    assert isinstance(fleet.task, GoalTask)
    ended = np.zeros(2, dtype=bool)
    for _ in range(fleet.horizon):
        before = obs
        obs, reward, terminated, _, info = fleet.step(human.act(obs))
        total += reward
        assert np.array_equal(obs[ended], before[ended]), "it stands still"
        assert not terminated.any()
        assert np.array_equal(reward == 1, info["success"])
        ended |= info["success"]
    assert total.tolist() == [1, 1]
    assert figure_eight(cable_of(obs)[:, ::-1]).all()
    fleet.close()


# -- actions --------------------------------------------------------------------------------------------------------


def test_a_step_into_a_logical_obstacle_ends_at_the_nearest_point_of_its_border() -> None:
    start = np.array([[0.02, 0.032], [0.01, 0.01], [0.01, 0.0], [0.02, 0.035], [0.01, 0.02], [0.02, -0.01]])
    end = np.array([[0.02, 0.025], [0.017, 0.016], [0.0, 0.0], [0.02, 0.0305], [0.023, 0.022], [0.0201, -0.025]])
    side = 0.01 * np.sqrt(0.75)
    expected = [[0.02, 0.03], [0.014, 0.012], [0, 0], [0.02, 0.0305], [0.015, 0.02 + side], [0.02 + side, -0.015]]
    np.testing.assert_allclose(project(start, end), np.array(expected), atol=1e-12)
    middle = project(np.array([[-0.02, -0.005]]), np.array([[-0.02, -0.02]]))
    assert np.linalg.norm(middle - PEGS[2]) == pytest.approx(KEEP_OUT), "which has no nearest point"


def test_commands_are_one_centimetre_at_most_inside_the_workspace_and_outside_the_obstacles() -> None:
    rng, task = np.random.default_rng(0), CableRouting()
    frame = {"xpos": np.zeros((500, 2 + LINKS, 3))}
    anywhere = rng.uniform(-REACH, REACH, (500, 2))
    gripper = project(anywhere, anywhere)
    frame["xpos"][:, 2, :2] = gripper
    commands = task.control(frame, rng.uniform(-1, 1, (500, 2)))
    assert (np.abs(commands) <= REACH).all()
    gaps = np.linalg.norm(commands[:, None] - PEGS, axis=2)
    assert gaps.min() > KEEP_OUT - 1e-9
    free = gaps.min(axis=1) > KEEP_OUT + 1e-9
    assert (np.abs(commands - gripper)[free] <= STEP + 1e-12).all()
    assert free.sum() > 300
    assert (~free).sum() > 20


@pytest.mark.parametrize("axis", [0, 1])
def test_an_action_moves_the_gripper_by_a_step(cables: MujocoFleet, axis: int) -> None:
    before = cables.step(np.zeros((4, 2)))[0]
    action = np.zeros((4, 2))
    action[:, axis] = [1, -1, 0.5, 0]
    action[1, axis] *= 0.5  # the border is near
    after = cables.step(action)[0]
    np.testing.assert_allclose((after - before)[:, :2], STEP * action, atol=0.0008)


def test_the_gripper_slides_around_the_obstacles_and_never_enters_them(cables: MujocoFleet) -> None:
    cables.horizon = 1000
    rng = np.random.default_rng(1)
    nearest, steps = np.inf, []
    before = cables.reset(seed=1)[0]
    for _ in range(25):
        toward = PEGS[np.arange(4)] - before[:, :2] + rng.normal(0, 0.004, (4, 2))
        obs = cables.step(np.clip(toward / STEP, -1, 1))[0]
        steps.append(np.abs(obs - before)[:, :2].max())
        gaps = np.linalg.norm(obs[:, 2:10].reshape(4, 4, 2), axis=2)
        nearest, before = min(nearest, gaps.min()), obs
    assert KEEP_OUT - 0.0005 < nearest < KEEP_OUT + 0.0005
    assert max(steps) < 1.3 * STEP, "to the border it may be a little more"


# -- the cable ------------------------------------------------------------------------------------------------------


def test_observations_are_what_the_task_says(cables: MujocoFleet) -> None:
    obs, _, _ = work(cables, cables.reset(seed=1)[0], 20)
    assert obs.shape == (4, 68)
    for data, row in zip(cables.physics.datas, obs, strict=True):
        names = ["cable", *(f"link {k}" for k in range(1, LINKS))]
        joints = np.array([data.body(name).xpos[:2] for name in names])
        np.testing.assert_array_equal(row[:2], joints[0])
        np.testing.assert_allclose(row[2:10], (joints[0] - PEGS).ravel())
        np.testing.assert_array_equal(row[10:], joints[1:].ravel())
        np.testing.assert_allclose(joints[0], data.qpos[:2], atol=1e-3)
    for peg, xy in enumerate(PEGS):
        cores = [g for g in range(cables.physics.model.ngeom) if np.allclose(cables.physics.model.geom_pos[g, :2], xy)]
        assert len(cores) >= 2, f"peg {peg} is where the task thinks it is"


def test_the_cable_starts_in_about_the_same_shape_outside_the_workspace() -> None:
    fleet = MujocoFleet("CableRouting", 50, disturbance="none", threads=1)
    cable = cable_of(fleet.reset(seed=0)[0])
    assert (np.abs(cable[:, 0] - START) <= 0.0031).all()
    assert (cable[:, 2:, 0] < -REACH).all()
    assert cable[:, 5].std(axis=0).min() > 0.0005
    assert cable[:, -1].std(axis=0).max() < 0.08
    np.testing.assert_allclose(np.linalg.norm(np.diff(cable, axis=1), axis=2), LINK)
    fleet.close()


def test_the_cable_lies_flat_keeps_its_length_and_does_not_pass_through_pegs() -> None:
    fleet = MujocoFleet("CableRouting", 4, disturbance="strong", threads=1)
    obs, human = fleet.reset(seed=4)[0], CableRouter()
    touched = 0
    for _ in range(45):
        obs = fleet.step(human.act(obs))[0]
        cable = cable_of(obs)
        height = fleet.physics.frame["xpos"][:, 2:, 2]
        assert (np.abs(height) < 0.012).all()
        assert np.median(height) < 0.002
        assert (np.linalg.norm(np.diff(cable, axis=1), axis=2) < 1.001 * LINK).all()
        # Between joints as well: the middle of a peg is never nearer than its radius, less a little softness.
        fine = np.linspace(cable[:, :-1], cable[:, 1:], 9).reshape(-1, 2)
        gaps = np.linalg.norm(fine[:, None] - PEGS, axis=2).min()
        assert gaps > 0.0045
        touched += gaps < 0.0068
    assert touched > 20, "pegs hold the cable"
    fleet.close()


def test_it_is_a_violation_if_the_free_end_is_drawn_in_or_the_cable_leaves_the_table() -> None:
    task = CableRouting()
    positions = np.zeros((4, 2 + LINKS, 3))
    positions[:, 2:, 0] = np.linspace(-0.04, -0.38, LINKS)
    positions[1, -1] = [0.01, 0.03, 0.0]
    positions[2, 9] = [0.0, 0.31, 0.0]
    positions[3, 9] = [0.0, 0.1, -0.03]
    assert task.violation({"xpos": positions}).tolist() == [False, True, True, True]


# -- the fleet ------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*cannot be checked.*", "ignore::UserWarning")
def test_it_keeps_the_contract_of_a_fleet() -> None:
    fleet = MujocoFleet("CableRouting", 3, threads=1)
    fleet.horizon = 12
    check_env(fleet, steps=30)
    fleet.close()


def test_the_same_seed_gives_the_same_numbers_with_any_number_of_threads_and_a_state_continues_bit_for_bit() -> None:
    fleets = [MujocoFleet("CableRouting", 3, threads=threads) for threads in (1, 2)]
    rng = np.random.default_rng(0)
    first, second = (fleet.reset(seed=5)[0] for fleet in fleets)
    assert np.array_equal(first, second)
    for t in range(16):
        if t == 8:
            state = fleets[0].state_dict()
            fleets[1].step(rng.uniform(-1, 1, (3, 2)))
            fleets[1].load_state_dict(state)
        actions = rng.uniform(-1, 1, (3, 2))
        first, second = (fleet.step(actions)[0] for fleet in fleets)
        assert np.array_equal(first, second)
    for fleet in fleets:
        fleet.close()


# -- the human ------------------------------------------------------------------------------------------------------


def test_the_human_succeeds_at_the_tasks_level_in_about_as_many_timesteps_as_the_dissertations() -> None:
    fleet = MujocoFleet("CableRouting", 6, threads=1)
    assert fleet.disturbance.noise > 0
    _, complete, steps = work(fleet, fleet.reset(seed=11)[0], fleet.horizon)
    assert complete.all()
    assert 40 < steps < 80
    fleet.close()


def test_the_human_takes_back_what_was_laid_wrong() -> None:
    """Clockwise around the first peg, between the upper pair, around a lower peg first, and anything at all."""
    fleet = MujocoFleet("CableRouting", 4, disturbance="none", threads=1)
    fleet.horizon = 300
    wrong = [
        [(-3.5, 2), (-2, 3.5), (0, 3)],
        [(0, 0), (0, 3.5)],
        [(-3.5, -2), (-2, -3.5), (0, -3.5)],
        [(0, 0), (0, -3.5), (-3.4, -3)],
    ]
    obs, _ = fleet.reset(seed=2)
    for corners in zip(*(w + w[-1:] * (3 - len(w)) for w in wrong), strict=True):
        for _ in range(8):
            obs = fleet.step(np.clip((np.array(corners) / 100 - obs[:, :2]) / STEP, -1, 1))[0]
    assert stages(cable_of(obs)[:, ::-1]).tolist() == [7, 10, 11, 5], "each has crossed what the figure does not"
    _, complete, _ = work(fleet, obs, 150)
    assert complete.all()
    fleet.close()


def test_the_map_knows_a_way_from_everywhere_outside_the_obstacles() -> None:
    left = way()
    free = np.isfinite(left[0])
    assert 0.7 < free.mean() < 1
    for stage in (0, 1, 2, 3, *range(4, 8), *range(9, 13)):
        assert np.array_equal(np.isfinite(left[stage]), free)
    start = left[0, 3, 13]  # nothing done yet, at (-3.8, 0.2) cm
    assert 0.33 < start < 0.45, "about 38 cm: longer than the cable, but it takes short cuts at the pegs"


def test_the_human_knows_what_is_next_from_how_the_cable_lies() -> None:
    cases = [
        ([], 0),
        (UPPER, 1),
        ([(x, -y) for x, y in UPPER], 2),
        ([*UPPER, *LOWER], 3),
        ([(x, -y) for x, y in [*UPPER, *LOWER, *CLOSED]], 3),
        ([(0, 0), (0, 3)], 8 + 2),  # up between the upper pair
        ([(0, 0), (0, 3), (0, 1)], 0),  # and back again
        ([(-3, 1), (-3, 3), (0, 3)], 8 - 1),  # over the upper pegs from the left
        ([*UPPER, *UPPER[1:]], 8 + 1),  # once more than wanted
        ([*UPPER, (0, 0), (0, -3)], 8 - 4),
    ]
    for corners, stage in cases:
        assert stages(path((-9, 0), (-4, 0), *corners)).tolist() == [stage]


def test_the_human_looks_at_each_row_alone(cables: MujocoFleet) -> None:
    check_policy(CableRouter(), cables)


def test_a_task_names_its_human_and_its_scores_are_shipped() -> None:
    actor, card = experts.load("CableRouting")
    assert isinstance(actor, CableRouter)
    for level in ("none", TASKS["CableRouting"].disturbance):
        assert card["scores"][level]["success"] > 0.95
        assert card["scores"][level]["episodes"] >= 100


def test_a_run_starts_with_the_humans_demonstrations() -> None:
    config = RunConfig("CableRouting", disturbance="none", offline_pairs=60, threads=1)
    obs, actions = demonstrations(config, CableRouter(), TASKS["CableRouting"].horizon)[:2]
    assert obs.shape[1:] == (68,)
    assert actions.shape[1:] == (2,)
    assembly = assemble(RunConfig("CableRouting", priority="U.G.C.", robots=2, humans=1, threads=1, torch_threads=1))
    assert isinstance(assembly.actor, CableRouter)
    assert assembly.config.offline_pairs == 1381
    assembly.fleet.close()


# -- images ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def seeing(opengl: None) -> Iterator[MujocoFleet]:
    fleet = make_fleet("CableRouting", 3, disturbance="none", threads=1, observation="images")
    assert isinstance(fleet, MujocoFleet)
    yield fleet
    fleet.close()


def red(images: Any) -> Any:
    """Where the cable is seen, (..., H, W)."""
    return (images[..., 0] > 100) & (images[..., 1] < 80) & (images[..., 2] < 80)


@pytest.mark.render
def test_images_are_what_is_observed_and_the_state_is_beside_them(seeing: MujocoFleet) -> None:
    images, info = seeing.reset(seed=0)
    assert (images.shape, images.dtype) == ((3, 64, 64, 3), np.uint8)
    assert seeing.single_observation_space.contains(images[0])
    human, first = CableRouter(), images.copy()
    blind = MujocoFleet("CableRouting", 3, disturbance="none", threads=1)
    assert np.array_equal(info["state"], blind.reset(seed=0)[0])
    complete = np.zeros(3, dtype=bool)
    for _ in range(55):
        given = images
        actions = human.act(info["state"])
        images, _, _, _, info = seeing.step(actions)
        assert np.array_equal(info["state"], blind.step(actions)[0]), "who looks does not change what happens"
        complete |= info["success"]
    assert complete.all()
    assert np.array_equal(given, images), "a robot that stands still sees the same"
    assert (red(images).sum(axis=(1, 2)) > 3 * red(first).sum(axis=(1, 2))).all(), "the cable is in the picture now"
    rows, columns = np.nonzero(red(images).any(axis=0))
    assert rows.max() - rows.min() > 20
    assert columns.max() - columns.min() > 40
    blind.close()


@pytest.mark.render
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_fleet_that_observes_images_keeps_the_contract(seeing: MujocoFleet) -> None:
    seeing.horizon = 10
    check_env(seeing, steps=12)
    some = seeing.images([2, 0])
    assert np.array_equal(some, seeing.images()[[2, 0]])


def test_what_is_observed_is_state_or_images() -> None:
    with pytest.raises(ConfigError, match="observation must be"):
        MujocoFleet("CableRouting", 1, observation="sound")  # type: ignore[arg-type]
