"""check_env passes a fleet that keeps the contract and names the clause that is broken: one broken class for each clause."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fakes import POSITION, Good, PointFleet
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode

from tutelage.checks import check_env
from tutelage.errors import ConfigError, ContractError


class Steps(Good):
    """`change(obs, reward, terminated, truncated, info)` -> what `step` returns instead."""

    def change(self, *result: Any) -> Any:
        raise NotImplementedError

    def step_wait(self) -> Any:
        return self.change(*super().step_wait())


class Resets(Good):
    """`change(obs, info)` -> what `reset` returns instead."""

    def change(self, *result: Any) -> Any:
        raise NotImplementedError

    def reset(self, **kwargs: Any) -> Any:
        return self.change(*super().reset(**kwargs))


BROKEN: list[tuple[str, type[PointFleet]]] = []


def breaks(message: str) -> Any:
    """Note a class and what `check_env` must say about it."""

    def note(broken: type[PointFleet]) -> type[PointFleet]:
        BROKEN.append((message, broken))
        return broken

    return note


@breaks("autoreset_mode")
class ResetsByItself(Good):
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}


@breaks("horizon must be an int >= 1")
class NoHorizon(Good):
    def __init__(self) -> None:
        super().__init__()
        self.horizon = 0


@breaks("single_action_space must be a Box of shape")
class Buttons(Good):
    def __init__(self) -> None:
        super().__init__()
        self.single_action_space = Discrete(3)  # type: ignore[assignment]


@breaks("action bounds must be finite")
class Boundless(Good):
    def __init__(self) -> None:
        super().__init__()
        self.single_action_space = Box(-np.inf, np.inf, (1,))


@breaks("single_observation_space must be a Box")
class Symbols(Good):
    def __init__(self) -> None:
        super().__init__()
        self.single_observation_space = Discrete(3)  # type: ignore[assignment]


@breaks(r"observation_space must have shape \(4, 4\)")
class WrongBatch(Good):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(-np.inf, np.inf, (3, 4))


@breaks(r"reset must return \(obs, info\)")
class ResetsWithoutInfo(Resets):
    def change(self, *result: Any) -> Any:
        return result[0]


@breaks(r"reset must return observations of shape \(4, 4\)")
class ResetsInAnotherShape(Resets):
    def change(self, *result: Any) -> Any:
        return result[0][:, :3], result[1]


@breaks("reset must return observations of type float64, got float32")
class ResetsInAnotherType(Resets):
    def change(self, *result: Any) -> Any:
        return result[0].astype(np.float32), result[1]


@breaks("info\\['violation'\\] is missing from ResetsSilently.reset")
class ResetsSilently(Resets):
    def change(self, *result: Any) -> Any:
        return result[0], {"success": result[1]["success"]}


@breaks("no robot completes its task by a reset")
class SucceedsByReset(Resets):
    def change(self, *result: Any) -> Any:
        return result[0], {**result[1], "success": ~result[1]["violation"]}


@breaks("reset must end every violation")
class StaysDown(Good):
    def reset(self, **kwargs: Any) -> Any:
        obs, info = super().reset(**kwargs)
        self.violation = np.array([True, False, False, False])
        return obs, {**info, "violation": self.violation.copy()}


@breaks("step must return .obs, reward, terminated, truncated, info.")
class FourTuple(Steps):
    def change(self, *result: Any) -> Any:
        return result[:4]


@breaks("step returned an observation that is not finite")
class Blind(Steps):
    def change(self, *result: Any) -> Any:
        return result[0] * np.nan, *result[1:]


@breaks(r"step must return rewards \(4,\) float64, got \(4,\) float32")
class SmallRewards(Steps):
    def change(self, *result: Any) -> Any:
        return result[0], result[1].astype(np.float32), *result[2:]


@breaks("reward that is not finite")
class EndlessRewards(Steps):
    def change(self, *result: Any) -> Any:
        return result[0], result[1] + np.inf, *result[2:]


@breaks("terminated of IntFlags.step must be an array .4,. of bool, got .4,. int64")
class IntFlags(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:2], result[2].astype(np.int64), *result[3:]


@breaks(r"truncated of ScalarFlag.step must be an array \(4,\) of bool, got False")
class ScalarFlag(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:3], False, result[4]


@breaks("info\\['success'\\] is missing from Wordless.step")
class Wordless(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:4], {"violation": result[4]["violation"]}


@breaks("info\\['violation'\\] of FloatViolation.step must be an array")
class FloatViolation(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:4], {**result[4], "violation": result[4]["violation"].astype(float)}


@breaks("violation cannot be a success")
class FallsIntoTheGoal(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:4], {**result[4], "success": result[4]["success"] | result[4]["violation"]}


@breaks("overwrites what it returned before")
class OneBuffer(Steps):
    buffer = np.zeros((4, 4))

    def change(self, *result: Any) -> Any:
        self.buffer[:] = result[0]
        return self.buffer, *result[1:]


@breaks("changes the actions that it is given")
class ClipsInPlace(Good):
    def step_async(self, actions: Any, active: Any = None) -> None:
        np.clip(actions, -0.1, 0.1, out=actions)
        super().step_async(actions, active)


@breaks("the same seed must give the same run")
class Unseeded(Good):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return PointFleet.reset(self, options=options)


@breaks("step_async followed by step_wait must do what step does")
class TwoWays(Good):
    def step(self, actions: Any, active: Any = None) -> Any:
        return super().step(actions / 2, active)


@breaks("paused, but its observation changed")
class CannotPause(Good):
    def step_async(self, actions: Any, active: Any = None) -> None:
        super().step_async(actions, None)


@breaks("paused, but its reward is not 0")
class PaysPauses(Steps):
    def change(self, *result: Any) -> Any:
        return result[0], np.ones(4), *result[2:]


@breaks("paused, but something happened to it")
class EndsPauses(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:3], (~self.moved[-1] | result[3]) & ~self.violation, result[4]


@breaks("resets robots that are not in reset_mask")
class ResetsAll(Good):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=seed)


@breaks("does not reset the robots in reset_mask")
class ResetsNobody(Good):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is None and options:
            self.violation = self.violation & ~options["reset_mask"]
            return self.obs, {"violation": self.violation.copy(), "success": np.zeros(4, dtype=bool)}
        return super().reset(seed=seed)


@breaks("changes the reset_mask that it is given")
class EatsMasks(Good):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = super().reset(seed=seed, options=options)
        if options:
            options["reset_mask"][:] = False
        return result


@breaks("a violation must last until the robot is reset")
class GetsUp(Good):
    def step_async(self, actions: Any, active: Any = None) -> None:
        super().step_async(actions, active)
        self.violation = np.zeros_like(self.violation)


@breaks("in violation must stand still, but its observation changed")
class Crawls(Steps):
    def change(self, *result: Any) -> Any:
        self.obs[self.violation, POSITION] += 0.01
        return result


@breaks("in violation must stand still, but its reward is not 0")
class PaysTheFallen(Steps):
    can_pause = False

    def change(self, *result: Any) -> Any:
        self.can_pause = False
        return result[0], np.ones(4), *result[2:]


@breaks("in violation must stand still, but its episode ended once more")
class EndsTwice(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:3], result[3] | (self.violation & ~self.moved[-1]), result[4]


@breaks("after 15 timesteps .the horizon. an episode must be truncated")
class NeverEnds(Steps):
    def change(self, *result: Any) -> Any:
        return *result[:3], np.zeros(4, dtype=bool), result[4]


@breaks("must continue bit for bit")
class ForgetsTheNoise(Good):
    def load_state_dict(self, state: dict[str, Any]) -> None:
        before = self.rng
        super().load_state_dict(state)
        self.rng = np.random.Generator(np.random.PCG64(before.integers(99)))


@breaks("must continue bit for bit; something is not saved, or saved as a view")
class SavesAView(Good):
    def __init__(self) -> None:
        super().__init__()
        self.heat = np.zeros(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            self.heat = np.zeros(4)
        return super().reset(seed=seed, options=options)

    def step_wait(self) -> Any:
        self.heat += 1.0
        self.drift = 1e-3 * self.heat[0]
        return super().step_wait()

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "heat": self.heat}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.heat = state["heat"]


@breaks("must hold arrays and JSON values only, got Generator")
class SavesObjects(Good):
    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "rng": self.rng}


@breaks("keys must be strings without '/'")
class SavesNumbersAsKeys(Good):
    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "more": {1: 2}}


@breaks("can_checkpoint = False: state_dict must raise ConfigError")
class Undecided(Good):
    can_checkpoint = False


@pytest.mark.parametrize("robots", [1, 2, 5])
def test_a_good_fleet_passes(robots: int) -> None:
    check_env(Good(robots))


@pytest.mark.parametrize(("message", "broken"), BROKEN, ids=[broken.__name__ for _, broken in BROKEN])
def test_a_broken_fleet_is_told_which_clause(message: str, broken: Any) -> None:
    with pytest.raises(ContractError, match=message):
        check_env(broken())


def test_only_a_fleet_is_a_fleet() -> None:
    with pytest.raises(ContractError, match="object is no Fleet"):
        check_env(object())  # type: ignore[arg-type]


def test_what_never_occurred_is_admitted() -> None:
    fleet = Good()
    fleet.bound = np.inf
    with pytest.warns(UserWarning, match="no robot of Good violated its constraint in 30 timesteps"):
        check_env(fleet, steps=30)


def test_a_fleet_that_says_it_cannot_be_saved_passes() -> None:
    class Opaque(Good):
        can_checkpoint = False

        def state_dict(self) -> Any:
            raise ConfigError("no")

    check_env(Opaque())
