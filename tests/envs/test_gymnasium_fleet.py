"""Any Gymnasium environment as a fleet, whether it comes alone or as a vector."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from fakes import FakePolicy, FakeSupervisor
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from tutelage.checks import check_env
from tutelage.envs.gymnasium_fleet import GymnasiumFleet, Outcome
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.events import Events
from tutelage.fleet.loop import Loop
from tutelage.fleet.modes import Event
from tutelage.fleet.priority import Constraint, Lexicographic, PriorityConfig
from tutelage.fleet.supervisor import Team


class Rail(gym.Env[Any, Any]):
    """A cart on a rail, obs (position, timesteps). It falls off (terminates) beyond 1 and arrives (terminates) below -1."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, image: bool = False, render_mode: str | None = None) -> None:
        self.image, self.render_mode = image, render_mode
        self.action_space = gym.spaces.Box(-0.4, 0.4, (1,), dtype=np.float64)
        self.observation_space = (
            gym.spaces.Box(0, 255, (8, 8, 3), np.uint8) if image else gym.spaces.Box(-9, 99, (2,), np.float32)
        )
        self.x, self.t = 0.0, 0

    def look(self) -> Any:
        if self.image:
            return np.full((8, 8, 3), 100 + 40 * self.x, dtype=np.uint8)
        return np.array([self.x, self.t], dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-0.1, 0.1)), 0
        return self.look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.dtype == np.float64
        assert abs(self.x) < 1, "stepped after the end of an episode"
        self.x, self.t = self.x + float(action[0]), self.t + 1
        return self.look(), 1.0, abs(self.x) >= 1, False, {"x": self.x}

    def render(self) -> Any:
        return np.full((4, 6, 3), 128, dtype=np.uint8)


def fell(outcome: Outcome) -> Any:
    x = np.asarray(outcome.info.get("x", np.zeros(len(outcome.reward))))
    return x >= 1


def arrived(outcome: Outcome) -> Any:
    x = np.asarray(outcome.info.get("x", np.zeros(len(outcome.reward))))
    return x <= -1


def singles(n: int, **kwargs: Any) -> GymnasiumFleet:
    return GymnasiumFleet(Rail, num_envs=n, violation=fell, success=arrived, **{"horizon": 12, **kwargs})


def vector(n: int, kind: Any = SyncVectorEnv, **kwargs: Any) -> GymnasiumFleet:
    env = kind([Rail] * n, autoreset_mode=AutoresetMode.DISABLED)
    return GymnasiumFleet(env, violation=fell, success=arrived, horizon=12, **kwargs)


MAKERS: list[Callable[[int], GymnasiumFleet]] = [singles, vector, lambda n: vector(n, AsyncVectorEnv)]


@pytest.mark.parametrize("make", MAKERS, ids=["singles", "sync vector", "async vector"])
def test_adapted_fleets_keep_the_contract(make: Callable[[int], GymnasiumFleet]) -> None:
    fleet = make(3)
    check_env(fleet, steps=60)
    fleet.close()


def test_images_keep_the_contract() -> None:
    fleet = singles(3, image=True)
    check_env(fleet, steps=60)
    assert fleet.reset(seed=0)[0].shape == (3, 8, 8, 3)


@pytest.mark.parametrize("make", MAKERS, ids=["singles", "sync vector", "async vector"])
def test_a_fall_an_arrival_and_the_horizon(make: Callable[[int], GymnasiumFleet]) -> None:
    fleet = make(3)
    fleet.reset(seed=0)
    actions = np.array([[0.4], [-0.4], [0.0]], dtype=np.float32)
    ends: dict[str, list[int]] = {"violation": [], "success": [], "truncated": []}
    rest = None
    for t in range(1, 13):
        obs, reward, terminated, truncated, info = fleet.step(actions)
        for name, flag in (("violation", info["violation"]), ("success", info["success"]), ("truncated", truncated)):
            ends[name] += [t * 10 + robot for robot in np.flatnonzero(flag)]
        if info["violation"].any() and rest is None:
            rest = obs[0]
        if rest is not None:
            assert np.array_equal(obs[0], rest), "a robot that fell stands still"
            assert terminated[0]
            assert info["elapsed"][0] in (3, 4)
    first = ends["violation"][0]
    assert first in (30, 20)
    assert ends["violation"] == list(range(first, 130, 10)), "in violation until it is reset"
    assert ends["success"] in ([31], [21]), "success comes once"
    assert ends["truncated"] == [122]
    assert reward.tolist() == [0.0, 0.0, 1.0]

    obs, info = fleet.reset(options={"reset_mask": np.array([True, False, False])})
    assert abs(obs[0, 0]) <= 0.1
    assert obs[0, 1] == 0
    assert not info["violation"].any()
    assert fleet.step(actions)[0][0, 1] == 1, "a reset robot starts a new episode"
    fleet.close()


def test_an_end_that_is_neither_violation_nor_success_starts_the_robot_anew() -> None:
    nobody = lambda outcome: np.zeros(2, dtype=bool)  # noqa: E731
    fleet = GymnasiumFleet(Rail, num_envs=2, violation=nobody, success=nobody, horizon=50)
    fleet.reset(seed=0)
    while not (result := fleet.step(np.full((2, 1), 0.4, dtype=np.float32)))[3].any():
        pass
    assert result[2].any()
    assert not result[4]["violation"].any()
    assert fleet.step(np.zeros((2, 1)))[1][result[3]].tolist() == [0.0] * result[3].sum(), "over until it is reset"


def test_a_violation_need_not_be_an_end_for_the_environment() -> None:
    for fleet in (
        GymnasiumFleet(Rail, num_envs=2, violation=lambda o: o.obs[:, 0] > 0.3, success=arrived, horizon=20),
        GymnasiumFleet(
            SyncVectorEnv([Rail] * 2, autoreset_mode=AutoresetMode.DISABLED),
            violation=lambda o: o.obs[:, 0] > 0.3,
            success=arrived,
            horizon=20,
        ),
    ):
        check_env(fleet)


def test_a_success_that_the_environment_does_not_notice_ends_the_episode_once() -> None:
    fleet = GymnasiumFleet(Rail, num_envs=2, violation=fell, success=lambda o: o.obs[:, 0] > 0.3, horizon=20)
    fleet.reset(seed=0)
    results = [fleet.step(np.array([[0.2], [0.0]])) for _ in range(5)]
    assert sum(result[4]["success"] for result in results).tolist() == [1, 0]
    assert results[-1][0][0, 1] < 4, "it stands still from then on"
    assert not any(result[4]["violation"].any() for result in results)


@pytest.mark.parametrize("make", MAKERS, ids=["singles", "sync vector", "async vector"])
def test_the_loop_sends_people_to_robots_that_fell_and_restarts_the_others(make: Callable[[int], GymnasiumFleet]) -> None:
    fleet = make(4)
    drift = FakePolicy()
    drift.act = lambda obs: np.array([[0.4], [0.4], [-0.4], [0.0]], dtype=np.float32)  # type: ignore[method-assign]
    priority = Lexicographic("C.", [Constraint(PriorityConfig())])
    loop = Loop(fleet, drift, priority, Team([FakeSupervisor()]), FleetDAgger(5, 3))
    events = Events.concatenate([loop.step().events for _ in range(60)])
    who = {kind: set(events.of(kind).robot.tolist()) for kind in Event}
    assert who[Event.VIOLATE] == who[Event.HARD_RESET] == {0, 1}
    assert who[Event.SUCCESS] == {2}
    assert who[Event.TIMEOUT] == {3}
    assert len(events.of(Event.TIMEOUT).t) == 60 // 12
    fleet.close()


def test_a_single_environment_is_what_it_is_outside() -> None:
    """The adapter around Gymnasium's Walker2d against the native fleet, from the same states."""
    native = MujocoFleet("Walker2d", 3, disturbance="none", threads=1)
    adapted = GymnasiumFleet(
        "Walker2d-v5", num_envs=3, violation=lambda o: o.terminated, success=lambda o: o.truncated, horizon=60
    )
    assert adapted.horizon == 60
    native.reset(seed=0)
    adapted.reset(seed=0)
    for i, env in enumerate(adapted._backend._envs):  # type: ignore[attr-defined]
        inner, data = env.unwrapped, native.physics.datas[i]
        mujoco.mj_resetData(inner.model, inner.data)
        inner.set_state(data.qpos, data.qvel)
    rng = np.random.default_rng(0)
    for _ in range(59):
        actions = rng.uniform(-1, 1, (3, 6)).astype(np.float32)
        ours, theirs = native.step(actions), adapted.step(actions)
        np.testing.assert_allclose(theirs[0], ours[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(theirs[1], ours[1], rtol=0, atol=1e-6)  # the control cost in float32
        for key in ("violation", "elapsed"):
            assert np.array_equal(theirs[4][key], ours[4][key])
    assert ours[4]["violation"].any()
    native.close()
    adapted.close()


def test_a_vector_fleet_is_the_fleet_of_its_parts() -> None:
    """Until the first fall, after which the unseen environments have drawn random numbers of their own."""
    fleets = [make(3) for make in MAKERS]
    starts = [fleet.reset(seed=4)[0] for fleet in fleets]
    rng = np.random.default_rng(0)
    for _ in range(4):
        actions = rng.uniform(-0.2, 0.2, (3, 1)).astype(np.float32)
        results = [fleet.step(actions) for fleet in fleets]
        for other in results[1:]:
            assert all(np.array_equal(a, b) for a, b in zip(results[0][:4], other[:4], strict=True))
    assert all(np.array_equal(starts[0], start) for start in starts)
    for fleet in fleets:
        fleet.close()


def test_time_stops_for_a_paused_single_but_a_vector_refuses() -> None:
    active = np.array([True, False])
    fleet = singles(2)
    fleet.reset(seed=0)
    obs, reward, _, _, info = fleet.step(np.full((2, 1), 0.1), active=active)
    assert obs[:, 1].tolist() == [1, 0]
    assert reward.tolist() == [1, 0]
    assert info["elapsed"].tolist() == [1, 0]
    stiff = vector(2)
    stiff.reset(seed=0)
    assert not stiff.can_pause
    with pytest.raises(ContractError, match="cannot pause"):
        stiff.step(np.zeros((2, 1)), active=active)
    with pytest.raises(ConfigError, match="cannot"):
        Loop(stiff, FakePolicy(), Lexicographic("C.", []), Team([FakeSupervisor()], latency=2))


def test_pictures_are_the_environments_own() -> None:
    fleet = singles(2, render_mode="rgb_array")
    pictures = fleet.render()
    assert pictures is not None
    assert [p.shape for p in pictures] == [(4, 6, 3)] * 2
    assert fleet.render_robot(1).shape == (4, 6, 3)
    blind = singles(2)
    assert blind.render() is None
    with pytest.raises(ConfigError, match="rgb_array"):
        blind.render_robot(0)


def test_it_cannot_be_checkpointed() -> None:
    fleet = singles(2)
    assert not fleet.can_checkpoint
    with pytest.raises(ConfigError, match="cannot be checkpointed"):
        fleet.state_dict()
    with pytest.raises(ConfigError, match="cannot be checkpointed"):
        fleet.load_state_dict({})


def test_wrong_verdicts_are_refused() -> None:
    for verdict, got in ((lambda o: True, r"\(\) bool"), (lambda o: o.reward, r"\(2,\) float64")):
        fleet = GymnasiumFleet(Rail, num_envs=2, violation=verdict, success=arrived, horizon=5)
        fleet.reset(seed=0)
        with pytest.raises(ContractError, match=rf"violation must return \(2,\) bool, got {got}"):
            fleet.step(np.zeros((2, 1)))


def test_wrong_calls_are_refused() -> None:
    fleet = singles(2)
    with pytest.raises(ContractError, match="reset the fleet"):
        fleet.step(np.zeros((2, 1)))
    with pytest.raises(ContractError, match="first reset"):
        fleet.reset(options={"reset_mask": np.array([True, False])})
    fleet.reset(seed=0)
    with pytest.raises(ContractError, match=r"robots \[1\] are not finite"):
        fleet.step(np.array([[0.0], [np.nan]]))


class Forgetful(SyncVectorEnv):
    """Resets everybody, whatever the mask."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=seed)


def test_a_vector_environment_that_ignores_the_mask_is_found_out() -> None:
    env = Forgetful([Rail] * 3, autoreset_mode=AutoresetMode.DISABLED)
    fleet = GymnasiumFleet(env, violation=fell, success=arrived, horizon=9)
    fleet.reset(seed=0)
    fleet.step(np.zeros((3, 1)))
    with pytest.raises(ConfigError, match="ignores reset_mask"):
        fleet.reset(options={"reset_mask": np.array([True, False, False])})


def dressed(**spaces: Any) -> Callable[[], Any]:
    def make() -> Any:
        env = Rail()
        for name, space in spaces.items():
            setattr(env, name, space)
        return env

    return make


@pytest.mark.parametrize(
    ("env", "settings", "message"),
    [
        (lambda: SyncVectorEnv([Rail] * 2), {}, "autoreset_mode=AutoresetMode.DISABLED"),
        (lambda: SyncVectorEnv([Rail] * 2, autoreset_mode=AutoresetMode.DISABLED), {"num_envs": 3}, "has 2 robots"),
        (lambda: SyncVectorEnv([Rail] * 2, autoreset_mode=AutoresetMode.DISABLED), {"image": True}, "cannot take image"),
        (lambda: "CartPole-v1", {"num_envs": 2}, "vectors of numbers"),
        (lambda: "Nothing-v0", {"num_envs": 2}, "cannot make the environment"),
        (lambda: Rail, {}, "num_envs=None"),
        (lambda: Rail, {"num_envs": 2, "horizon": None}, "say horizon="),
        (lambda: Rail, {"num_envs": 2, "horizon": 0}, "at least 1 timestep"),
        (lambda: Rail(), {"num_envs": 2}, "a function that makes one"),
        (lambda: dressed(action_space=gym.spaces.Box(-np.inf, np.inf, (1,))), {"num_envs": 2}, "finite bounds"),
        (
            lambda: dressed(observation_space=gym.spaces.Dict(x=gym.spaces.Discrete(2))),
            {"num_envs": 2},
            "FlattenObservation",
        ),
        (lambda: list, {"num_envs": 2}, "must make a gymnasium.Env, got list"),
    ],
)
def test_what_cannot_be_a_fleet_says_why(env: Callable[[], Any], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GymnasiumFleet(env(), violation=fell, success=arrived, **{"horizon": 5, **settings})
