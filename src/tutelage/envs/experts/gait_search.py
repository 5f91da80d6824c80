"""Find the gaits of the algorithmic human for AllegroHand: the evolution strategy that made `allegro_hand_gaits.json`.

    python -m tutelage.envs.experts.gait_search left
    python -m tutelage.envs.experts.gait_search right
    python -m tutelage.envs.experts.gait_search both --steps 200

Candidates turn the cube for some seconds from the same starts; what counts is how far. First in calm, then with noise on the
actions, where a gait also learns to heed the cube; at last both together, from goal to goal. The search is a covariance
matrix adaptation with a diagonal matrix (Ros and Hansen, 2008). It takes about ten minutes of one core each.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tyro.conf import Positional

from tutelage.envs.engine import Physics
from tutelage.envs.experts.allegro_hand import BASIS, CYCLE, FEATURES, FILE, HARMONICS, SIDES, Gait, features, follow
from tutelage.envs.tasks.allegro_hand import APART, DROPPED, HOME, RANGE, REST, TOLERANCE, AllegroHand
from tutelage.envs.tasks.base import Array
from tutelage.seeding import stream
from tutelage.store import write_atomic

CUBE, TURN = slice(16, 19), slice(19, 23)
LOSS = 4.0
"""What it costs to drop the cube or to topple it, rad."""
FLAT, UPRIGHT = 0.9, 0.5
"""Cosine of the cube's lean up to which its turn counts, and beyond which it has toppled."""


@dataclass(frozen=True)
class SearchConfig:
    """What to search, and for how long.

    Attributes:
        side: the way in which the gait is to turn the cube, as seen from above; "both": let the two gaits that are there
            take turns from goal to goal, and improve them together.
        calm: generations in calm.
        noisy: generations with noise on the actions, heeding the cube.
        noise: standard deviation of that noise, in halves of the action range.
        candidates: gaits in a generation; an even number.
        starts: episodes of each candidate.
        steps: timesteps of an episode.
        seed: root seed.
        threads: physics threads.
        again: start from the gait that is there, and skip the calm generations.
        out: file to which the gait is added.
    """

    side: Positional[Literal["left", "right", "both"]]
    calm: int = 160
    noisy: int = 140
    noise: float = 0.1
    candidates: int = 40
    starts: int = 3
    steps: int = 100
    seed: int = 1
    threads: int = 1
    again: bool = False
    out: Path = FILE


class Trial:
    """Hands that try gaits, as many at once as there are candidates and starts.

    Args:
        candidates: how many gaits, or pairs of gaits, are tried.
        starts: episodes of each.
        steps: timesteps of an episode.
        side: the way in which the cube is to be turned, without end; None: to goal after goal, as in the task.
        threads: physics threads.
    """

    def __init__(self, candidates: int, starts: int, steps: int, side: str | None, threads: int = 1) -> None:
        self.candidates, self.starts, self.steps, self.side = candidates, starts, steps, side
        self.task, self.n = AllegroHand(), candidates * starts
        self.physics = Physics(self.task.xml_path, self.n, self.task.fields, push_body="cube", threads=threads)

    def run(self, gaits: Array, rng: np.random.Generator, noise: float) -> tuple[Array, Array]:
        """How far each candidate turned the cube where it was to go, rad, and what it lost by leaving, leaning and dropping.

        Args:
            gaits: (candidates, sides, rows of a `Gait`, 16), in the order of `SIDES`; of one side only where it has one.
            rng: starts, goals and noise are the same for all candidates.
            noise: standard deviation, in halves of the action range.

        Returns:
            Turns and losses, (candidates, starts).
        """
        physics, n, everyone = self.physics, self.n, np.arange(self.n)
        qpos, qvel = self.task.initial(rng, self.starts, physics.qpos0, physics.qvel0)
        physics.restart(everyone, np.tile(qpos, (self.candidates, 1)), np.tile(qvel, (self.candidates, 1)))
        rows = np.repeat(gaits, self.starts, axis=0)
        periods = rows[:, :, :1] + np.einsum("nshj,hk->nskj", rows[:, :, 1 : 1 + 2 * HARMONICS], BASIS)
        feedback = rows[:, :, 1 + 2 * HARMONICS :]
        courses = np.tile(self._courses(rng), (self.candidates, 1))
        goal, left, at = np.zeros(n, dtype=np.intp), courses[:, 0].copy(), np.zeros(n, dtype=np.intp)
        previous = periods[everyone, at, np.tile(rng.integers(CYCLE, size=self.starts), self.candidates)]
        turned, lost, going, frame = np.zeros(n), np.zeros(n), np.ones(n, dtype=bool), physics.frame
        yaw, _ = _yaw_and_lean(frame["qpos"])
        for t in range(self.steps):
            at = (left < 0).astype(np.intp) if self.side is None else at
            heeded = features(frame["qpos"][:, CUBE], frame["qpos"][:, TURN])
            actions = follow(periods[everyone, at], feedback[everyone, at], heeded, previous)
            previous = (actions + noise * np.tile(rng.standard_normal((self.starts, 16)), (self.candidates, 1))).clip(-1, 1)
            command = self.task.control(frame, previous)
            physics.advance_async(np.flatnonzero(going), command, None, self.task.frame_skip).results()
            before, (yaw, upright) = yaw, _yaw_and_lean(frame["qpos"])
            turn = (yaw - before + np.pi) % (2 * np.pi) - np.pi
            away = np.linalg.norm(frame["qpos"][:, CUBE] - REST, axis=1)
            turned += np.where(going & (upright > FLAT), np.sign(left) * turn, 0.0)
            left = left - turn
            there = going & (np.abs(left) < TOLERANCE) & (upright > np.cos(TOLERANCE))
            goal += there
            left = np.where(there, courses[everyone, goal], left)
            lost += np.where(going, 0.2 * away + 0.05 * (1 - upright), 0.0)
            over = going & ((away > DROPPED) | (upright < UPRIGHT) | (physics.unstable != 0))
            lost += np.where(over, LOSS + 0.03 * (self.steps - t), 0.0)
            going &= ~over
        shape = (self.candidates, self.starts)
        return turned.reshape(shape), lost.reshape(shape)

    def _courses(self, rng: np.random.Generator) -> Array:
        """How far each goal is from the one before, (starts, goals), rad; more goals than there are timesteps."""
        shape = (self.starts, self.steps + 1)
        if self.side:
            return np.full(shape, SIDES[self.side] * np.inf)
        return rng.uniform(APART, np.pi, shape) * rng.choice([-1.0, 1.0], shape)  # type: ignore[no-any-return]


class Evolution:
    """The distribution of candidates: CMA-ES with a diagonal matrix and mirrored samples.

    Args:
        mean: (n,) where to begin.
        scale: (n,) standard deviations, times `step`.
        step: the step size.
        candidates: in a generation.
        rng: source of the samples.
    """

    def __init__(self, mean: Array, scale: Array, step: float, candidates: int, rng: np.random.Generator) -> None:
        n, best = len(mean), candidates // 2
        self.mean, self.variance, self.step, self.candidates, self.rng = mean, scale**2, step, candidates, rng
        self.weights = np.log(best + 0.5) - np.log(np.arange(1, best + 1))
        self.weights /= self.weights.sum()
        self.mass = 1 / float(np.square(self.weights).sum())
        self.path, self.step_path, self.generation = np.zeros(n), np.zeros(n), 0
        self.c_path = (4 + self.mass / n) / (n + 4 + 2 * self.mass / n)
        self.c_step = (self.mass + 2) / (n + self.mass + 5)
        faster = (n + 2) / 3  # than with a full matrix: there is less to learn
        self.c_one = faster * 2 / ((n + 1.3) ** 2 + self.mass)
        self.c_rank = min(1 - self.c_one, faster * 2 * (self.mass - 2 + 1 / self.mass) / ((n + 2) ** 2 + self.mass))
        self.damping = 1 + self.c_step + 2 * max(0.0, float(np.sqrt((self.mass - 1) / (n + 1))) - 1)
        self.expected = float(np.sqrt(n)) * (1 - 1 / (4 * n) + 1 / (21 * n * n))

    def ask(self) -> Array:
        """Candidates (candidates, n)."""
        half = self.rng.standard_normal((self.candidates // 2, len(self.mean)))
        self._z = np.concatenate([half, -half])
        return self.mean + self.step * np.sqrt(self.variance) * self._z  # type: ignore[no-any-return]

    def tell(self, fitness: Array) -> None:
        """What those candidates were worth, (candidates,), more is better."""
        best = np.argsort(-fitness, kind="stable")[: len(self.weights)]
        z = self._z[best]
        y = np.sqrt(self.variance) * z
        self.mean = self.mean + self.step * (self.weights @ y)
        c, self.generation = self.c_step, self.generation + 1
        self.step_path = (1 - c) * self.step_path + np.sqrt(c * (2 - c) * self.mass) * (self.weights @ z)
        length = float(np.linalg.norm(self.step_path))
        short = length / np.sqrt(1 - (1 - c) ** (2 * self.generation)) < (1.4 + 2 / (len(z[0]) + 1)) * self.expected
        c = self.c_path
        self.path = (1 - c) * self.path + short * np.sqrt(c * (2 - c) * self.mass) * (self.weights @ y)
        old = 1 - self.c_one - self.c_rank
        self.variance = old * self.variance + self.c_one * self.path**2 + self.c_rank * (self.weights @ y**2)
        self.step = min(0.4, self.step * float(np.exp(self.c_step / self.damping * (length / self.expected - 1))))


def search(config: SearchConfig) -> Array:
    """Find gaits, (sides, rows of a `Gait`, 16), and add them to the file."""
    sides = tuple(SIDES) if config.side == "both" else (config.side,)
    if config.again or config.side == "both":
        known = json.loads(config.out.read_text(encoding="utf-8"))
        gaits = np.stack([Gait.of(known[side]["numbers"]).numbers for side in sides])
    else:
        gaits = _evolve(config, _first_guess()[None], config.calm, 0.0)
    gaits = _evolve(config, gaits, config.noisy, config.noise)
    found = json.loads(config.out.read_text(encoding="utf-8")) if config.out.exists() else {}
    for side, gait in zip(sides, gaits, strict=True):
        found[side] = {"noise": config.noise, "seed": config.seed, "numbers": gait.ravel().round(4).tolist()}
    write_atomic(config.out, (json.dumps(found, sort_keys=True) + "\n").encode())
    return gaits


def _evolve(config: SearchConfig, gaits: Array, generations: int, noise: float) -> Array:
    scale = np.ones(gaits.shape)
    scale[:, 3 : 1 + 2 * HARMONICS] = 0.5
    scale[:, 1 + 2 * HARMONICS :] = 0.4 if noise else 0.0
    side = None if config.side == "both" else config.side
    rng = stream(config.seed, f"gait search/{config.side}/{noise}")
    step = 0.15 if not noise else 0.06 if side else 0.03
    evolution = Evolution(gaits.ravel(), scale.ravel(), step, config.candidates, rng)
    trial = Trial(config.candidates, config.starts, config.steps, side, config.threads)
    check = Trial(1, 60, config.steps, side, config.threads)
    for generation in range(generations):
        turned, lost = trial.run(evolution.ask().reshape(config.candidates, *gaits.shape), rng, noise)
        worth = turned - lost
        evolution.tell(worth.mean(axis=1) - 0.3 * worth.std(axis=1))
        if generation % 20 == 19:
            turned, lost = check.run(evolution.mean.reshape(1, *gaits.shape), stream(config.seed, "gait check"), noise)
            print(
                f"{config.side}, noise {noise:g}, generation {generation + 1}: turns {turned.mean():.2f} rad in "
                f"{config.steps / 20:.0f} s, fails in {(lost > LOSS).mean():.0%}",
                flush=True,
            )
    return evolution.mean.reshape(gaits.shape)


def _first_guess() -> Array:
    """Fingers stand around the cube and swing to and fro."""
    gait = np.zeros((1 + 2 * HARMONICS + FEATURES, 16))
    gait[0] = 2 * (HOME - RANGE[0]) / (RANGE[1] - RANGE[0]) - 1
    gait[1, [0, 4, 8]], gait[2, [1, 5, 9, 13]] = 0.4, 0.15
    return gait


def _yaw_and_lean(qpos: Array) -> tuple[Array, Array]:
    """Yaw of the cubes, rad, and the cosine of their lean, (N,) each."""
    w, x, y, z = qpos[:, TURN].T
    return 2 * np.arctan2(z, w), 1 - 2 * (x * x + y * y)


if __name__ == "__main__":
    search(tyro.cli(SearchConfig, description=__doc__))
