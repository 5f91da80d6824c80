"""What a robot does with a driver that fails, blocks or lies, and with an emergency stop that comes at a bad time."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from remote.alone import Alone, Arm
from sgc.fleets import eventually

from tutelage.errors import ContractError
from tutelage.remote.messages import Flag, Order
from tutelage.remote.robot import DriverFailed, RobotConfig

UNPLUGGED = OSError("unplugged")


@pytest.fixture
def arm() -> Arm:
    return Arm()


def test_a_driver_that_fails_at_each_action_ends_the_program_although_it_holds_well(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        arm.errors["act"] = UNPLUGGED
        alone.drive(5.0, 0.1, 0.1)
        assert isinstance(alone.ends(), DriverFailed)
    assert arm.notes[-1] == ("hold",)
    failures = [line for line in alone.lines if "failed" in line]
    assert len(failures) == 1
    assert "the driver failed: OSError: unplugged (alone.py:" in failures[0]


def test_a_driver_that_is_well_again_may_fail_again(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        for _ in range(3):
            arm.errors["act"] = UNPLUGGED
            alone.drive(0.9, 0.1, 0.1)
            del arm.errors["act"]
            alone.drive(0.8, 0.1, 0.1)
            assert not alone.has(Flag.FAULT | Flag.HELD)


def test_a_hold_that_fails_at_the_watchdog_is_tried_again(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        alone.drive(0.3, 0.1, 0.1)
        arm.errors["hold"] = UNPLUGGED
        eventually(lambda: alone.has(Flag.FAULT))
        before = len(arm.said("hold"))
        eventually(lambda: len(arm.said("hold")) > before + 2)
        del arm.errors["hold"]
        eventually(lambda: alone.seen[-1].flags == Flag.HELD)


@pytest.mark.parametrize("what", ["violation", "look"])
def test_whatever_of_the_driver_fails_is_a_fault_that_the_server_sees(tmp_path: Path, arm: Arm, what: str) -> None:
    with Alone(tmp_path, arm) as alone:
        arm.errors[what] = UNPLUGGED
        eventually(lambda: alone.has(Flag.FAULT))
        del arm.errors[what]
        eventually(lambda: not alone.has(Flag.FAULT))
        arm.errors[what] = UNPLUGGED
        assert isinstance(alone.ends(), DriverFailed)


def test_a_reward_that_is_no_number_is_a_fault_and_the_return_stays_one(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        alone.drive(0.3, 0.1, 0.1)
        arm.rewards = float("nan")
        alone.drive(0.3, 0.1, 0.1)
        assert any("reward() must be a finite number" in line for line in alone.lines)
        arm.rewards = 1.0
        alone.drive(0.8, 0.1, 0.1)
        assert alone.seen[-1].episode_return > 0


def test_a_reset_that_fails_is_tried_again_at_the_robots_rate(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        arm.errors["reset"] = UNPLUGGED
        began = len(arm.said("reset"))
        assert alone.reset()
        time.sleep(1.0)
        assert 5 < len(arm.said("reset")) - began < 30
        del arm.errors["reset"]
        eventually(lambda: alone.seen[-1].episode == 2)


@pytest.mark.parametrize("what", ["reset", "look", "hold", "violation"])
def test_a_driver_that_cannot_begin_is_named_in_one_line(tmp_path: Path, arm: Arm, what: str) -> None:
    arm.errors[what] = OSError("no such device\n/dev/arm")
    with pytest.raises(
        DriverFailed, match=r"^the driver of arm-1 failed: OSError: no such device /dev/arm \(alone.py:\d+\)$"
    ):
        Alone(tmp_path, arm)
    assert "hold" in arm.said()


def test_a_broken_contract_is_said_as_such(tmp_path: Path, arm: Arm) -> None:
    arm.get_observation = lambda: np.zeros(3, np.float32)  # type: ignore[method-assign]
    with pytest.raises(ContractError, match="must observe"):
        Alone(tmp_path, arm)


def test_an_observation_is_as_old_as_the_look_that_made_it(tmp_path: Path, arm: Arm) -> None:
    """What takes its time after the look, such as a policy on the robot, does not make it younger."""
    with Alone(tmp_path, arm, RobotConfig(hz=20, watchdog=0.3)) as alone:
        arm.delays["look"] = 0.4
        eventually(lambda: alone.seen[-1].number > 3)
        arm.notes.clear()
        for _ in range(5):
            number = alone.seen[-1].number
            eventually(lambda: alone.seen[-1].number > number)  # noqa: B023
            alone.command(0.1, 0.1)
        assert not arm.said("act")
        assert alone.robot.gate.counts["stale"] > 2


def test_a_driver_that_blocks_is_named(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        arm.delays["look"] = 0.7
        eventually(lambda: any("took 0.7 s for a timestep" in line for line in alone.lines))
        time.sleep(1.0)
        assert sum("for a timestep" in line for line in alone.lines) == 1


# -- the emergency stop ---------------------------------------------------------------------------------------------------


def test_a_robot_that_is_stopped_hears_of_nothing_but_the_stop(tmp_path: Path, arm: Arm) -> None:
    """Holding may need power in the motors that the stop has cut."""
    with Alone(tmp_path, arm) as alone:
        alone.drive(0.3, 0.1, 0.1)
        alone.stop()
        at = arm.notes.index(("stop",))
        alone.drive(0.8, 0.1, 0.1)
        arm.errors["look"] = UNPLUGGED
        eventually(lambda: alone.has(Flag.FAULT))
        del arm.errors["look"]
        time.sleep(0.2)
    assert set(arm.said("act", "hold", "reset", "stop")[len([n for n in arm.notes[:at] if n[0] != "look"]) :]) == {"stop"}


def test_a_robot_that_starts_stopped_is_told_so_and_is_reset_once_it_is_cleared(tmp_path: Path, arm: Arm) -> None:
    (tmp_path / "stopped").touch()
    with Alone(tmp_path, arm, RobotConfig(hz=20, seed=3)) as alone:
        alone.drive(0.3, 0.1, 0.1)
        assert set(arm.said("act", "hold", "reset", "stop")) == {"stop"}
        assert alone.has(Flag.STOPPED)
        alone.clear()
        alone.drive(0.4, 0.1, 0.1)
        assert arm.said("act", "reset")[:2] == ["reset", "act"]
        assert ("reset", False, 3) in arm.notes
        assert alone.seen[-1].episode == 2


def test_a_reset_during_which_the_stop_came_is_done_again_after_it(tmp_path: Path, arm: Arm) -> None:
    with Alone(tmp_path, arm) as alone:
        arm.delays["reset"] = 0.4
        assert alone.reset(hard=True, seed=4)
        time.sleep(0.1)
        alone.stop()
        time.sleep(0.5)
        assert arm.notes.count(("reset", True, 4)) == 1
        alone.clear()
        eventually(lambda: arm.notes.count(("reset", True, 4)) == 2)
        time.sleep(0.6)
        assert arm.notes.count(("reset", True, 4)) == 2


def test_the_end_of_the_stop_is_the_last_word_though_the_stop_is_said_again_and_again(tmp_path: Path, arm: Arm) -> None:
    """A stop that takes its time must not come to its end after the release: the robot would stay stopped for good."""
    with Alone(tmp_path, arm) as alone:
        arm.delays["stop"] = 0.1
        for k in range(4):
            alone.stop()
            time.sleep(0.12 + 0.03 * k)
            alone.clear()
            time.sleep(0.2)
            assert arm.said("stop", "release")[-1] == "release"


def test_a_release_that_fails_is_said(tmp_path: Path, arm: Arm) -> None:
    arm.errors = {"release": UNPLUGGED, "stop": UNPLUGGED}
    with Alone(tmp_path, arm) as alone:
        alone.stop()
        alone.clear()
        assert any("emergency stop; the driver's stop failed and is called again: OSError" in line for line in alone.lines)
        assert any("is cleared, but the driver's release failed: OSError: unplugged" in line for line in alone.lines)


# -- the policy on the robot ----------------------------------------------------------------------------------------------


class Policy:
    """Version 1 of a policy that says what it is told to."""

    version = 1
    says: np.ndarray | Exception = np.full((1, 2), 0.5, np.float32)

    def act(self, obs: np.ndarray) -> np.ndarray:
        if isinstance(self.says, Exception):
            raise self.says
        return self.says


@pytest.mark.parametrize("says", [np.full((1, 2), np.nan, np.float32), np.ones((1, 1), np.float32), ValueError("diverged")])
def test_a_policy_on_the_robot_that_says_no_action_moves_nothing(
    tmp_path: Path, arm: Arm, says: np.ndarray | Exception
) -> None:
    policy = Policy()
    with Alone(tmp_path, arm, policy=policy) as alone:
        alone.drive(0.3, order=Order.ACT | Order.OWN)
        assert ("act", 0.5, 0.5) in arm.notes
        policy.says = says
        time.sleep(0.2)
        arm.notes.clear()
        alone.drive(0.3, order=Order.ACT | Order.OWN)
        assert not arm.said("act")
        assert alone.has(Flag.HELD)
        alone.drive(0.3, 0.1, 0.1)  # the server's own actions are still good
        assert arm.said("act")
        assert sum("the policy on the robot is of no use" in line for line in alone.lines) == 1
