"""Thresholds with a guarantee, for any score (chapter 9 asks for them; Vovk et al. 2005, Vovk 2012).

A robot asks where its score is above a threshold. Given scores of n cases like those to come (exchangeable with them):

    miss_threshold     of failures: at most the fraction `rate` of new failures stays without a request
    request_threshold  of states (or episodes) without failure: at most the fraction `rate` of new ones makes a request

Nothing is assumed about the score or its distribution; a bad score costs requests, not the guarantee. Without `confidence`,
the bound holds on average over calibration sets; with it, for this very calibration set with that probability.
Take the largest score of an episode as the score of a case: timesteps of one episode are not exchangeable.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError

Array = NDArray[Any]


def miss_threshold(failures: Array, rate: float, confidence: float | None = None) -> float:
    """The highest threshold at which at most a fraction `rate` of failures is missed: scores (n,) of n failures.

    A failure is missed where its score is not above the threshold. -inf (always ask) if n is too small to promise it.

    Raises:
        ConfigError: rate or confidence outside (0, 1), or scores that are not finite.
    """
    scores = _checked(failures, rate, confidence)
    k = _allowed(len(scores), rate, confidence)
    return float(np.nextafter(scores[k - 1], -np.inf)) if k else -math.inf


def request_threshold(calm: Array, rate: float, confidence: float | None = None) -> float:
    """The lowest threshold at which at most a fraction `rate` of calm cases makes a request: scores (n,) of n such cases.

    Returns inf (never ask) if n is too small to promise it.

    Raises:
        ConfigError: rate or confidence outside (0, 1), or scores that are not finite.
    """
    return -miss_threshold(-np.asarray(calm, dtype=np.float64), rate, confidence)


def _checked(scores: Array, rate: float, confidence: float | None) -> Array:
    for name, value in (("rate", rate), ("confidence", confidence)):
        if value is not None and not 0 < value < 1:
            raise ConfigError(f"a conformal {name} must be between 0 and 1, got {value}")
    scores = np.sort(np.asarray(scores, dtype=np.float64).ravel())
    if not np.isfinite(scores).all():
        raise ConfigError("conformal calibration needs finite scores")
    return scores


def _allowed(n: int, rate: float, confidence: float | None) -> int:
    """How many of n cases may lie below: the largest k for which the (k)-th smallest score keeps the promise.

    The probability that a new score lies below the k-th smallest of n is k / (n + 1) on average over calibration sets
    (exactly, for continuous scores), and Beta(k, n + 1 - k) distributed from one calibration set to the next.
    """
    if confidence is None:
        return math.floor(rate * (n + 1) + 1e-12)
    k = 0
    while k < n and _beta_cdf(k + 1, n - k, rate) >= confidence:
        k += 1
    return k


def _beta_cdf(a: int, b: int, x: float) -> float:
    """P(Beta(a, b) <= x) for integers: the probability of at least a successes in a + b - 1 trials."""
    n, log_x, log_y = a + b - 1, math.log(x), math.log1p(-x)
    log_choose = [math.lgamma(n + 1) - math.lgamma(j + 1) - math.lgamma(n - j + 1) for j in range(a, n + 1)]
    terms = [c + j * log_x + (n - j) * log_y for c, j in zip(log_choose, range(a, n + 1), strict=True)]
    return math.fsum(math.exp(term) for term in terms)
