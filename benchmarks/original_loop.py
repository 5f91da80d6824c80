"""The same algorithm in the shape that such code usually has, to compare with: fleet learning written robot by robot.

One Gymnasium environment a robot in a `SyncVectorEnv`, one network and one optimiser a member of the ensemble, Python
loops over robots and humans for priority, allocation and storage. Same hyper-parameters, same amount of learning, same
rule of who moves: a robot that has fallen is not simulated until a human has reset it.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import nn

from tutelage.experiments.config import RunConfig
from tutelage.fleet.policy import Policy


class StandsStill(gym.Wrapper):
    """A robot that has fallen does not move, and costs no physics, until it is reset."""

    fallen = False

    def reset(self, **kwargs: Any) -> Any:
        self.fallen = False
        obs, info = self.env.reset(**kwargs)
        self.last = obs
        return obs, info

    def step(self, action: Any) -> Any:
        if self.fallen:
            return self.last, 0.0, False, False, {}
        self.last, reward, self.fallen, truncated, info = self.env.step(action)
        return self.last, reward, False, truncated and not self.fallen, info


def network(inputs: int, outputs: int, hidden: tuple[int, ...], last: nn.Module) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs), last)


class Ensemble:
    """Members that act and learn one by one."""

    def __init__(self, obs_width: int, action_width: int, half: float, config: RunConfig) -> None:
        self.half, self.batch = half, config.learner.batch
        self.members = [network(obs_width, action_width, config.hidden, nn.Tanh()) for _ in range(config.members)]
        self.optimisers = [torch.optim.Adam(m.parameters(), lr=config.learner.learning_rate) for m in self.members]
        self.mean, self.std = np.zeros(obs_width, np.float32), np.ones(obs_width, np.float32)
        self.obs: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.bags: list[list[int]] = [[] for _ in self.members]

    def normalise(self, obs: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.clip((obs - self.mean) / self.std, -10, 10), dtype=torch.float32)

    def predictions(self, obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.stack([self.half * member(self.normalise(obs)).numpy() for member in self.members])

    def act(self, obs: np.ndarray) -> np.ndarray:
        return self.predictions(obs).mean(axis=0)

    def uncertainty(self, obs: np.ndarray) -> np.ndarray:
        return self.predictions(obs).var(axis=0).mean(axis=1) / self.half**2

    def add(self, obs: np.ndarray, action: np.ndarray) -> None:
        self.obs.append(obs)
        self.actions.append(action)
        for bag in self.bags:
            bag.extend([len(self.obs) - 1] * np.random.poisson(1.0))  # noqa: NPY002 - as such code does it

    def update(self) -> None:
        for member, optimiser, bag in zip(self.members, self.optimisers, self.bags, strict=True):
            index = np.random.randint(len(bag), size=self.batch)  # noqa: NPY002
            obs = self.normalise(np.array([self.obs[bag[i]] for i in index]))
            actions = torch.as_tensor(np.array([self.actions[bag[i]] for i in index]) / self.half, dtype=torch.float32)
            loss = nn.functional.mse_loss(member(obs), actions)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


class RiskCritic:
    """Twin critics with a replay buffer each for violations and for the rest, filled transition by transition."""

    def __init__(self, obs_width: int, action_width: int, policy: Ensemble, config: RunConfig) -> None:
        self.policy, self.c = policy, config.critic
        build = lambda: network(obs_width + action_width, 1, self.c.hidden, nn.Sigmoid())  # noqa: E731
        self.twins, self.targets = [build(), build()], [build(), build()]
        for twin, target in zip(self.twins, self.targets, strict=True):
            target.load_state_dict(twin.state_dict())
        parameters = [p for twin in self.twins for p in twin.parameters()]
        self.optimiser = torch.optim.Adam(parameters, lr=self.c.learning_rate)
        sizes = {False: self.c.capacity, True: self.c.capacity // 10}
        width = 2 * obs_width + action_width + 1
        self.buffers = {kind: np.zeros((size, width), np.float32) for kind, size in sizes.items()}
        self.count = {False: 0, True: 0}
        self.cuts = np.cumsum([obs_width, action_width, obs_width])

    def add(self, obs: np.ndarray, action: np.ndarray, next_obs: np.ndarray, event: bool) -> None:
        buffer = self.buffers[event]
        buffer[self.count[event] % len(buffer)] = np.concatenate([obs, action, next_obs, [event]])
        self.count[event] += 1

    def draw(self, kind: bool, n: int) -> np.ndarray:
        buffer = self.buffers[kind]
        return buffer[np.random.randint(min(self.count[kind], len(buffer)), size=n)]  # noqa: NPY002

    def inputs(self, obs: np.ndarray, action: np.ndarray) -> torch.Tensor:
        return torch.cat(
            [self.policy.normalise(obs), torch.as_tensor(action / self.policy.half, dtype=torch.float32)], dim=1
        )

    def risk(self, obs: np.ndarray, action: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            x = self.inputs(obs, action)
            return torch.max(self.twins[0](x), self.twins[1](x)).numpy()[:, 0]

    def update(self) -> None:
        positives = round(self.c.positives * self.c.batch) if self.count[True] else 0
        batch = np.concatenate(
            [self.draw(False, self.c.batch - positives), *([self.draw(True, positives)] if positives else [])]
        )
        obs, action, next_obs, event = np.split(batch, self.cuts, axis=1)
        with torch.no_grad():
            after = self.inputs(next_obs, self.policy.act(next_obs))
            future = torch.max(self.targets[0](after), self.targets[1](after))
            happened = torch.as_tensor(event)
            y = happened + self.c.gamma * (1 - happened) * future
        x = self.inputs(obs, action)
        loss = sum(nn.functional.mse_loss(twin(x), y) for twin in self.twins)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        with torch.no_grad():
            for twin, target in zip(self.twins, self.targets, strict=True):
                for p, q in zip(twin.parameters(), target.parameters(), strict=True):
                    q.mul_(1 - self.c.tau).add_(self.c.tau * p)


class OriginalLoop:
    """N robots, M humans, C.U.R., one update a step.

    Args:
        task: name of the Gymnasium task, without its version.
        config: hyper-parameters; those that this loop does not know are ignored.
        actor: the algorithmic humans.
        offline: obs (n, D), actions (n, A): what the human gave before the run.
        pretrain: gradient steps on it.
        tell: called with the number of robots that moved, after each timestep.
    """

    def __init__(
        self,
        task: str,
        config: RunConfig,
        actor: Policy,
        offline: tuple[np.ndarray, np.ndarray],
        pretrain: int,
        tell: Callable[[int], None],
    ) -> None:
        self.config, self.actor, self.tell = config, actor, tell
        n = config.robots
        self.envs = SyncVectorEnv(
            [lambda: StandsStill(gym.make(f"{task}-v5")) for _ in range(n)], autoreset_mode=AutoresetMode.DISABLED
        )
        space = self.envs.single_action_space
        obs, actions = offline
        self.policy = Ensemble(obs.shape[1], actions.shape[1], float(space.high[0]), config)  # type: ignore[attr-defined]
        self.policy.mean, self.policy.std = obs.mean(axis=0), obs.std(axis=0).clip(1e-2)
        for o, a in zip(obs, actions, strict=True):
            self.policy.add(o, a)
        for _ in range(pretrain):
            self.policy.update()
        self.critic = RiskCritic(obs.shape[1], actions.shape[1], self.policy, config)
        self.obs, _ = self.envs.reset(seed=config.seed)
        self.robot_of: list[int | None] = [None] * config.humans
        self.timer = [0] * config.humans
        self.t = 0

    def run(self, steps: int) -> None:
        """That many timesteps."""
        for _ in range(steps):
            self.step()

    def step(self) -> None:
        """One timestep of all robots."""
        c, n = self.config, self.config.robots
        fallen = [env.fallen for env in self.envs.envs]  # type: ignore[attr-defined]
        actions = self.policy.act(self.obs)
        uncertainty = self.policy.uncertainty(self.obs)
        risk = self.critic.risk(self.obs, actions)

        ranks = []
        for i in range(n):
            if fallen[i]:
                rank = (1.0, 0.0, 0.0)
            else:
                u = uncertainty[i] if uncertainty[i] > c.thresholds.uncertainty else 0.0  # type: ignore[operator]
                r = risk[i] if risk[i] > c.thresholds.risk else 0.0  # type: ignore[operator]
                rank = (0.0, float(u), float(r))
            ranks.append(rank)
        self.allocate(ranks, fallen)

        resetting, teleoperated = [], []
        for robot in self.robot_of:
            if robot is not None:
                (resetting if fallen[robot] else teleoperated).append(robot)
        if teleoperated:
            for robot, action in zip(teleoperated, self.actor.act(self.obs[teleoperated]), strict=True):
                actions[robot] = action
        next_obs, _, _, truncated, _ = self.envs.step(actions)
        self.tell(n - sum(fallen))

        for i in range(n):
            if not fallen[i]:
                now = self.envs.envs[i].fallen  # type: ignore[attr-defined]
                self.critic.add(self.obs[i], actions[i], next_obs[i], now)
        for robot in teleoperated:
            self.policy.add(self.obs[robot].astype(np.float32), actions[robot])

        again = np.array(truncated)
        for human, robot in enumerate(self.robot_of):
            if robot is None:
                continue
            self.timer[human] += 1
            if robot in resetting and self.timer[human] >= c.t_reset:
                again[robot] = True
                self.robot_of[human] = None
            elif robot in teleoperated and self.envs.envs[robot].fallen:  # type: ignore[attr-defined]
                self.robot_of[human] = None
        self.obs = next_obs
        if again.any():
            self.obs, _ = self.envs.reset(options={"reset_mask": again})

        self.policy.update()
        self.t += 1
        if self.t % c.critic.every == 0:
            self.critic.update()

    def allocate(self, ranks: list[tuple[float, ...]], fallen: list[bool]) -> None:
        """Keep interventions until their minimum time, then the highest priorities first."""
        c = self.config
        locked, free = set(), []
        for human, robot in enumerate(self.robot_of):
            if robot is not None and self.timer[human] < (c.t_reset if fallen[robot] else c.t_teleop):
                locked.add(robot)
            else:
                free.append(human)
        wanting = [i for i in range(c.robots) if max(ranks[i]) > 0 and i not in locked]
        wanting.sort(key=lambda i: (ranks[i], random.random()), reverse=True)
        wanting = wanting[: len(free)]
        movers = []
        for human in free:
            if self.robot_of[human] in wanting:
                wanting.remove(self.robot_of[human])
            else:
                movers.append(human)
        for human in movers:
            self.robot_of[human] = wanting.pop(0) if wanting else None
            self.timer[human] = 0
