"""Settings: what cannot work is refused, and what was stored comes back as it was."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.errors import ConfigError, RunFolderError, TutelageError
from tutelage.experiments.config import RunConfig, from_json, to_json
from tutelage.fleet.priority import PriorityConfig
from tutelage.learning.imitation import LearnerConfig


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": 0}, "robots must be at least 1, got 0"),
        ({"humans": 0}, "humans must be at least 1, got 0"),
        ({"robots": 2, "humans": 3}, "3 humans for 2 robots: use at most one human a robot (M <= N)"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"t_teleop": 0}, "t_teleop must be at least 1, got 0"),
        ({"t_reset": 0}, "t_reset must be at least 1, got 0"),
        ({"latency": -1}, "latency must be at least 0, got -1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"supervisor_noise": float("nan")}, "supervisor_noise must be a number >= 0, got nan"),
        ({"supervisor_noise": float("inf")}, "supervisor_noise must be a number >= 0, got inf"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"hidden": (16, 0)}, "hidden layers must be at least 1 wide, got (16, 0)"),
        ({"record": "some"}, "unknown record 'some': use human, all or none"),
        ({"checkpoint_every": 0}, "checkpoint_every must be at least 1, got 0"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RunConfig("Walker2d", **changes)
    assert str(caught.value) == message


def test_the_folder_is_named_after_task_priority_and_seed() -> None:
    assert RunConfig("Walker2d", seed=3).folder == Path("runs/Walker2d-C.U.R-s3")
    assert RunConfig("my.robots:make", priority="C.").folder == Path("runs/my.robots.make-C-s0")
    assert RunConfig("Walker2d", priority="my.ideas:Mine").folder == Path("runs/Walker2d-my.ideas.Mine-s0")
    assert RunConfig("Walker2d", out=Path("here")).folder == Path("here")


def test_reports_name_the_priority_unless_there_is_a_label() -> None:
    assert RunConfig("Walker2d", priority="U.C.").algorithm == "U.C."
    assert RunConfig("Walker2d", label="ours").algorithm == "ours"


@given(
    robots=st.integers(1, 10**6),
    hidden=st.lists(st.integers(1, 512), max_size=3).map(tuple),
    noise=st.floats(0, 1e300),
    level=st.none() | st.text(),
    out=st.none() | st.just(Path("a/b c")),
    uncertainty=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    schedule=st.sampled_from(["step", "episode", "scratch", "never"]),
    bootstrap=st.booleans(),
)
def test_a_configuration_comes_back_from_json_as_it_was(
    robots: int,
    hidden: tuple[int, ...],
    noise: float,
    level: Any,
    out: Any,
    uncertainty: Any,
    schedule: Any,
    bootstrap: bool,
) -> None:
    config = RunConfig(
        "Walker2d", robots=robots, humans=1, hidden=hidden, supervisor_noise=noise, disturbance=level, out=out,
        thresholds=PriorityConfig(uncertainty=uncertainty), learner=LearnerConfig(schedule=schedule), bootstrap=bootstrap,
    )  # fmt: skip
    text = json.dumps(to_json(config))
    assert from_json(RunConfig, json.loads(text)) == config


def test_numbers_of_numpy_are_stored_as_numbers() -> None:
    config = RunConfig("Walker2d", robots=np.int64(6), humans=np.int32(2), supervisor_noise=np.float32(0.5))  # type: ignore[arg-type]
    assert from_json(RunConfig, to_json(config)) == config


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(RunConfig)])
@pytest.mark.parametrize("value", [[], {"a": 1}, "six", 2.5, True, None, [None], -1])
def test_a_stored_value_of_the_wrong_kind_is_refused_in_one_line_or_is_fine(name: str, value: Any) -> None:
    values = {**to_json(RunConfig("Walker2d")), name: value}
    try:
        config = from_json(RunConfig, values)
    except TutelageError as error:
        assert "\n" not in str(error)
        return
    assert to_json(config)[name] == value, "accepted, so it is kept as it is"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": "six"}, "a setting has the wrong kind: robots cannot be 'six'"),
        ({"robots": True}, "a setting has the wrong kind: robots cannot be True"),
        ({"steps": 50.5}, "a setting has the wrong kind: steps cannot be 50.5"),
        ({"task": None}, "a setting has the wrong kind: task cannot be None"),
        ({"record": "some"}, "a setting has the wrong kind: record cannot be 'some'"),
        ({"hidden": ["a"]}, "a setting has the wrong kind: hidden cannot be 'a'"),
        ({"learner": {"batch": "big"}}, "a setting has the wrong kind: batch cannot be 'big'"),
        (
            {"wings": 2, "fins": 1},
            "unknown settings ['fins', 'wings']: the folder was written by another version of Tutelage",
        ),
    ],
)
def test_the_message_names_the_setting(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(RunFolderError) as caught:
        from_json(RunConfig, {**to_json(RunConfig("Walker2d")), **changes})
    assert str(caught.value) == message


def test_a_setting_that_is_missing_has_its_default_and_the_task_has_none() -> None:
    assert from_json(RunConfig, {"task": "Ant"}) == RunConfig("Ant")
    with pytest.raises(RunFolderError, match="missing 1 required positional argument: 'task'"):
        from_json(RunConfig, {})
