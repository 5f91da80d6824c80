"""Conformal thresholds: coverage on synthetic scores, whatever their distribution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import Generator, default_rng

from tutelage.errors import ConfigError
from tutelage.fleet.conformal import miss_threshold, request_threshold

DISTRIBUTIONS: dict[str, Callable[[Generator, int], np.ndarray]] = {
    "normal": lambda rng, n: rng.standard_normal(n),
    "heavy": lambda rng, n: rng.standard_cauchy(n),
    "with ties": lambda rng, n: rng.integers(0, 4, n).astype(float),
    "constant": lambda rng, n: np.zeros(n),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
@pytest.mark.parametrize(("n", "rate"), [(19, 0.05), (40, 0.1), (100, 0.3)])
def test_new_failures_are_missed_at_most_at_the_rate(name: str, n: int, rate: float) -> None:
    rng, missed = default_rng(0), []
    for _ in range(3000):
        cases = DISTRIBUTIONS[name](rng, n + 1)
        missed.append(cases[n] <= miss_threshold(cases[:n], rate))
    assert np.mean(missed) <= rate + 3 * np.sqrt(rate / 3000)


def test_the_bound_is_tight_for_continuous_scores() -> None:
    rng, missed = default_rng(1), []
    for _ in range(5000):
        cases = rng.standard_normal(100)
        missed.append(cases[99] <= miss_threshold(cases[:99], 0.1))
    assert 0.085 < np.mean(missed) < 0.115


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_new_calm_cases_ask_at_most_at_the_rate(name: str) -> None:
    rng, asked = default_rng(2), []
    for _ in range(3000):
        cases = DISTRIBUTIONS[name](rng, 51)
        asked.append(cases[50] > request_threshold(cases[:50], 0.1))
    assert np.mean(asked) <= 0.1 + 3 * np.sqrt(0.1 / 3000)


def test_with_confidence_nearly_every_calibration_set_keeps_the_promise() -> None:
    rng = default_rng(3)
    thresholds = [miss_threshold(rng.random(200), 0.1, confidence=0.9) for _ in range(2000)]
    kept = np.mean(np.array(thresholds) <= 0.1)  # the true miss rate of a threshold on uniform scores is the threshold
    assert 0.9 <= kept < 0.95


@given(st.lists(st.floats(-1e6, 1e6), max_size=60), st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_confidence_only_makes_it_more_careful(scores: list[float], rate: float, confidence: float) -> None:
    plain = miss_threshold(np.array(scores), rate)
    if confidence >= 0.8:
        assert miss_threshold(np.array(scores), rate, confidence) <= plain
    assert miss_threshold(np.array(scores), rate / 2) <= plain
    assert request_threshold(np.array(scores), rate / 2) >= request_threshold(np.array(scores), rate)


def test_too_few_cases_promise_by_asking_always_or_never() -> None:
    assert miss_threshold(np.array([0.5] * 8), 0.1) == -np.inf
    assert miss_threshold(np.array([0.5] * 9), 0.1) < 0.5
    assert request_threshold(np.array([]), 0.1) == np.inf


@pytest.mark.parametrize(
    ("scores", "rate", "confidence"),
    [([1.0], 0.0, None), ([1.0], 1.0, None), ([1.0], 0.5, 1.0), ([np.nan], 0.5, None), ([np.inf], 0.5, None)],
)
def test_bad_numbers_are_refused(scores: list[float], rate: float, confidence: float | None) -> None:
    with pytest.raises(ConfigError, match="conformal"):
        miss_threshold(np.array(scores), rate, confidence)
