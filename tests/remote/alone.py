"""A robot in this process, without a network: what it is told comes from the test, and what it says is kept."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from sgc.fleets import eventually

from tutelage.remote.messages import Ask, Command, Flag, Observation, Operation, Order, Stop, StopOperation
from tutelage.remote.robot import Robot, RobotConfig
from tutelage.remote.wire import pack_ask, pack_command, pack_stop, unpack_answer, unpack_observation

SERVER = 7


class Arm:
    """A driver that writes down what is done to it, in `notes`; `errors` says which of its methods raise, `delays` how long
    they take (seconds)."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self) -> None:
        self.notes: list[tuple[Any, ...]] = []
        self.errors: dict[str, Exception] = {}
        self.delays: dict[str, float] = {}
        self.rewards = 0.0

    def does(self, what: str, *words: Any) -> None:
        time.sleep(self.delays.get(what, 0.0))
        self.notes.append((what, *words))
        if what in self.errors:
            raise self.errors[what]

    def said(self, *kinds: str) -> list[str]:
        """The names of what was done to it; only of these kinds."""
        return [note[0] for note in self.notes if not kinds or note[0] in kinds]

    def get_observation(self) -> np.ndarray:
        self.does("look")
        return np.zeros(2, np.float32)

    def send_action(self, action: np.ndarray) -> None:
        self.does("act", *action.tolist())

    def hold(self) -> None:
        self.does("hold")

    def stop(self) -> None:
        self.does("stop")

    def release(self) -> None:
        self.does("release")

    def reset(self, hard: bool, seed: int | None) -> None:
        self.does("reset", hard, seed)

    def violation(self) -> bool:
        if "violation" in self.errors:
            raise self.errors["violation"]
        return False

    def reward(self) -> float:
        return self.rewards


class Alone:
    """A robot that runs on a thread, and its server's part."""

    def __init__(self, folder: Path, driver: Arm, config: RobotConfig | None = None, policy: Any = None) -> None:
        self.driver, self.lines = driver, []
        self.seen: list[Observation] = []
        self._lanes: dict[str, Any] = {}
        self._number = 0
        self._failure: list[BaseException] = []
        lanes = ("observation", "command", "stop", "service")
        node = SimpleNamespace(
            name="arm-1", home=SimpleNamespace(path=folder), access=SimpleNamespace(topics={f"arm-1.{k}" for k in lanes}),
            publisher=lambda alias: SimpleNamespace(send=self._take, close=lambda: None),
            subscribe=self._listen, serve=self._listen,
        )  # fmt: skip
        self.robot = Robot(node, driver, config or RobotConfig(hz=20), self.lines.append, policy)  # type: ignore[arg-type]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        eventually(lambda: self.seen)

    def _listen(self, alias: str, call: Any) -> Any:
        self._lanes[alias.partition(".")[2]] = lambda data: call(SimpleNamespace(payload=data))
        return SimpleNamespace(close=lambda: None)

    def _take(self, data: bytes) -> None:
        self.seen.append(unpack_observation(data))

    def _run(self) -> None:
        try:
            self.robot.run()
        except BaseException as error:
            self._failure.append(error)

    def command(self, *action: float, order: Order = Order.ACT, answers: int | None = None) -> None:
        """Answer the newest observation, or another one."""
        self._number += 1
        number = self.seen[-1].number if answers is None else answers
        what = np.array(action, np.float32)
        self._lanes["command"](pack_command(Command(SERVER, self._number, self.robot.boot, number, order, 0, 0.05, what)))

    def drive(self, seconds: float, *action: float, order: Order = Order.ACT) -> None:
        """Command at 40 Hz, as long as the robot runs."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and self._thread.is_alive():
            self.command(*action, order=order)
            time.sleep(0.025)

    def stop(self, operation: StopOperation = StopOperation.STOP) -> None:
        """The emergency stop, or its end."""
        self._number += 1
        self._lanes["stop"](pack_stop(Stop(SERVER, self._number, operation)))

    def clear(self) -> None:
        self.stop(StopOperation.CLEAR)

    def reset(self, *, hard: bool = False, seed: int | None = None) -> bool:
        """Ask for an episode; was it accepted?"""
        self._number += 1
        asked = Ask(SERVER, self._number, Operation.HARD_RESET if hard else Operation.SOFT_RESET, seed)
        return unpack_answer(self._lanes["service"](pack_ask(asked))).accepted

    def has(self, flag: Flag) -> bool:
        """Does the newest observation show it?"""
        return bool(self.seen[-1].flags & flag)

    def ends(self) -> BaseException | None:
        """Wait until it ends by itself; what it raised."""
        self._thread.join(10.0)
        assert not self._thread.is_alive()
        return self._failure[0] if self._failure else None

    def close(self) -> None:
        self.robot.close()
        self._thread.join(5.0)

    def __enter__(self) -> Alone:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
