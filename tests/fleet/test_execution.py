"""What is executed while a human is in control."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from tutelage.errors import ConfigError
from tutelage.fleet.execution import AsWanted, BetaMixture, NoiseInjection

WANTED, PROPOSED = np.full((4000, 2), 0.5), np.zeros((4000, 2))


def test_injected_noise_has_the_asked_for_variance_in_units_of_half_the_range() -> None:
    noise = NoiseInjection(0.09, np.array([-1.0, 0.0]), np.array([1.0, 4.0]), default_rng(0))
    done = noise(0, WANTED, PROPOSED)
    np.testing.assert_allclose(done.std(axis=0), [0.3, 0.6], rtol=0.05)
    np.testing.assert_allclose(done.mean(axis=0), 0.5, atol=0.05)


def test_dagger_executes_the_human_with_probability_beta_to_the_epoch() -> None:
    mixture = BetaMixture(0.5, 10, default_rng(0))
    shares = [(mixture(t, WANTED, PROPOSED)[:, 0] == 0.5).mean() for t in (0, 9, 10, 25)]
    np.testing.assert_allclose(shares, [0.5, 0.5, 0.25, 0.125], atol=0.04)
    assert (BetaMixture(0.0, 10, default_rng(0))(0, WANTED, PROPOSED) == 0).all()


@pytest.mark.parametrize("make", [
    AsWanted, lambda: NoiseInjection(0.1, -np.ones(2), np.ones(2), default_rng(3)), lambda: BetaMixture(0.5, 3, default_rng(3)),
])  # fmt: skip
def test_an_execution_continues_after_a_round_trip_of_its_state(make) -> None:
    one, other = make(), make()
    for t in range(5):
        one(t, WANTED, PROPOSED)
    other.load_state_dict(one.state_dict())
    np.testing.assert_array_equal(one(5, WANTED, PROPOSED), other(5, WANTED, PROPOSED))


@pytest.mark.parametrize("make", [
    lambda: NoiseInjection(-1.0, -np.ones(2), np.ones(2), default_rng(0)),
    lambda: NoiseInjection(np.inf, -np.ones(2), np.ones(2), default_rng(0)),
    lambda: BetaMixture(1.5, 3, default_rng(0)), lambda: BetaMixture(0.5, 0, default_rng(0)),
])  # fmt: skip
def test_bad_numbers_are_refused(make) -> None:
    with pytest.raises(ConfigError):
        make()
