"""The discrepancy classifier: learns where the human would do something else, follows the policy, and says when it is blind."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import default_rng

from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.dataset import AggregatedDataset
from tutelage.policies.ensemble import EnsemblePolicy

LOW, HIGH = -np.ones(2), np.ones(2)


class Still(EnsemblePolicy):
    """A policy that does one thing."""

    def __init__(self, action: float = 0.0) -> None:
        super().__init__(3, LOW, HIGH, members=1, hidden=(4,))
        self.action = action

    def act(self, obs):
        return np.full((len(obs), 2), self.action, dtype=np.float32)


def data(n: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """A human who acts (0.8, 0.8) where the first number of obs is positive, and does nothing elsewhere."""
    obs = default_rng(0).standard_normal((n, 3)).astype(np.float32)
    return obs, np.repeat(np.where(obs[:, :1] > 0, 0.8, 0.0), 2, axis=1)


def make(policy: EnsemblePolicy, beta_h: float = 0.1, pairs: int = 400, seed: int = 0) -> DiscrepancyClassifier:
    dataset = AggregatedDataset((3,), 2, 1, default_rng(1))
    classifier = DiscrepancyClassifier(policy, dataset, default_rng(2), seed, beta_h=beta_h, batch=64, hidden=(32, 32))
    obs, actions = data()
    if pairs:
        dataset.add(obs[:pairs], actions[:pairs])
        classifier.held_out.add(obs[pairs:], actions[pairs:])
    return classifier


def test_discrepancy_is_the_squared_distance_as_a_fraction_of_the_largest() -> None:
    values = make(Still()).discrepancies(np.zeros((3, 3)), np.array([[1, 1], [0, 0], [0.8, 0.8]]))
    np.testing.assert_allclose(values, [0.25, 0.0, 0.16], rtol=1e-6)


def test_it_learns_where_the_human_would_do_something_else() -> None:
    classifier = make(Still())
    classifier.updates(300)
    obs = default_rng(5).standard_normal((500, 3))
    sure = np.abs(obs[:, 0]) > 0.2
    assert ((classifier(obs) >= 0.5) == (obs[:, 0] > 0))[sure].mean() > 0.97


def test_labels_follow_the_policy() -> None:
    policy = Still()
    classifier = make(policy)
    classifier.updates(200)
    policy.action = 0.8
    classifier.updates(400)
    obs = default_rng(5).standard_normal((500, 3))
    sure = np.abs(obs[:, 0]) > 0.2
    assert ((classifier(obs) >= 0.5) == (obs[:, 0] < 0))[sure].mean() > 0.95


def test_data_of_one_class_are_said_to_be_so() -> None:
    with pytest.warns(
        UserWarning, match="all 600 human data are safe: the classifier will never ask; choose a lower beta_h"
    ):
        make(Still(), beta_h=0.9).warn_if_blind()
    with pytest.warns(UserWarning, match="are unsafe: the classifier will always ask"):
        make(Still(0.4), beta_h=0.0).warn_if_blind()
    with pytest.warns(UserWarning, match="no data"):
        make(Still(), pairs=0).warn_if_blind()


def test_without_data_nothing_is_learned() -> None:
    classifier = make(Still(), pairs=0)
    classifier.held_out = AggregatedDataset((3,), 2, 1, default_rng(1))
    assert np.isnan(classifier.updates(5))


def test_it_continues_bit_for_bit_after_a_round_trip_of_its_state() -> None:
    one, other = make(Still()), make(Still(), seed=9, beta_h=0.3)
    one.updates(20)
    other.load_state_dict(one.state_dict())
    one.updates(20)
    other.updates(20)
    obs = torch.randn(7, 3).numpy()
    np.testing.assert_array_equal(one(obs), other(obs))
    assert other.beta_h == 0.1


def test_a_classifier_sees_what_its_policy_sees() -> None:
    """Images that are bright where the human would act."""
    policy = EnsemblePolicy((64, 64, 3), LOW, HIGH, members=1)
    policy.act = lambda obs: np.zeros((len(obs), 2), np.float32)  # type: ignore[method-assign]
    bright = default_rng(0).random(40) > 0.5
    obs = np.where(bright[:, None, None, None], 200, 20).astype(np.uint8) * np.ones((1, 64, 64, 3), np.uint8)
    policy.set_normalisation(obs)
    dataset = AggregatedDataset((64, 64, 3), 2, 1, default_rng(1), dtype=torch.uint8)
    classifier = DiscrepancyClassifier(policy, dataset, default_rng(2), 0, beta_h=0.1, batch=16)
    dataset.add(obs[:30], 0.8 * np.repeat(bright[:30, None], 2, axis=1))
    classifier.held_out.add(obs[30:], 0.8 * np.repeat(bright[30:, None], 2, axis=1))
    assert classifier.held_out.obs.rows.dtype == torch.uint8
    classifier.updates(40)
    assert ((classifier(obs) >= 0.5) == bright).all()
