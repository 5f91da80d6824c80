"""The ensemble: its mean acts, its spread is its uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from tutelage.errors import ContractError, TutelageError
from tutelage.fleet.policy import UncertainPolicy
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.weights import load_module_state, module_state
from tutelage.store import load_tree, save_tree

LOW, HIGH = np.array([-1.0, 0.0, -3.0], np.float32), np.array([1.0, 4.0, 1.0], np.float32)


def make(members: int = 5, seed: int = 0, **rest) -> EnsemblePolicy:
    return EnsemblePolicy(6, LOW, HIGH, members=members, hidden=(16,), seed=seed, **rest)


def spoken(policy: EnsemblePolicy, obs: np.ndarray) -> np.ndarray:
    """What each member would do, in units of the action: (K, N, A)."""
    x = torch.from_numpy(((obs - policy.obs_mean.numpy()) / policy.obs_std.numpy()).clip(-10, 10)).float()
    u = policy.net(x).detach().numpy().astype(np.float64)
    return (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * u


@given(members=st.integers(1, 6), seed=st.integers(0, 100), scale=st.sampled_from([0.1, 1.0, 30.0]))
def test_uncertainty_is_ensemble_variance_over_that_of_low_and_high_mean_over_actions(members, seed, scale) -> None:
    policy, obs = make(members, seed), scale * default_rng(seed).normal(size=(9, 6))
    pair_variance = np.var(np.stack([LOW, HIGH]), axis=0)
    by_hand = (np.var(spoken(policy, obs), axis=0) / pair_variance).mean(axis=1)
    found = policy.uncertainty(obs)
    assert found.shape == (9,)
    np.testing.assert_allclose(found, by_hand, rtol=1e-4, atol=1e-7)
    assert ((found >= 0) & (found <= 1)).all()


def test_the_mean_of_the_members_acts_within_the_bounds() -> None:
    policy, obs = make(), default_rng(0).normal(size=(50, 6)) * 20
    actions = policy.act(obs)
    assert isinstance(policy, UncertainPolicy)
    assert actions.shape == (50, 3)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, spoken(policy, obs).mean(axis=0), rtol=1e-4, atol=1e-5)
    assert ((actions >= LOW) & (actions <= HIGH)).all()


def test_members_that_agree_are_certain() -> None:
    policy = make()
    with torch.no_grad():
        for p in policy.net.parameters():
            p.copy_(p[:1].expand_as(p))
    assert policy.uncertainty(default_rng(0).normal(size=(4, 6))).max() < 1e-10


def test_the_spread_grows_away_from_what_the_members_learnt() -> None:
    policy = make()
    near = torch.from_numpy(default_rng(0).normal(size=(64, 6))).float()
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-2)
    for _ in range(150):
        optimiser.zero_grad()
        policy.loss(near.expand(5, -1, -1), torch.zeros(5, 64, 3)).sum().backward()
        optimiser.step()
    policy.forget()
    assert policy.uncertainty(8 * near.numpy()).mean() > 10 * policy.uncertainty(near.numpy()).mean()


def test_loss_is_squared_error_in_units_of_half_the_range() -> None:
    policy, rng = make(2), default_rng(0)
    obs, actions = rng.normal(size=(2, 7, 6)), rng.uniform(LOW, HIGH, (2, 7, 3))
    u = (actions - (LOW + HIGH) / 2) / ((HIGH - LOW) / 2)
    said = policy.net(torch.from_numpy(obs).float()).detach().numpy()
    loss = policy.loss(torch.from_numpy(obs).float(), torch.from_numpy(actions).float())
    assert loss.tolist() == pytest.approx(np.square(said - u).mean(axis=(1, 2)), rel=1e-5)


def test_inputs_are_z_scored_and_clipped_and_constant_ones_are_harmless() -> None:
    policy, data = make(), default_rng(0).normal(5.0, 3.0, size=(1000, 6))
    data[:, 2] = 7.0
    policy.set_normalisation(data)
    z = policy.normalise(torch.from_numpy(data).float())
    moving = [0, 1, 3, 4, 5]
    torch.testing.assert_close(z[:, moving].mean(0), torch.zeros(5), atol=1e-4, rtol=0)
    torch.testing.assert_close(z[:, moving].std(0), torch.ones(5), atol=1e-2, rtol=0)
    assert (z[:, 2] == 0).all()
    assert policy.normalise(torch.full((1, 6), 1e9)).max() == 10


def test_action_and_uncertainty_of_the_same_observations_cost_one_pass() -> None:
    policy, calls = make(), []
    ask = policy._ask_compiled
    policy._ask_compiled = lambda *arguments: calls.append(1) or ask(*arguments)
    obs = default_rng(0).normal(size=(4, 6))
    policy.act(obs)
    policy.uncertainty(obs)
    assert len(calls) == 1
    policy.act(obs.copy())
    assert len(calls) == 2


def test_new_normalisation_is_heeded_at_once() -> None:
    policy, obs = make(), default_rng(0).normal(size=(4, 6))
    before = policy.act(obs)
    policy.set_normalisation(obs * 3 + 1)
    assert not np.array_equal(policy.act(obs), before)


def test_a_loaded_ensemble_acts_like_the_saved_one(tmp_path) -> None:
    policy, obs = make(4, seed=3), default_rng(0).normal(size=(5, 6))
    policy.set_normalisation(default_rng(1).normal(2.0, 5.0, size=(50, 6)))
    policy.save(tmp_path / "policy", {"task": "Point", "seed": 3})
    again, card = EnsemblePolicy.load(tmp_path / "policy")
    assert card["task"] == "Point"
    np.testing.assert_array_equal(again.act(obs), policy.act(obs))
    np.testing.assert_array_equal(again.uncertainty(obs), policy.uncertainty(obs))


def damage(tree, what: str):
    """A saved ensemble with something missing or out of shape."""
    weights, card = tree["weights"], tree["card"]
    return {
        "no card": {"weights": weights},
        "no weights": {"card": card},
        "card of another kind": {"weights": weights, "card": {**card, "kind": "GaussianActor"}},
        "card that is a list": {"weights": weights, "card": [1]},
        "weights that are a list": {"weights": [1], "card": card},
        "no hidden": {"weights": weights, "card": {k: v for k, v in card.items() if k != "hidden"}},
        "wrong hidden": {"weights": weights, "card": {**card, "hidden": [5]}},
        "hidden that is text": {"weights": weights, "card": {**card, "hidden": "xy"}},
        "a missing layer": {"weights": {k: v for k, v in weights.items() if k != "net.weights.1"}, "card": card},
        "a number as a layer": {"weights": {**weights, "net.weights.1": 1.0}, "card": card},
        "a number as the first layer": {"weights": {**weights, "net.weights.0": 1.0}, "card": card},
        "a flat first layer": {"weights": {**weights, "net.weights.0": np.zeros(3, np.float32)}, "card": card},
        "bounds that do not match": {"weights": {**weights, "action_half": np.ones(7, np.float32)}, "card": card},
    }[what]


DAMAGES = ["no card", "no weights", "card of another kind", "card that is a list", "weights that are a list", "no hidden",
           "wrong hidden", "hidden that is text", "a missing layer", "a number as a layer", "a number as the first layer",
           "a flat first layer", "bounds that do not match"]  # fmt: skip


@pytest.mark.parametrize("what", DAMAGES)
def test_a_file_that_holds_something_else_is_refused_in_one_line(what, tmp_path) -> None:
    make().save(tmp_path / "policy", {})
    save_tree(tmp_path / "bad", damage(load_tree(tmp_path / "policy"), what))
    with pytest.raises(ContractError) as caught:
        EnsemblePolicy.load(tmp_path / "bad")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_said_so(tmp_path) -> None:
    with pytest.raises(TutelageError, match="no such file"):
        EnsemblePolicy.load(tmp_path / "nothing")


def test_a_state_in_memory_is_a_copy() -> None:
    policy = make()
    state = module_state(policy)
    with torch.no_grad():
        policy.net.weights[0].add_(1.0)
    assert not np.array_equal(state["net.weights.0"], policy.net.weights[0].detach().numpy())
    load_module_state(policy, state)
    np.testing.assert_array_equal(state["net.weights.0"], policy.net.weights[0].detach().numpy())


@pytest.mark.parametrize("robots", [1, 100, 300])
@pytest.mark.parametrize("hidden", [(), (16, 8)])
def test_compiled_answers_are_those_of_pytorch(robots, hidden) -> None:
    """Also for more robots than one thread is asked about at a time."""
    policy = EnsemblePolicy(6, np.array([-1.0, 0.0]), np.array([1.0, 5.0]), members=4, hidden=hidden, seed=1, threads=2)
    policy.set_normalisation(default_rng(1).normal(2.0, 3.0, (50, 6)))
    obs = default_rng(0).normal(2.0, 30.0, (robots, 6))  # some are clipped
    action, spread = policy._ask_torch(obs)
    np.testing.assert_allclose(policy.act(obs), action, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy.uncertainty(obs), spread, rtol=1e-4, atol=1e-6)
    assert policy.act(obs).dtype == np.float32


def test_weights_that_are_not_numbers_give_actions_that_are_not() -> None:
    """The loop refuses such actions; a rectifier must not hide them."""
    policy = make()
    policy.net.weights[0].data[:] = np.nan
    assert np.isnan(policy.act(np.ones((2, 6)))).all()
