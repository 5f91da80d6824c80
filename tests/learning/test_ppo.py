"""PPO: advantages by the book, a policy that improves, and training that goes on bit for bit."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import ELAPSED, EPISODE, POSITION, PointFleet

from tutelage.envs import experts
from tutelage.errors import ConfigError, ContractError, RunFolderError, TutelageError
from tutelage.experiments.recording import lock
from tutelage.experiments.train_expert import ExpertConfig, train
from tutelage.learning.ppo import PPO, PPOConfig, RunningMoments
from tutelage.policies.expert import GaussianActor
from tutelage.store import load_tree

SMALL = PPOConfig(rollout=16, minibatch=32, hidden=(16,))


class Diary(PointFleet):
    """Notes what each step returned, and rewards what the position says."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.pages: list[tuple[Any, ...]] = []

    def step_wait(self) -> Any:
        before = self.obs
        obs, _, terminated, truncated, info = super().step_wait()
        reward = 1.0 - np.abs(obs[:, POSITION])
        self.pages.append((before, obs, reward, terminated, truncated))
        return obs, reward, terminated, truncated, info


# -- running moments ------------------------------------------------------------------------------------------------


def test_running_moments_are_those_of_everything_so_far() -> None:
    rng = np.random.default_rng(0)
    batches = [rng.normal(3, (1, 10), (n, 2)) for n in (1, 7, 400)]
    moments = RunningMoments(2)
    for batch in batches:
        moments.update(batch)
    np.testing.assert_allclose(moments.mean, np.concatenate(batches).mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(moments.std, np.concatenate(batches).std(axis=0), rtol=1e-3)


def test_the_standard_deviation_of_a_constant_is_not_zero() -> None:
    moments = RunningMoments(1)
    moments.update(np.full((100_000, 1), 5.0))
    assert moments.std == 1e-3


# -- advantages -----------------------------------------------------------------------------------------------------


def recomputed(ppo: PPO, pages: list[tuple[Any, ...]]) -> tuple[list[float], list[float]]:
    """Targets and advantages in plain Python, robot by robot, as the papers write them."""
    c, robots, horizon = ppo.config, ppo.fleet.num_envs, len(pages)

    def value(obs: Any) -> list[float]:
        with torch.no_grad():
            return [float(v) for v in ppo.critic(ppo.actor.normalise(obs))[:, 0]]

    seen, discounted, scaled = RunningMoments(1), [0.0] * robots, []
    for _, _, reward, terminated, truncated in pages:
        paid = [float(reward[i]) - c.fall_penalty * bool(terminated[i]) for i in range(robots)]
        discounted = [c.gamma * d + r for d, r in zip(discounted, paid, strict=True)]
        seen.update(np.array(discounted)[:, None])
        scaled.append([r / float(seen.std[0]) for r in paid])
        discounted = [0.0 if terminated[i] or truncated[i] else d for i, d in enumerate(discounted)]

    values = [value(page[0]) for page in pages]
    after = [value(page[1]) for page in pages]
    targets = [[0.0] * robots for _ in pages]
    advantages = [[0.0] * robots for _ in pages]
    for i in range(robots):
        for t in range(horizon):
            total, weight = 0.0, 1.0
            for k in range(t, horizon):
                _, _, _, terminated, truncated = pages[k]
                future = 0.0 if terminated[i] else after[k][i]
                total += weight * (scaled[k][i] + c.gamma * future - values[k][i])
                weight *= c.gamma * c.lam
                if terminated[i] or truncated[i]:
                    break
            advantages[t][i], targets[t][i] = total, total + values[t][i]
    return [x for row in targets for x in row], [x for row in advantages for x in row]


@pytest.mark.parametrize("penalty", [0.0, 2.0])
def test_advantages_are_those_of_a_recomputation_in_plain_python(penalty: float) -> None:
    fleet = Diary(5, horizon=6, bound=0.3, noise=0.1, falls={4: [1], 9: [2]})
    ppo = PPO(fleet, 2, dataclasses.replace(SMALL, fall_penalty=penalty), seed=1)
    batch = ppo._collect()
    ends = [page[3:] for page in fleet.pages]
    assert any(terminated.any() for terminated, _ in ends)
    assert any(truncated.any() for _, truncated in ends)
    targets, advantages = recomputed(ppo, fleet.pages)
    np.testing.assert_allclose(batch["target"].numpy(), targets, rtol=2e-4, atol=2e-5)
    a = np.array(advantages)
    np.testing.assert_allclose(batch["advantage"].numpy(), (a - a.mean()) / a.std(ddof=1), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("how", "bootstrapped"), [("timeout", True), ("fall", False)])
def test_a_timeout_is_bootstrapped_and_a_fall_is_not(how: str, bootstrapped: bool) -> None:
    fleet = Diary(2, horizon=16 if how == "timeout" else 1000, falls={} if how == "timeout" else {15: [0, 1]})
    ppo = PPO(fleet, 2, dataclasses.replace(SMALL, lam=0.0), seed=1)
    with torch.no_grad():
        ppo.critic[-1].bias.fill_(100.0)  # the critic expects very much of any state
    batch = ppo._collect()
    last = batch["target"].reshape(16, 2)[-1]
    terminated, truncated = fleet.pages[-1][3:]
    assert terminated.all() != bootstrapped
    assert truncated.all() == bootstrapped
    assert bool((last > 90).all()) is bootstrapped


def test_the_value_at_a_timeout_is_of_the_state_it_led_to_and_not_of_the_next_episode() -> None:
    fleet = Diary(1, horizon=16, drift=0.1)
    ppo = PPO(fleet, 3, dataclasses.replace(SMALL, lam=0.0), seed=1)
    asked: list[Any] = []
    ppo.critic.register_forward_hook(lambda module, args, out: asked.append(args[0].clone()))
    ppo._collect()
    final = asked[-1].numpy()[0]
    assert final[ELAPSED] == 10, "16 timesteps, clipped to 10 standard deviations"
    assert final[EPISODE] == 0
    assert ppo._obs[0, ELAPSED] == 0
    assert ppo._obs[0, EPISODE] == 1


def test_returns_of_finished_episodes_leave_out_the_penalty_and_say_who_survived() -> None:
    fleet = PointFleet(3, horizon=10, falls={3: [1]})
    ppo = PPO(fleet, 2, dataclasses.replace(SMALL, rollout=10, fall_penalty=5.0), seed=0)
    ppo._collect()
    assert sorted(ppo.finished) == [(4.0, 0.0), (10.0, 1.0), (10.0, 1.0)]
    assert ppo.steps == 30


# -- learning -------------------------------------------------------------------------------------------------------


def test_ppo_improves_the_return_on_a_trivial_fleet() -> None:
    fleet = Diary(16, horizon=20, start=1.0, noise=0.01)
    ppo = PPO(fleet, 1, PPOConfig(rollout=20, epochs=5, minibatch=80, hidden=(16,), learning_rate=1e-3), seed=0)
    progress = [ppo.iterate()["return"] for _ in range(40)]
    assert np.mean(progress[-5:]) > np.mean(progress[:5]) + 3
    assert ppo.actor.act(np.array([[0.8, 0, 0, 0], [-0.8, 0, 0, 0]]))[:, 0] == pytest.approx([-1, 1], abs=0.5)


def test_progress_is_reported_by_name_and_is_nan_while_no_episode_has_ended() -> None:
    ppo = PPO(PointFleet(4, horizon=100), 2, SMALL, seed=0)
    progress = ppo.iterate()
    assert {"steps", "return", "survived", "kl", "learning_rate", "std"} == set(progress)
    assert progress["steps"] == 64
    assert math.isnan(progress["return"])
    assert math.isfinite(progress["kl"])


@pytest.mark.parametrize(
    ("kl", "factor"), [(0.0, 1.1), (0.012 / 1.6, 1.1), (0.012, 1.0), (0.012 * 1.4, 1.0), (0.1, 1 / 1.3)]
)
def test_the_learning_rate_follows_the_divergence(kl: float, factor: float) -> None:
    ppo = PPO(PointFleet(2), 2, SMALL, seed=0)
    ppo._adapt(kl)
    assert ppo.learning_rate == pytest.approx(3e-4 * factor)
    assert {group["lr"] for group in ppo.optimiser.param_groups} == {ppo.learning_rate}


def test_the_learning_rate_stays_within_its_bounds() -> None:
    ppo = PPO(PointFleet(2), 2, SMALL, seed=0)
    for _ in range(100):
        ppo._adapt(1.0)
    assert ppo.learning_rate == 3e-5
    for _ in range(100):
        ppo._adapt(0.0)
    assert ppo.learning_rate == 1e-3


def test_the_seed_decides_everything() -> None:
    def weights(seed: int) -> list[Any]:
        ppo = PPO(PointFleet(4, horizon=10, noise=0.1), 2, SMALL, seed)
        for _ in range(3):
            ppo.iterate()
        return [p.detach().clone() for p in ppo.parameters]

    one, same, other = weights(0), weights(0), weights(1)
    assert all(torch.equal(a, b) for a, b in zip(one, same, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize(
    "changes",
    [{"rollout": 0}, {"epochs": 0}, {"minibatch": 0}, {"hidden": (0,)}, {"gamma": 1.5}, {"lam": -1.0}, {"learning_rate": 0.0},
     {"learning_rate": math.nan}, {"target_kl": 0.0}],
    ids=str,
)  # fmt: skip
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="PPO needs"):
        PPOConfig(**changes)


# -- going on -------------------------------------------------------------------------------------------------------


def test_training_goes_on_bit_for_bit(tmp_path: Path) -> None:
    def make() -> PPO:
        return PPO(PointFleet(4, horizon=10, noise=0.1, bound=0.4), 2, SMALL, seed=0)

    whole, part = make(), make()
    for _ in range(3):
        whole.iterate()
        part.iterate()
    part.save(tmp_path / "ppo")
    again = make()
    again.load(tmp_path / "ppo")
    for _ in range(3):
        one, other = whole.iterate(), again.iterate()
        assert json.dumps(one) == json.dumps(other)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters, again.parameters, strict=True))


def test_a_checkpoint_of_other_networks_or_another_kind_is_refused(tmp_path: Path) -> None:
    PPO(PointFleet(4), 2, SMALL, 0).save(tmp_path / "ppo")
    with pytest.raises(ContractError, match="ppo does not fit this fleet and these settings; use those that wrote it"):
        PPO(PointFleet(4), 2, dataclasses.replace(SMALL, hidden=(8,)), 0).load(tmp_path / "ppo")
    GaussianActor(2, np.array([-1.0]), np.array([1.0]), (4,)).save(tmp_path / "actor", {})
    with pytest.raises(ContractError, match="actor does not fit this fleet"):
        PPO(PointFleet(4), 2, SMALL, 0).load(tmp_path / "actor")
    (tmp_path / "ppo").write_bytes(b"garbage")
    with pytest.raises(TutelageError, match="ppo is damaged or not a Tutelage file"):
        PPO(PointFleet(4), 2, SMALL, 0).load(tmp_path / "ppo")


# -- train-expert ---------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores over a few episodes: here it matters what is written, not how well it walks."""
    pytest.importorskip("mujoco")
    score = experts.evaluate
    monkeypatch.setattr(
        experts, "evaluate", lambda *args, **kwargs: dataclasses.replace(score(*args, **{**kwargs, "episodes": 4}))
    )


def expert(out: Path, steps: int) -> ExpertConfig:
    ppo = PPOConfig(rollout=32, minibatch=64, hidden=(8,))
    return ExpertConfig(
        "Walker2d", steps=steps, robots=4, seed=3, out=out, evaluate_every=128, threads=1, torch_threads=1, ppo=ppo
    )


@pytest.mark.usefixtures("quick")
def test_training_leaves_weights_with_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["tutelage", "train-expert", "Walker2d", "--steps", "512"])
    said: list[str] = []
    path = train(expert(tmp_path, 512), said.append)
    assert path == tmp_path / "Walker2d.safetensors"
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        ".lock",
        "Walker2d.safetensors",
        "best.safetensors",
        "ppo.safetensors",
    ]
    actor, card = experts.load("Walker2d", path)
    assert actor.act(np.zeros((3, 17))).shape == (3, 6)
    assert card["task"] == "Walker2d"
    assert card["command"] == "tutelage train-expert Walker2d --steps 512"
    assert card["seed"] == 3
    assert card["steps"] in (128, 256, 384, 512)
    assert card["trained_at"] == "moderate"
    assert list(card["scores"]) == ["none", "moderate"]
    assert card["scores"]["none"].keys() == {"level", "mean", "sd", "survived", "success", "episodes", "seed"}
    assert not experts.is_expert(card)
    assert any(line.startswith("short of the published expert (3492)") for line in said)
    assert said[-1] == f"weights: {path}"


@pytest.mark.usefixtures("quick")
def test_training_that_was_cut_short_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    train(expert(tmp_path / "whole", 512), lambda line: None)
    train(expert(tmp_path / "parts", 256), lambda line: None)
    said: list[str] = []
    train(expert(tmp_path / "parts", 512), said.append)
    assert said[0] == "continuing at 256 of 512 steps"
    whole, parts = (load_tree(tmp_path / name / "ppo.safetensors") for name in ("whole", "parts"))
    for part in ("actor", "critic"):
        for name, array in whole[part].items():
            np.testing.assert_array_equal(array, parts[part][name])
    assert whole["rng"] == parts["rng"]
    cards = [load_tree(tmp_path / name / "best.safetensors")["card"] for name in ("whole", "parts")]
    assert cards[0] == cards[1]


@pytest.mark.usefixtures("quick")
def test_training_that_is_over_is_scored_again(tmp_path: Path) -> None:
    first = train(expert(tmp_path, 128), lambda line: None).read_bytes()
    said: list[str] = []
    assert train(expert(tmp_path, 128), said.append).read_bytes() == first
    assert said[0] == "continuing at 128 of 128 steps"


def test_two_do_not_train_in_one_folder(tmp_path: Path) -> None:
    with (
        lock(tmp_path),
        pytest.raises(RunFolderError, match="is in use by another process; wait for it or choose another folder"),
    ):
        train(expert(tmp_path, 128), lambda line: None)


@pytest.mark.usefixtures("quick")
def test_training_with_another_fleet_does_not_go_on_from_the_checkpoint(tmp_path: Path) -> None:
    train(expert(tmp_path, 128), lambda line: None)
    with pytest.raises(ContractError, match=r"ppo.safetensors does not fit this fleet and these settings"):
        train(dataclasses.replace(expert(tmp_path, 512), robots=5), lambda line: None)
