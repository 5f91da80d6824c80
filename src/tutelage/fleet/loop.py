"""The loop. Every algorithm of the dissertation is this loop with four choices: policy, priority, supervisors, learner.

    observe -> score -> allocate -> act -> step -> reset and re-observe -> record -> learn

What is learned from humans alone may be learned while robots move: what humans want is known before (`PromptLearner`). With
`overlap`, the policy learns from the timesteps before while all of this one but acting goes on.

A single robot with one human is a fleet with N = M = 1. Everything else (recording, progress, checkpoints, plots, the
console) subscribes to the loop's steps; the loop does not know it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.discrepancy import discrepancy
from tutelage.fleet.events import Journal
from tutelage.fleet.execution import AsWanted, Execution
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.modes import HELPED, MOVING, Event, Mode, transition
from tutelage.fleet.policy import Learner, Policy, PromptLearner
from tutelage.fleet.priority import Priority
from tutelage.fleet.step import Step, Subscriber
from tutelage.fleet.supervisor import Team
from tutelage.fleet.view import FleetView, Signal
from tutelage.seeding import derive, rng_state, set_rng_state, stream

Array = NDArray[Any]


class Loop:
    """N robots, M humans, one policy.

    Args:
        fleet: the robots.
        policy: pi_theta, shared by all robots.
        priority: p-hat.
        team: the M humans.
        allocator: omega, with t_T and t_R.
        learner: the update function f of eq. 5.3; None: the policy stays as it is.
        signals: how to compute what the priority looks at, by name; `uncertainty` is the policy's own by default.
        subscribers: listeners.
        execution: what a robot executes while a human is in control; by default what the human wants.
        overlap: learn while all else of a timestep goes on. The update at step t then sees the data up to t - 1; it still
            changes the policy from t + 1 on.
        wait: robots that need a human stand still until one is with them, instead of going on by themselves meanwhile.
        seed: root seed.
    """

    def __init__(
        self,
        fleet: Fleet,
        policy: Policy,
        priority: Priority,
        team: Team,
        allocator: FleetDAgger | None = None,
        learner: Learner | None = None,
        signals: Mapping[str, Signal] | None = None,
        subscribers: Sequence[Subscriber] = (),
        execution: Execution | None = None,
        overlap: bool = False,
        wait: bool = False,
        seed: int = 0,
    ) -> None:
        if len(team) > fleet.num_envs:
            raise ConfigError(f"{len(team)} humans for {fleet.num_envs} robots: use at most one human a robot (M <= N)")
        if not fleet.can_pause and (team.pauses or wait):
            reason = "waiting for a human" if wait else "switching latency"
            raise ConfigError(f"{reason} needs a fleet that can pause robots, and this one cannot")
        self.fleet, self.policy, self.priority, self.team = fleet, policy, priority, team
        self.allocator, self.execution = allocator or FleetDAgger(), execution or AsWanted()
        self.learner, self.overlap, self.wait, self.subscribers = learner, overlap, wait, list(subscribers)
        self._prompt = learner if isinstance(learner, PromptLearner) else None
        self.signals: dict[str, Signal] = {"uncertainty": lambda view: policy.uncertainty(view.obs)}  # type: ignore[attr-defined]
        if not hasattr(policy, "uncertainty"):
            del self.signals["uncertainty"]
        self.signals |= signals or {}

        n = fleet.num_envs
        self.t = 0
        self.in_step = False
        """Whether a timestep has begun and not ended: then the state is not one to save."""
        self.stop_requested = False
        """Set it to end the run after the present timestep."""
        self.rng = stream(seed, "loop/ties")
        self.mode = np.full(n, Mode.AUTONOMOUS, dtype=np.int8)
        self.age = np.zeros(n, dtype=np.int64)
        self.robot_of = np.full(len(team), NOBODY)
        self.human_action = np.full((n, len(fleet.action_low)), np.nan, dtype=np.float32)
        self.discrepancy = np.full(n, np.nan)
        self.fresh = np.ones(n, dtype=bool)
        self.journal = Journal()
        self.obs, info = fleet.reset(seed=derive(seed, "fleet") % 2**32)
        self.violation, self.online = info["violation"], info.get("online", np.ones(n, dtype=bool))

    def run(self, steps: int) -> None:
        """Run until timestep `steps`, telling the subscribers; an exception reaches them as the end of the run."""
        for subscriber in self.subscribers:
            subscriber.on_start(self)
        try:
            while self.t < steps and not self.stop_requested:
                step = self.step()
                for subscriber in self.subscribers:
                    subscriber.on_step(self, step)
        finally:
            for subscriber in self.subscribers:
                subscriber.on_end(self)

    def step(self) -> Step:
        """One timestep of all robots."""
        self.journal.t, self.in_step = self.t, True
        self._reach()
        view = self._observe()
        if self._prompt and self.overlap:
            self._prompt.begin(self.t)  # only now: acting wants all cores
        waiting = self._allocate(self.priority(view))
        (actions, wanted, silent), mode, human = self._act(view), self.mode.copy(), self.human_of
        held = silent | waiting
        losses: dict[str, float] = {}

        if self._prompt and not self.overlap:
            taught = (mode == Mode.TELEOPERATED) & ~held
            self._prompt.hear(self.t, view.obs[taught], wanted[taught])
            self._prompt.begin(self.t)
        self.fleet.step_async(actions, active=MOVING[mode] & ~held)
        if self.learner and self.overlap:
            losses = self.learner.update(self.t)
        next_obs, reward, _, truncated, info = self.fleet.step_wait()

        success = info["success"] & ~info["violation"]  # a robot that fell has not completed anything
        self.online = info.get("online", self.online)
        self._finish(next_obs, info["violation"], success, truncated, held)
        step = Step(
            self.t, view.obs, view.actions, actions, wanted, mode, human, reward, next_obs,
            info["violation"], success, truncated, self.journal.take(), view.computed, losses, held,
        )  # fmt: skip
        if self.learner:
            self.learner.record(step)
            if not self.overlap:
                losses.update(self.learner.update(self.t))
        self.t += 1
        self.in_step = False
        return step

    @property
    def human_of(self) -> Array:
        """The human who is with each robot, (N,), or -1."""
        human = np.full(self.fleet.num_envs, NOBODY)
        (busy,) = np.nonzero(self.robot_of != NOBODY)
        human[self.robot_of[busy]] = busy
        return human

    # -- the phases of a step, in their order -------------------------------------------------------------------

    def _reach(self) -> None:
        """Note who went out of reach, and who is back."""
        away = self.mode == Mode.OFFLINE
        if self.online.all() and not away.any():
            return
        (lost,) = np.nonzero(~self.online & ~away)
        self._happen(Event.DISCONNECT, lost, self.human_of[lost])
        back = self.online & away
        self.fresh |= back
        for event, mask in ((Event.CONNECT, ~self.violation), (Event.CONNECT_VIOLATED, self.violation)):
            (robots,) = np.nonzero(back & mask)
            self._happen(event, robots, np.full(len(robots), NOBODY))

    def _observe(self) -> FleetView:
        self._check(self.obs, "the observation")
        actions = np.asarray(self.policy.act(self.obs))
        expected = (self.fleet.num_envs, len(self.fleet.action_low))
        if actions.shape != expected:
            raise ContractError(f"{type(self.policy).__name__}.act must return {expected}, got {actions.shape}")
        self._check(actions, f"the action of {type(self.policy).__name__}")
        return FleetView(
            self.t, self.obs, actions, self.violation, HELPED[self.mode], self.age, self.human_action, self.discrepancy,
            self.fresh, len(self.team), self.rng, self.signals,
        )  # fmt: skip

    def _allocate(self, ranks: Array) -> Array:
        """Send the humans to the robots; returns who stands still until somebody comes, (N,) bool."""
        if ranks.ndim != 2 or len(ranks) != self.fleet.num_envs or not ranks.shape[1]:
            raise ContractError(f"a priority must return ({self.fleet.num_envs}, K), got {ranks.shape}")
        before = self.robot_of
        away = self.mode == Mode.OFFLINE
        if away.any():
            ranks = np.where(away[:, None], 0.0, ranks)  # nobody can help them
        # A reset that is over, or a fall while teleoperated, ended the intervention: its human is free again.
        ended = ~HELPED[self.mode[np.maximum(before, 0)]]
        self.robot_of = self.allocator(ranks, before, self.mode, self.age, self.rng)
        helped = self.robot_of[self.robot_of != NOBODY].tolist()
        if len(set(helped)) < len(helped):
            raise ContractError("the allocation sends two humans to one robot; eq. 5.1 allows one")
        changed = self.robot_of != before

        (left,) = np.nonzero((before != NOBODY) & changed & ~ended)
        down = self.violation[before[left]]
        self._happen(Event.RELEASE, before[left[~down]], left[~down])
        self._happen(Event.ABANDON, before[left[down]], left[down])
        (came,) = np.nonzero((self.robot_of != NOBODY) & (changed | ended))
        self._happen(Event.ASSIGN, self.robot_of[came], came)

        (busy,) = np.nonzero(self.robot_of != NOBODY)
        robots = self.robot_of[busy]
        ready = (self.mode[robots] == Mode.SWITCHING) & self.team.ready(robots, busy, self.age[robots])
        broken = self.violation[robots]
        self._happen(Event.START_RESET, robots[ready & broken], busy[ready & broken])
        self._happen(Event.TAKE_OVER, robots[ready & ~broken], busy[ready & ~broken])
        stuck = (self.mode[robots] == Mode.TELEOPERATED) & self.team.resets(robots, busy)
        self._happen(Event.START_RESET, robots[stuck], busy[stuck])
        return np.asarray(self.wait & (ranks > 0).any(axis=1) & (self.mode == Mode.AUTONOMOUS))

    def _act(self, view: FleetView) -> tuple[Array, Array, Array]:
        """What the robots are to do and what the humans want, (N, A), and whose human says nothing, (N,) bool."""
        actions = view.actions.astype(np.float32, copy=True)
        wanted, self.discrepancy = np.full_like(actions, np.nan), np.full(len(actions), np.nan)
        silent = np.zeros(len(actions), dtype=bool)
        (robots,) = np.nonzero(self.mode == Mode.TELEOPERATED)
        if robots.size:
            low, high = self.fleet.action_low, self.fleet.action_high
            said = np.clip(self.team.act(view.obs[robots], robots, self.human_of[robots], actions.shape[1]), low, high)
            nothing = np.isnan(said).any(axis=1)
            if nothing.any():
                silent[robots[nothing]] = True
                robots, said = robots[~nothing], said[~nothing]
            wanted[robots] = self.human_action[robots] = said
            self.discrepancy[robots] = discrepancy(view.actions[robots], said, low, high)
            actions[robots] = np.clip(self.execution(self.t, said, view.actions[robots]), low, high)
        return actions, wanted, silent

    def _finish(self, obs: Array, violation: Array, success: Array, truncated: Array, held: Array) -> None:
        """End of the step: note what happened, reset whom it is due, and look again."""
        self.age += 1
        human = self.human_of
        moving = MOVING[self.mode] & ~held
        (fallen,) = np.nonzero(moving & violation)
        self._happen(Event.VIOLATE, fallen, human[fallen])
        for event, mask in ((Event.SUCCESS, success), (Event.TIMEOUT, truncated & ~success & ~violation)):
            (robots,) = np.nonzero(moving & mask)
            self._happen(event, robots, human[robots])
        (righted,) = np.nonzero(self.mode == Mode.RESETTING)
        due = self.age[righted] >= self.allocator.t_reset
        righted = righted[self.team.has_reset(righted, human[righted], due)]
        self._happen(Event.HARD_RESET, righted, human[righted])

        again = moving & (success | truncated) & ~violation
        again[righted] = True
        self.obs, self.violation, self.fresh = obs, violation, again
        if again.any():
            self._check(obs, "the last observation")  # the loop goes on from another one, but critics learn from it
            self.obs, info = self.fleet.reset(options={"reset_mask": again})
            self.violation, self.online = info["violation"], info.get("online", self.online)

    def _check(self, values: Array, what: str) -> None:
        if len(values) != self.fleet.num_envs:
            raise ContractError(f"{what} is there for {len(values)} robots, and the fleet has {self.fleet.num_envs}")
        if not np.isfinite(values).all():
            bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
            raise ContractError(f"{what} is not finite for robot {int(np.argmax(bad))} at timestep {self.t}")

    def _happen(self, event: Event, robots: Array, humans: Array) -> None:
        if len(robots):
            after = transition(self.mode, robots, event)
            self.age[robots] = np.where(after == self.mode[robots], self.age[robots], 0)
            self.mode[robots] = after
            self.journal.add(event, robots, humans, after)

    # -- resume -------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit, as nested dictionaries of arrays and JSON values."""
        return {
            "t": self.t,
            "rng": rng_state(self.rng),
            "mode": self.mode.copy(),
            "age": self.age.copy(),
            "robot_of": self.robot_of.copy(),
            "human_action": self.human_action.copy(),
            "discrepancy": self.discrepancy.copy(),
            "fresh": self.fresh.copy(),
            "obs": np.array(self.obs),
            "violation": np.array(self.violation),
            "fleet": self.fleet.state_dict(),
            "team": self.team.state_dict(),
            "priority": self.priority.state_dict(),
            "execution": self.execution.state_dict(),
            "allocator": self.allocator.state_dict(),
            **({"learner": self.learner.state_dict()} if self.learner else {}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.t = state["t"]
        set_rng_state(self.rng, state["rng"])
        for name in ("mode", "age", "robot_of", "human_action", "discrepancy", "fresh", "obs", "violation"):
            setattr(self, name, state[name].copy())
        self.online = np.ones(self.fleet.num_envs, dtype=bool)  # until the fleet says otherwise
        self.fleet.load_state_dict(state["fleet"])
        self.team.load_state_dict(state["team"])
        self.priority.load_state_dict(state["priority"])
        self.execution.load_state_dict(state["execution"])
        if "allocator" in state:  # one without memory leaves nothing in a file
            self.allocator.load_state_dict(state["allocator"])
        if self.learner:
            self.learner.load_state_dict(state["learner"])
