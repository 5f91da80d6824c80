"""Quantiles of a stream against numpy on all of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.fleet.quantiles import StreamingQuantiles

VALUES = st.one_of(st.just(0.0), st.floats(1e-9, 1e6))


@given(st.lists(st.lists(VALUES, max_size=30), min_size=1, max_size=8), st.floats(0, 1))
def test_quantiles_are_those_of_the_whole_history(parts: list[list[float]], q: float) -> None:
    stream = StreamingQuantiles(0.001)
    for part in parts:
        stream.add(np.array(part))
    whole = np.concatenate([np.array(part) for part in parts])
    assert len(stream) == len(whole)
    if len(whole):
        assert stream.quantile(q) == pytest.approx(np.quantile(whole, q, method="inverted_cdf"), rel=0.00101, abs=1e-12)


def test_no_values_have_no_quantile_and_a_state_goes_round() -> None:
    stream = StreamingQuantiles()
    with pytest.raises(ValueError, match="no values"):
        stream.quantile(0.5)
    stream.add(np.array([0.0, 1.0, 2.0, 3.0]))
    other = StreamingQuantiles()
    other.add(np.array([9.0]))
    other.load_state_dict(stream.state_dict())
    assert [other.quantile(q) for q in (0.1, 0.5, 1.0)] == [stream.quantile(q) for q in (0.1, 0.5, 1.0)]


def test_memory_does_not_grow() -> None:
    stream = StreamingQuantiles()
    before = stream.counts.nbytes
    stream.add(np.random.default_rng(0).random(100_000))
    assert stream.counts.nbytes == before < 300_000
