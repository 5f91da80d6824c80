"""The process on a robot's machine: observations out, commands in, and a robot that stands still whenever in doubt.

    with Node.open(Path("arm-1")) as node, Robot(node, Arm()) as robot:
        robot.run(ending)

The robot acts at its own rate, in step with the commands while they come. Without a fresh command it holds; see
`CommandGate`.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError, TutelageError
from tutelage.remote import jpeg, topics
from tutelage.remote.driver import Driver, DriverFailed, describe, observation_of
from tutelage.remote.eyes import Eyes
from tutelage.remote.gate import CommandGate
from tutelage.remote.latch import Latch
from tutelage.remote.messages import Answer, Ask, Counts, Flag, Malformed, Observation, Operation, Order
from tutelage.remote.telling import told
from tutelage.remote.wire import pack_answer, pack_description, pack_observation, unpack_ask
from tutelage.sgc.messages import Message
from tutelage.sgc.node import Node

log = logging.getLogger(__name__)

Array = NDArray[Any]

EARLY, LATE = 0.75, 1.25
"""Of a timestep: a command that comes so early begins the next one at once, and so late one is waited for."""

WATCHED = 2.0
"""Seconds after the last command for which the cameras go on that it wanted."""

PATIENCE = 2.0
"""Seconds for which a driver may fail without a break before the program ends."""

RECOVERED = 0.5
"""Seconds, or four timesteps, without a failure after which a driver is well again: one that fails at each action works in
between, while it holds."""

ANSWERS = 64
"""Resets that are recognised when they are asked for again."""


class OwnPolicy(Protocol):
    """A policy on the robot."""

    @property
    def version(self) -> int:
        """Of the weights; 0: there are none yet."""
        ...

    def act(self, obs: Array) -> Array:
        """(1, ...) -> (1, A) float32."""
        ...


@dataclass(frozen=True)
class RobotConfig:
    """How a robot behaves, whatever it is told.

    Attributes:
        hz: timesteps in a second.
        watchdog: seconds after which an observation is too old for a command that answers it; then the robot holds.
        slew: the largest change of an action in a second, as a fraction of its range; None: no limit.
        camera_hz: pictures of a camera in a second, at most. quality: of JPEG.
        seed: of the first episode; None: any.
    """

    hz: float = 10.0
    watchdog: float = 0.5
    slew: float | None = None
    camera_hz: float = 10.0
    quality: int = 80
    seed: int | None = None

    def __post_init__(self) -> None:
        if not 0.1 <= self.hz <= 1000 or not 0.1 <= self.camera_hz <= 1000:
            raise ConfigError(f"a robot's rates are 0.1 to 1000 Hz, not {self.hz:g} and {self.camera_hz:g}")
        if not 0.02 <= self.watchdog <= 60:
            raise ConfigError(f"the watchdog needs 0.02 to 60 seconds, not {self.watchdog:g}")
        if self.watchdog * self.hz < 2:
            raise ConfigError(
                f"at {self.hz:g} Hz no command could be in time for a watchdog of {self.watchdog:g} s; "
                f"give it at least {2 / self.hz:g}"
            )
        if self.slew is not None and not self.slew > 0:
            raise ConfigError(f"a limit on the change of actions must be more than 0, not {self.slew:g}")
        if not 1 <= self.quality <= 100:
            raise ConfigError(f"the quality of pictures is 1 to 100, not {self.quality}")


class Robot:
    """One robot of a fleet. `run` is its loop; everything else happens on the network's threads."""

    def __init__(
        self,
        node: Node,
        driver: Driver,
        config: RobotConfig | None = None,
        report: Callable[[str], None] = lambda line: None,
        policy: OwnPolicy | None = None,
    ) -> None:
        """
        Args:
            node: open; its name is the robot's. Not closed by `close`.
            report: is told what a person at the robot would want to know, a line each.
            policy: decides what the robot does itself, until the server overrides it.

        Raises:
            ConfigError: the node's policy has no robot of that name.
            ContractError: the driver breaks its contract.
            DriverFailed: the driver cannot begin.
        """
        self.node, self.driver, self.config = node, driver, config or RobotConfig()
        self.policy = policy
        if node.name not in topics.robots_in(_alias_set(node)):
            raise ConfigError(
                f"the policy has no robot {node.name} (no topic {topics.alias(node.name, topics.OBSERVATION)}); "
                f"write them with: tutelage fleet policy {node.name} ..."
            )
        self.boot = secrets.randbits(64) | 1
        self._report = report
        self._dt = 1.0 / self.config.hz
        self._ending = threading.Event()
        self._news = threading.Condition()
        box = driver.action_space
        self._low, self._high = box.low.astype(np.float32), box.high.astype(np.float32)
        self.gate = CommandGate(self.boot, len(self._low), self.config.watchdog)
        self.latch = Latch(node.home.path, self._stop_now, self._released)
        self.asks = Counts()
        self._asked: Ask | None = None
        self._answers: OrderedDict[tuple[int, int], Answer] = OrderedDict()

        self._number = self._episode = self._step = 0
        self._return = 0.0
        self._last_action: Array | None = None
        self._executed = (0, 0)  # server, number
        self._held = True
        self._warned = self._blocked = False
        self._told: Any = None
        self._told_at = float("-inf")
        self._failing_since: float | None = None
        self._failed_at = float("-inf")
        self._stops = 0
        self._stopping = threading.Lock()  # a stop that is said again must not come after its end
        self._owed: tuple[int | None, bool] | None = None  # seed, hard: of a reset that the emergency stop prevented
        self._obs: Array | None = None
        self._seen_at = float("-inf")
        self._proposal: Array | None = None
        self._version = self._poor = 0

        try:
            self._reset(self.config.seed, hard=False)
            self._flags()
            cameras = self._working_cameras()
        except Exception as error:
            with contextlib.suppress(Exception):
                self._hold()
            if isinstance(error, TutelageError):
                raise
            raise DriverFailed(f"the driver of {node.name} failed: {told(error)}") from error
        threaded = bool(getattr(driver, "threaded_cameras", False))
        self.eyes = Eyes(
            self.boot, cameras, {name: node.publisher(topics.alias(node.name, topics.PICTURE, name)) for name in cameras},
            hz=self.config.camera_hz, quality=self.config.quality, threaded=threaded,
        )  # fmt: skip
        self.description = describe(driver, self._dt, self.eyes.names)
        self._observations = node.publisher(topics.alias(node.name, topics.OBSERVATION))
        self._subscriptions = [
            node.subscribe(topics.alias(node.name, topics.STOP), lambda message: self.latch.take(message.payload)),
            node.subscribe(topics.alias(node.name, topics.COMMAND), self._on_command),
        ]
        self._service = node.serve(topics.alias(node.name, topics.SERVICE), self._on_ask)

    @property
    def counters(self) -> dict[str, int]:
        """Commands and other messages that were refused, by reason."""
        return {**self.gate.counts.by_reason, **(self.latch.counts.by_reason + self.asks.by_reason)}

    def run(self, ending: threading.Event | None = None) -> None:
        """Work until `ending` is set, or `close` is called; then hold.

        Raises:
            DriverFailed: the driver failed for `PATIENCE` seconds on end.
        """
        began = time.monotonic()
        first = True
        try:
            while not self._ending.is_set() and not (ending is not None and ending.is_set()):
                if not first:
                    self._wait(began, ending)
                began, first = time.monotonic(), False
                self._turn()
        finally:
            with contextlib.suppress(Exception):
                self._hold()

    def close(self) -> None:
        """End `run`, and leave the topics. The driver and the node stay open."""
        self._ending.set()
        with self._news:
            self._news.notify_all()
        self._service.close()
        for subscription in self._subscriptions:
            subscription.close()
        self.eyes.close()
        self._observations.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    # -- on the network's threads ------------------------------------------------------------------------------------------

    def _on_command(self, message: Message) -> None:
        with self._news:
            if self.gate.take(message.payload, time.monotonic()):
                self._news.notify_all()

    def _on_ask(self, message: Message) -> bytes:
        try:
            ask = unpack_ask(message.payload)
        except Malformed:
            self.asks.add("malformed")
            raise
        if ask.operation == Operation.DESCRIBE:
            return pack_description(self.description)
        with self._news:
            known = self._answers.get((ask.server, ask.number))
            if known is None:
                known = Answer(not self.latch.stopped, self.boot, self._episode)
                if known.accepted:
                    self._answers[ask.server, ask.number] = known
                    while len(self._answers) > ANSWERS:
                        self._answers.popitem(last=False)
                    self._asked = ask
                    self._news.notify_all()
        return pack_answer(known)

    def _stop_now(self, first: bool) -> None:
        """On the stop lane's thread: nothing comes before this."""
        failure = ""
        try:
            getattr(self.driver, "stop", self.driver.hold)()
        except Exception as error:
            failure = f"; the driver's stop failed and is called again: {told(error)}"
        if first:
            self._stops += 1
            self._report(f"emergency stop{failure}")
        with self._news:
            self._news.notify_all()

    def _released(self) -> None:
        failure = ""
        try:
            with self._stopping:
                getattr(self.driver, "release", lambda: None)()
        except Exception as error:
            failure = f", but the driver's release failed: {told(error)}"
        self._report(f"the emergency stop is cleared{failure}")

    # -- the loop ----------------------------------------------------------------------------------------------------------

    def _wait(self, began: float, ending: threading.Event | None) -> None:
        """Until the next timestep; holds on time if the command ceases to be fresh before that."""
        executed = self._executed
        stopped = self.latch.stopped
        while not self._ending.is_set() and not (ending is not None and ending.is_set()):
            now = time.monotonic()
            command = self.gate.current(now)
            if not self._held and command is None:
                try:
                    self._hold()
                except Exception as error:
                    self._failed(error)
                    return
                if self._obs is not None and self.gate.heard:
                    self._report(f"holds: no fresh command for {self.config.watchdog:g} s")
                return
            new = command is not None and (command.server, command.number) != executed
            due = began + self._dt * (EARLY if new else LATE if not self._held else 1.0)
            until = min(due, self.gate.until) if not self._held else due
            with self._news:
                asked = self._asked is not None and not stopped and self._failing_since is None
                if asked or self.latch.stopped != stopped:
                    return
                again = self.gate.current(now)
                if again is not command:
                    continue
                if due <= now:
                    return
                self._news.wait(min(until - now, 0.1))  # SIGTERM sets `ending` without a word to us

    def _turn(self) -> None:
        """One timestep: act or hold, look, tell."""
        began = time.monotonic()
        try:
            owed, asked = self._owed, self._asked
            if (asked is not None or owed is not None) and not self.latch.stopped:
                self._publish(self._flags() | Flag.RESETTING)
                seed, hard = owed or (None, False)
                if asked is not None:
                    seed, hard = asked.seed, hard or asked.operation == Operation.HARD_RESET
                self._reset(seed, hard=hard)
                with self._news:
                    if self._asked is asked:  # else a newer one came meanwhile; one that failed is tried again
                        self._asked = None
                began = time.monotonic()  # a reset may take its time
            self._act()
            self._look()
            flags = self._flags()
        except Exception as error:
            self._failed(error)
            return
        now = time.monotonic()
        if now - self._failed_at > max(RECOVERED, 4 * self._dt, 4 * self.gate.period):
            self._failing_since = None
        if self.gate.period > 0.8 * self.config.watchdog and not self._warned:
            self._warned = True
            self._report(
                f"the server commands every {self.gate.period:g} s, and the watchdog is {self.config.watchdog:g} s: "
                f"this robot will hold between two commands; give it --watchdog {3 * self.gate.period:g}"
            )
        watched = self.gate.watch if now - self.gate.heard_at < WATCHED else 0
        # A robot that is faster than its server need not tell it more often than twice a step, without news.
        news = (self._executed, flags, self._episode)
        if news != self._told or now - self._told_at >= min(0.1, 0.5 * self.gate.period or 0.1) - 0.5 * self._dt:
            self._told, self._told_at = news, now
            self._publish(flags)
        self.eyes.look(watched, now)
        took = time.monotonic() - began
        if took > self.config.watchdog and not self._blocked:
            self._blocked = True
            self._report(
                f"the driver (or a camera of it) took {took:.1f} s for a timestep, and could not be told to hold meanwhile; "
                "all but reset() should return at once"
            )

    def _act(self) -> None:
        command = self.gate.current(time.monotonic())
        if command is not None:
            self._executed = command.server, command.number
        if self.latch.stopped or command is None or not command.order & Order.ACT or self._over():
            self._hold()
            return
        wanted = self._proposal if command.order & Order.OWN else command.action
        if wanted is None:  # it has no policy any more that it could go on with: it was started again
            self._hold()
            return
        action = self._bounded(wanted)
        held, self._held = self._held, False  # if it fails, the robot may be moving
        self.driver.send_action(action)
        self._stop_again()  # if it came while the action was being sent
        if held:
            self._report("moves")
        self._last_action = action
        self._step += 1
        reward = float(getattr(self.driver, "reward", float)())
        if not np.isfinite(reward):
            raise ContractError(f"{type(self.driver).__name__}.reward() must be a finite number, got {reward!r}")
        self._return += reward

    def _bounded(self, action: Array) -> Array:
        bounded = np.clip(action, self._low, self._high)
        if self.config.slew is not None:
            most = np.float32(self.config.slew * self._dt) * (self._high - self._low)
            still = np.clip(np.zeros_like(self._low), self._low, self._high)
            before = still if self._last_action is None else self._last_action
            bounded = np.clip(bounded, before - most, before + most)
        return np.asarray(bounded, dtype=np.float32)

    def _hold(self) -> None:
        """Stand still. A robot that is stopped hears of nothing but the stop."""
        self._held, self._last_action = True, None
        if not self.latch.stopped:
            self.driver.hold()
        self._stop_again()

    def _stop_again(self) -> None:
        """The emergency stop is the last word, whatever the driver was told while it came."""
        if self.latch.stopped:
            with self._stopping:
                if self.latch.stopped:
                    getattr(self.driver, "stop", self.driver.hold)()

    def _look(self) -> None:
        seen_at = time.monotonic()  # before whatever takes its time: from here on the observation grows old
        self._obs = observation_of(self.driver)
        self._seen_at = seen_at
        self._proposal, self._version = None, 0
        if self.policy is not None and self.policy.version:
            self._version = self.policy.version
            self._proposal = self._propose(self._obs)

    def _propose(self, obs: Array) -> Array | None:
        """What the policy on the robot would do; None: nothing that could be done."""
        assert self.policy is not None
        try:
            action = np.asarray(self.policy.act(obs[None])[0], np.float32)
            if action.shape == self._low.shape and np.isfinite(action).all():
                return self._bounded(action)
            why = f"{action.tolist()} is no action" if action.size < 20 else f"{action.shape} numbers are no action"
        except Exception as error:
            why = told(error)
        if self._poor != self._version:
            self._poor = self._version
            self._report(f"the policy on the robot is of no use: {why}; the server decides")
        return None

    def _over(self) -> bool:
        """Has the episode ended? Then the robot stands still until it is reset."""
        return any(bool(getattr(self.driver, flag, bool)()) for flag in ("violation", "success", "truncated"))

    def _reset(self, seed: int | None, *, hard: bool) -> None:
        """Begin an episode: at the start of the program, or when the server asks."""
        self._hold()
        reset, stops = getattr(self.driver, "reset", None), self._stops
        if reset is not None:
            self._owed = seed, hard
            if not self.latch.stopped:
                reset(hard, seed)
                if stops == self._stops and not self.latch.stopped:  # else who knows how far it got
                    self._owed = None
        self._episode += 1
        self._step, self._return = 0, 0.0
        self._look()
        if self._episode > 1:
            self._report(f"episode {self._episode} begins after a {'hard' if hard else 'soft'} reset")
        with self._news:
            self.gate.observed(self._number + 1, self._seen_at, new_episode=True)

    def _failed(self, error: Exception) -> None:
        with contextlib.suppress(Exception):
            self._hold()  # before anything else
        now = self._failed_at = time.monotonic()
        if self._failing_since is None:
            self._failing_since = now
            self._report(f"the driver failed: {told(error)}")
            log.info("%s: the driver failed", self.node.name, exc_info=error)
        if now - self._failing_since > PATIENCE:
            raise DriverFailed(f"the driver of {self.node.name} goes on failing: {told(error)}") from error
        if self._obs is not None:
            flags = Flag.HELD | Flag.STOPPED if self.latch.stopped else Flag.HELD
            with contextlib.suppress(Exception):  # they are the driver's, too
                flags = self._flags()
            self._publish(flags | Flag.FAULT)

    def _flags(self) -> Flag:
        flags = Flag(0)
        if bool(getattr(self.driver, "violation", bool)()):
            flags |= Flag.VIOLATION
        elif bool(getattr(self.driver, "success", bool)()):
            flags |= Flag.SUCCESS
        if bool(getattr(self.driver, "truncated", bool)()) and not flags & Flag.VIOLATION:
            flags |= Flag.TRUNCATED
        if self._held:
            flags |= Flag.HELD
        return flags | Flag.STOPPED if self.latch.stopped else flags

    def _publish(self, flags: Flag) -> None:
        assert self._obs is not None
        now = time.monotonic()
        with self._news:
            self._number += 1
            self.gate.observed(self._number, self._seen_at)
            gate, stale = self.gate, self.gate.counts["stale"]
            message = Observation(
                self.boot, self._number, self._episode, self._step, flags, gate.server, gate.heard,
                executed=self._executed[1] if self._executed[0] == gate.server else 0,
                waited=now - gate.heard_at if gate.heard else 0.0,
                episode_return=self._return,
                stale=stale,
                refused=gate.counts.total() - stale + self.latch.counts.total(),
                policy=self._version, obs=self._obs, proposal=self._proposal,
            )  # fmt: skip
        try:
            self._observations.send(pack_observation(message))
        except TutelageError as error:  # no certificate any more, for instance; the robot holds, as no command can answer
            log.warning("%s: %s", self.node.name, error)

    def _working_cameras(self) -> dict[str, Callable[[], Array]]:
        """Those that the policy names and that take a picture now."""
        allowed = topics.cameras_in(self.node.name, _alias_set(self.node))
        working = {}
        for name, grab in getattr(self.driver, "cameras", dict)().items():
            if name not in allowed:
                self._report(f"camera {name} is not in the policy ({', '.join(allowed) or 'no cameras'}); it is left out")
                continue
            try:
                if not jpeg.available():
                    raise ConfigError("OpenCV is not installed; run: pip install 'tutelage[remote]'")
                if self._owed is None:  # else nothing may be there to be seen before the reset
                    jpeg.encode(grab(), self.config.quality)
            except Exception as error:
                self._report(f"camera {name} gives no picture, and is left out: {told(error)}")
            else:
                working[name] = grab
        return working


def _alias_set(node: Node) -> set[str]:
    return set(node.access.topics)
