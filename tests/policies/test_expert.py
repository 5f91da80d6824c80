"""The trained controller that acts as an algorithmic supervisor."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import default_rng

from tutelage.errors import ContractError, TutelageError
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.expert import GaussianActor
from tutelage.store import load_tree, save_tree

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32)


def make(seed: int = 0) -> GaussianActor:
    torch.manual_seed(seed)
    actor = GaussianActor(3, LOW, HIGH, (8, 8))
    with torch.no_grad():
        for p in actor.net.parameters():
            p.add_(0.3 * torch.randn_like(p))
    return actor


def test_it_looks_only_at_the_leading_features_of_an_observation() -> None:
    obs = default_rng(0).normal(size=(6, 5))
    other = obs.copy()
    other[:, 3:] += 1.0
    np.testing.assert_array_equal(make().act(obs), make().act(other))
    other[:, 2] += 1.0
    assert not np.array_equal(make().act(obs), make().act(other))


def test_actions_are_float32_within_bounds() -> None:
    actions = make().act(default_rng(0).normal(size=(100, 3)) * 50)
    assert actions.shape == (100, 2)
    assert actions.dtype == np.float32
    assert ((actions >= LOW) & (actions <= HIGH)).all()
    np.testing.assert_array_equal(make().to_action(torch.tensor([[-9.0, 9.0], [0.0, 0.0]])), [[-1.0, 4.0], [0.0, 2.0]])


def test_the_log_density_is_that_of_a_gaussian() -> None:
    actor = make()
    with torch.no_grad():
        actor.log_std.copy_(torch.tensor([-0.5, 0.2]))
    rng = torch.Generator().manual_seed(0)
    mean, u = torch.randn(7, 2, generator=rng), torch.randn(7, 2, generator=rng)
    expected = torch.distributions.Normal(mean, actor.log_std.exp()).log_prob(u).sum(-1)
    torch.testing.assert_close(actor.log_prob(mean, u), expected)


def test_a_loaded_expert_acts_like_the_saved_one(tmp_path) -> None:
    actor, obs = make(), default_rng(0).normal(size=(4, 3))
    actor.obs_mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
    actor.save(tmp_path / "expert", {"task": "Point", "score": 1.5})
    again, card = GaussianActor.load(tmp_path / "expert")
    np.testing.assert_array_equal(again.act(obs), actor.act(obs))
    assert (card["task"], card["score"]) == ("Point", 1.5)


@pytest.mark.parametrize("change", [{"features": 4}, {"features": "x"}, {"hidden": 3}, {"hidden": [9, 9]}, {"kind": None}])
def test_a_card_that_does_not_fit_the_weights_is_refused_in_one_line(change, tmp_path) -> None:
    make().save(tmp_path / "expert", {})
    tree = load_tree(tmp_path / "expert")
    tree["card"] |= change
    save_tree(tmp_path / "expert", tree)
    with pytest.raises(ContractError) as caught:
        GaussianActor.load(tmp_path / "expert")
    assert "\n" not in str(caught.value)


def test_an_ensemble_is_not_an_expert(tmp_path) -> None:
    EnsemblePolicy(3, LOW, HIGH, members=2, hidden=(4,)).save(tmp_path / "policy", {})
    with pytest.raises(ContractError, match="holds EnsemblePolicy, not GaussianActor"):
        GaussianActor.load(tmp_path / "policy")


def test_a_damaged_file_is_refused(tmp_path) -> None:
    (tmp_path / "expert").write_bytes(b"not an expert")
    with pytest.raises(TutelageError, match="damaged"):
        GaussianActor.load(tmp_path / "expert")
