"""All robots of a fleet network as one `Fleet`: real time, robots that come, lag, vanish, and start again elsewhere.

    with RemoteFleet.connect(Path("server")) as fleet:
        loop = Loop(fleet, policy, ...)

The slots are the robots that the policy of the fleet network names, whether they are there or not. Each step sends a command
to every robot in reach, sleeps to the next tick, and gives each robot's newest observation. `info["online"]` says who is in
reach: whoever sent something within the deadline, is what the fleet consists of, is not stopped, and is not being reset.
A reset goes on while the loop does: the robot is out of reach until the first observation of its new episode.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet, Mask
from tutelage.remote import topics
from tutelage.remote.folders import claim
from tutelage.remote.jpeg import decode
from tutelage.remote.messages import Command, Description, Flag, Malformed, Order, Weights
from tutelage.remote.robots import Robots
from tutelage.remote.slot import Slot
from tutelage.remote.tending import Tending, send
from tutelage.remote.wire import pack_command, pack_weights, unpack_weights
from tutelage.sgc.messages import Message
from tutelage.sgc.node import Node
from tutelage.sgc.reasons import Reason
from tutelage.sgc.subscription import Subscription
from tutelage.sgc.transport.base import Handle

Array = NDArray[Any]

FILE = "fleet.json"
"""In the server's folder: what the robots are, so that a server that starts again need not wait for one of them."""

REFUSED = 3
"""Messages of a robot that is not heard which the network has refused, before that is said to be why."""

_CLOCKS = ": its clock and the server's differ; set them (NTP)"
REMEDIES = {
    Reason.FUTURE.value: _CLOCKS,
    Reason.TOO_OLD.value: _CLOCKS,
    Reason.STALE.value: ": another program has sent under its name, or its clock was set back; start it again",
}


class RemoteFleet(Fleet):
    """N robots on a network; see `Fleet` for the contract.

    * Robots outside `active`, and those out of reach, hold.
    * The first `reset` resets nobody: robots go on with the episodes that they are in. Later ones ask for a hard reset where
      a robot is in violation or its episode has not ended, for a soft one otherwise.
    * It cannot be checkpointed: the world has no state that could be restored.

    Attributes:
        names: of the robots, (N,).
        description: what each of them is.
        server: 64 random bits of this start.
        late: seconds by which the last step missed its tick.
    """

    can_checkpoint = False

    def __init__(
        self,
        node: Node,
        robots: Sequence[str] | None = None,
        *,
        hz: float | None = 10.0,
        deadline: float = 0.5,
        wait: float = 30.0,
        description: Description | None = None,
        own_node: bool = False,
    ) -> None:
        """
        Args:
            node: the server's.
            robots: which of those that the policy names; default: all.
            hz: steps in a second. None: a step ends as soon as every robot in reach has answered it, at most `deadline`.
            deadline: seconds without an observation after which a robot is out of reach; at least three of its timesteps.
            wait: seconds to wait for a first robot, where it is not known yet what the robots are.
            description: what they are; default: what the last server knew, or else the first robot says.
            own_node: close the node in the end.

        Raises:
            ConfigError: no robots in the policy, or none that answers.
        """
        known = topics.robots_in(set(node.access.topics))
        self.names = known if robots is None else tuple(robots)
        if missing := sorted(set(self.names) - set(known)):
            raise ConfigError(f"the policy has no robot {missing[0]}; it has {', '.join(known) or 'none'}")
        if not self.names:
            raise ConfigError(
                f"the policy lets {node.name} drive no robot; "
                f"write one with: tutelage fleet policy ROBOT... --server {node.name}"
            )
        if hz is not None and not 0.1 <= hz <= 1000:
            raise ConfigError(f"a fleet's rate is 0.1 to 1000 Hz, not {hz:g}")
        if not deadline > 0:
            raise ConfigError(f"the deadline must be more than 0 seconds, not {deadline:g}")
        self.node, self.num_envs, self.hz, self._deadline = node, len(self.names), hz, deadline
        self._robots = Robots(self.names, deadline, node.home.path / FILE, description)
        self._slots, self._news = self._robots.slots, self._robots.news
        self.server = secrets.randbits(64) | 1
        self.late = 0.0
        self.metadata = {**self.metadata, "render_fps": round(hz or 10)}
        self._own = contextlib.ExitStack()
        if own_node:
            self._own.callback(node.close)
        self._closed = threading.Event()
        self._weights: Weights | None = None
        self._served: Handle | None = None
        self._number = 0
        self._tick = float("-inf")
        self._active: Mask = np.zeros(self.num_envs, dtype=bool)
        self._started = False
        self._commands = [node.publisher(topics.alias(name, topics.COMMAND)) for name in self.names]
        self._tending = Tending(node, self._robots, self.server)
        self._subscriptions: list[Subscription] = []
        self._lanes: dict[str, Subscription] = {}
        self._refused_before: dict[str, dict[str, int]] = {}
        for slot in self._slots:
            seen = topics.alias(slot.name, topics.OBSERVATION)
            self._lanes[slot.name] = node.subscribe(seen, partial(self._on_observation, slot))
            self._subscriptions.append(self._lanes[slot.name])
            for camera in topics.cameras_in(slot.name, set(node.access.topics)):
                lane = topics.alias(slot.name, topics.PICTURE, camera)
                self._subscriptions.append(node.subscribe(lane, partial(self._on_picture, slot, camera)))
        self._tending.start()
        try:
            self._set_spaces(self._robots.known(wait))
        except BaseException:
            self.close()
            raise
        self._obs = np.zeros((self.num_envs, *self.description.shape), np.dtype(self.description.dtype))

    @classmethod
    def connect(cls, home: Path, robots: Sequence[str] | None = None, **settings: Any) -> RemoteFleet:
        """A fleet with a node of its own.

        Args:
            home: the server's folder (`tutelage keys`).
            settings: see `__init__`.

        Raises:
            KeysError, NotIssued, ConfigError: the folder cannot be used, or another server uses it, or no robot answers.
        """
        with contextlib.ExitStack() as stack:
            stack.enter_context(claim(home, "a server"))
            node = Node.open(home)
            stack.callback(node.close)
            made = cls(node, robots, **settings)
            made._own = stack.pop_all()
        return made

    @property
    def description(self) -> Description:
        """What each robot is."""
        assert self._robots.description is not None
        return self._robots.description

    @property
    def robots(self) -> tuple[str, ...]:
        """Their names, (N,)."""
        return self.names

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the robots' cameras; one robot or another may lack some of them."""
        return self.description.cameras

    @property
    def dt(self) -> float:
        """Seconds of a timestep of a robot."""
        return self.description.dt

    @property
    def paces(self) -> bool:
        """Whether `step_wait` sleeps to the next tick."""
        return self.hz is not None

    # -- the fleet ---------------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Ask the robots of `options["reset_mask"]` for a new episode; see the class. Returns at once."""
        mask = self.reset_mask(options)
        with self._news:
            if self._started:
                for i in np.flatnonzero(mask):
                    self._want_reset(self._slots[i], None if seed is None else seed + int(i))
            self._started = True
            return self._obs.copy(), self._info(np.zeros(self.num_envs, dtype=bool))

    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        if not self._started:
            raise ContractError("reset the fleet before its first step")
        actions = np.asarray(actions, dtype=np.float32)
        now = time.monotonic()
        with self._news:
            online = self._online(now)
            moving = online if active is None else online & active
            self.check_actions(actions, moving)
            self._active, self._number = moving, self._number + 1
            orders = [self._order(i, actions[i], bool(moving[i]), now) for i in range(self.num_envs)]
        for publisher, order in zip(self._commands, orders, strict=True):
            if order is not None:
                send(self.node, publisher, order)

    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        self._wait()
        n = self.num_envs
        reward, success, truncated = np.zeros(n), np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        with self._news:
            obs = self._obs.copy()
            now = time.monotonic()
            states = self._robots.states(now)
            for i, slot in enumerate(self._slots):
                seen, before = slot.newest, slot.delivered
                if states[i] != "online" or seen is None:
                    continue
                same = before is not None and (before.boot, before.episode) == (seen.boot, seen.episode)
                if slot.was_online and not same:
                    states[i] = "restarted"  # out of reach for one step, so that no one takes two episodes for one
                    continue
                if same and before is not None and self._active[i]:
                    reward[i] = seen.episode_return - before.episode_return
                    violated = bool(seen.flags & Flag.VIOLATION)
                    success[i] = bool(seen.flags & Flag.SUCCESS) and not violated
                    over = bool(seen.flags & Flag.TRUNCATED) or seen.step >= self.horizon
                    truncated[i] = over and not violated
                slot.delivered = seen
                obs[i] = seen.obs
            self._obs = obs
            info = self._info(success, states)
            for slot, online in zip(self._slots, info["online"], strict=True):
                slot.was_online = bool(online)
        return obs.copy(), reward, info["violation"], truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Leave the topics; robots hold."""
        if self._closed.is_set():
            return
        self._closed.set()
        with self._news:
            self._news.notify_all()
        for subscription in self._subscriptions:
            subscription.close()
        if self._served is not None:
            self._served.close()
        for publisher in self._commands:
            publisher.close()
        self._tending.close()
        self._own.close()

    def state_dict(self) -> dict[str, Any]:
        raise ConfigError("a fleet of real robots cannot be checkpointed: the world has no state that could be restored")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        raise ConfigError("a fleet of real robots cannot be checkpointed: the world has no state that could be restored")

    # -- emergency stop, pictures, what there is to know; from any thread -------------------------------------------------

    def stop(self, robot: int | None = None) -> None:
        """Emergency stop of a robot, or of all: sent at once, on a lane of its own, until the robot shows it.

        A robot that cannot be reached now is stopped when it comes back.
        """
        for i in range(self.num_envs) if robot is None else (robot,):
            self._tending.stop(i)

    def clear(self, robot: int | None = None) -> None:
        """End the emergency stop of a robot, or of all."""
        for i in range(self.num_envs) if robot is None else (robot,):
            self._tending.clear(i)

    def picture(self, robot: int, camera: int = 0) -> tuple[float, NDArray[np.uint8]] | None:
        """The newest picture of a robot's camera: when it came (seconds since 1970), and (H, W, 3) uint8; None without one.

        Robots send pictures only of cameras that somebody looks at: the first call for a while gives None.
        """
        found = self.jpeg(robot, camera)
        if found is None:
            return None
        try:
            return found[0], decode(found[1])
        except Malformed:
            self._slots[robot].counts.add("malformed")
            return None

    def jpeg(self, robot: int, camera: int = 0) -> tuple[float, bytes] | None:
        """As `picture`, compressed as it came."""
        slot = self._slots[robot]
        if not 0 <= camera < len(self.cameras):
            return None
        name = self.cameras[camera]
        with self._news:
            slot.watch(name, time.monotonic())
            found = slot.pictures.get(name)
        return None if found is None else (found[0], found[1].jpeg)

    def proposals(self) -> tuple[Array, NDArray[np.int64]]:
        """What robots that have the policy themselves would do, (N, A) float32, and its version (N,); 0: they have none.

        Of the observation that the loop was given last. Where `step` gets the very same action, the robot goes on by itself.
        """
        with self._news:
            actions = np.zeros((self.num_envs, len(self.action_low)), dtype=np.float32)
            versions = np.zeros(self.num_envs, dtype=np.int64)
            for i, slot in enumerate(self._slots):
                seen = slot.delivered
                if seen is not None and seen.proposal is not None:
                    actions[i], versions[i] = seen.proposal, seen.policy
            return actions, versions

    def offer_policy(self, weights: Weights) -> None:
        """Hand out these weights to the robots that ask for them, from now on.

        Raises:
            NotAllowed: the fleet network's policy does not let this node.
        """
        if self._weights is None:
            self._served = self.node.serve(topics.WEIGHTS, self._on_weights)
        self._weights = weights

    def status(self) -> list[dict[str, Any]]:
        """Of each robot: name, state (never, gone, misfit, asking, stopped, resetting, fault, online), seconds since it was
        heard, round trip in seconds, episode, step, starts, what it and we refused, and what there is to say."""
        rows = self._robots.status()
        for row in rows:
            if row["state"] in ("never", "gone") and not row["says"]:
                row["says"] = self._why_unheard(row["name"])
        return rows

    def refused(self) -> dict[str, int]:
        """What was dropped, by reason: by this fleet, and by the network as not genuine."""
        total = self._robots.refused()
        for subscription in self._subscriptions:
            for reason, count in subscription.opener.refusals.as_dict().items():
                total[f"network_{reason}"] = total.get(f"network_{reason}", 0) + count
        return total

    def _why_unheard(self, name: str) -> str:
        """What the network refuses of a robot since it was heard last, if it does."""
        before = self._refused_before.get(name, {})
        counts = self._lanes[name].opener.refusals.as_dict()
        since = {reason: count - before.get(reason, 0) for reason, count in counts.items()}
        reason = max(since, key=lambda reason: since[reason], default="")
        if not reason or since[reason] < REFUSED:
            return ""
        return f"what it sends is refused ({reason}){REMEDIES.get(reason, '')}"

    # -- on the network's threads -------------------------------------------------------------------------------------------

    def _on_observation(self, slot: Slot, message: Message) -> None:
        now = time.monotonic()
        if (lane := self._lanes.get(slot.name)) is not None:
            self._refused_before[slot.name] = lane.opener.refusals.as_dict()
        with self._news:
            fitted = not slot.misfit
            if slot.observe(message.payload, self._robots.description, self.server, now):
                self._news.notify_all()
            elif fitted and slot.misfit:
                self._robots.misfits(slot)

    def _on_weights(self, message: Message) -> bytes:
        asked, weights = unpack_weights(message.payload), self._weights
        assert weights is not None
        return pack_weights(Weights(weights.version, b"" if asked.version == weights.version else weights.data))

    def _on_picture(self, slot: Slot, camera: str, message: Message) -> None:
        with self._news:
            names = slot.description.cameras if slot.description is not None else ()
            if camera in names:
                slot.look(message.payload, camera, message.received)
            else:
                slot.counts.add("camera")

    # -- with the lock held -------------------------------------------------------------------------------------------------

    def _online(self, now: float) -> Mask:
        """Those that the loop was told are in reach, and still are."""
        states = self._robots.states(now)
        return np.array([slot.was_online and state == "online" for slot, state in zip(self._slots, states, strict=True)])

    def _info(self, success: Mask, states: list[str] | None = None) -> dict[str, Any]:
        if states is None:
            found = self._robots.states(time.monotonic())
            states = [s if slot.was_online or s != "online" else "new" for slot, s in zip(self._slots, found, strict=True)]
        given = [slot.delivered for slot in self._slots]
        return {
            "online": np.array([state == "online" for state in states]),
            "violation": np.array([slot.has(Flag.VIOLATION) and not slot.reset for slot in self._slots]),
            "success": success,
            "stopped": np.array([slot.stopped for slot in self._slots]),
            "resetting": np.array([bool(slot.reset) or slot.has(Flag.RESETTING) for slot in self._slots]),
            "held": np.array([slot.has(Flag.HELD) for slot in self._slots]),
            "elapsed": np.array([seen.step if seen is not None else 0 for seen in given]),
            "return": np.array([seen.episode_return if seen is not None else 0.0 for seen in given]),
        }

    def _want_reset(self, slot: Slot, seed: int | None) -> None:
        ended = slot.has(Flag.SUCCESS) or slot.has(Flag.TRUNCATED)
        ended |= slot.delivered is not None and slot.delivered.step >= self.horizon
        self._tending.reset(slot, soft=ended and not slot.has(Flag.VIOLATION), seed=seed)

    def _order(self, i: int, action: Array, moving: bool, now: float) -> bytes | None:
        slot = self._slots[i]
        seen = slot.delivered if moving else slot.newest
        if seen is None or not self._robots.here(slot, now):
            return None
        period = 1.0 / self.hz if self.hz else 0.0
        order, what = (Order.ACT, action) if moving else (Order(0), action[:0])
        if moving and seen.proposal is not None and np.array_equal(action, seen.proposal):
            order, what = Order.ACT | Order.OWN, action[:0]
        slot.sent(self._number, now)
        watch = slot.watched(now)
        return pack_command(Command(self.server, self._number, seen.boot, seen.number, order, watch, period, what))

    # -- without it ---------------------------------------------------------------------------------------------------------

    def _wait(self) -> None:
        if self.hz is None:
            with self._news:
                self._news.wait_for(self._all_answered, self._deadline)
            return
        period, now = 1.0 / self.hz, time.monotonic()
        if self._tick < now - period:  # the first step, or the loop took longer than a tick: begin to count anew
            self.late = now - self._tick - period if self._tick > float("-inf") else 0.0
            self._tick = now if self.late == 0.0 else now - period
        else:
            self.late = 0.0
        self._tick += period
        self._closed.wait(max(0.0, self._tick - now))

    def _all_answered(self) -> bool:
        now = time.monotonic()
        for slot, state in zip(self._slots, self._robots.states(now), strict=True):
            seen = slot.newest
            if state != "online" or not slot.was_online or seen is None or slot.delivered is None:
                continue
            answered = seen.server == self.server and seen.executed >= self._number
            if seen.boot == slot.delivered.boot and not answered:
                return False
        return True

    def _set_spaces(self, d: Description) -> None:
        self.horizon, self.goal_conditioned = d.horizon, d.goal
        low, high = (0, 255) if d.dtype == "uint8" else (-np.inf, np.inf)
        self.single_observation_space = gym.spaces.Box(low, high, d.shape, dtype=np.dtype(d.dtype).type)
        self.single_action_space = gym.spaces.Box(
            np.array(d.action_low, np.float32), np.array(d.action_high, np.float32), dtype=np.float32
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
