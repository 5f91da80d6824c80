"""Levels by name or as a list, and pushes that come at random and last as long as they should."""

from __future__ import annotations

from dataclasses import asdict, fields
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tutelage.envs.disturbance import LEVELS, Disturbance, Pusher, parse
from tutelage.errors import ConfigError

NAMES = [f.name for f in fields(Disturbance)]
PARTS = st.tuples(st.sampled_from([*NAMES, "nois", "", " push "]), st.text(max_size=6) | st.floats().map(str))
VALID = st.fixed_dictionaries(
    {name: st.floats(0, 0.99) for name in ("noise", "push", "mass", "friction")}
    | {name: st.floats(0.01, 10) for name in ("push_seconds", "push_interval")}
)


@given(st.text(max_size=30) | st.lists(PARTS, max_size=3).map(lambda ps: ",".join(f"{n}={v}" for n, v in ps)))
@example("noise=nan")
@example("push=1e999")
@example("noise=-1")
@example("push=1,push_seconds=0")
@example("")
def test_any_text_is_a_disturbance_or_one_line_of_advice(text: str) -> None:
    try:
        level = parse(text)
    except ConfigError:
        return
    assert all(np.isfinite(value) and value >= 0 for value in asdict(level).values())


@given(VALID)
def test_a_list_says_what_it_says(values: dict[str, float]) -> None:
    assert parse(", ".join(f"{name}={value!r}" for name, value in values.items())) == Disturbance(**values)


def test_levels_grow() -> None:
    assert parse("none") == Disturbance()
    levels = [
        np.array([v for k, v in asdict(level).items() if k in ("noise", "push", "mass", "friction")])
        for level in LEVELS.values()
    ]
    assert all((b > a).all() for a, b in pairwise(levels))


def pushes(robots: int, steps: int, *, planar: bool = False, moving: np.ndarray | None = None) -> np.ndarray:
    level = Disturbance(push=0.5, push_seconds=0.1, push_interval=2.0)
    pusher = Pusher(level, weight=100.0, dt=0.02, num_robots=robots, planar=planar)
    rng = np.random.default_rng(0)
    always = np.ones(robots, dtype=bool)
    return np.array([pusher.step(rng, always if moving is None else moving).copy() for _ in range(steps)])


def test_pushes_are_memoryless_and_horizontal_with_the_asked_for_force() -> None:
    wrench = pushes(400, 1000)
    force = np.linalg.norm(wrench[..., :2], axis=-1)
    np.testing.assert_allclose(force[force > 0], 50.0)
    assert (wrench[..., 2:] == 0).all()
    # 5 steps of 0.02 s at a rate of one in 100 steps: pushed unless no push started in the last five steps.
    assert (force > 0).mean() == pytest.approx(1 - 0.99**5, rel=0.03)
    direction = wrench[force > 0][:, :2] / 50.0
    assert np.abs(direction.mean(axis=0)).max() < 0.05
    assert np.abs(np.cov(direction.T) - np.eye(2) / 2).max() < 0.05


def test_a_push_lasts_as_long_as_it_should() -> None:
    on = np.abs(pushes(50, 2000)).sum(axis=-1).T > 0
    on = on[~on[:, -1]]  # without those that the end of the test cut off
    lengths = [len(run) for row in on for run in "".join("x" if x else " " for x in row).split()]
    assert min(lengths) == 5
    assert np.median(lengths) == 5


def test_planar_robots_are_pushed_along_x() -> None:
    wrench = pushes(100, 500, planar=True)
    assert set(np.unique(wrench[..., 0])) == {-50.0, 0.0, 50.0}
    assert (wrench[..., 1:] == 0).all()


def test_no_push_passes_or_starts_while_a_robot_is_paused() -> None:
    pusher = Pusher(Disturbance(push=1.0, push_seconds=0.1, push_interval=0.02), 1.0, 0.02, 2, False)
    rng = np.random.default_rng(0)
    pusher.step(rng, np.array([True, False]))
    assert pusher.left.tolist() == [5, 0]
    pusher.step(rng, np.array([False, False]))
    assert pusher.left.tolist() == [5, 0]
    pusher.calm(np.array([True, False]))
    assert pusher.left.tolist() == [0, 0]
    assert (pusher.wrench == 0).all()
