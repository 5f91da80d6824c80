"""Networks that learn side by side learn what they would learn together."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from torch import Tensor

from tutelage.learning.descent import SIDES, Descent
from tutelage.policies.networks import network
from tutelage.policies.weights import module_state


def learners(threads: int, shape=5, members: int = 3):
    """Networks, their descent, and a function that takes one step on the same data each time."""
    net = network(shape, members, 2, (6,), torch.Generator().manual_seed(0), torch.tanh)
    rng = default_rng(0)
    size = (shape,) if isinstance(shape, int) else shape
    x = torch.from_numpy(rng.normal(size=(members, 4, *size))).float()
    y = torch.from_numpy(rng.uniform(-1, 1, (members, 4, 2))).float()

    def loss(some, these: slice) -> Tensor:
        return (some(x[these]) - y[these]).square().mean(dim=(1, 2))

    descent = Descent(net, 1e-2, threads)
    return net, descent, lambda: descent.step(loss)


@pytest.mark.parametrize("shape", [5, (61, 61, 3)], ids=["vectors", "images"])
def test_the_number_of_threads_changes_nothing_but_who_works(shape) -> None:
    told = []
    for threads in (1, 2, 7):
        net, descent, step = learners(threads, shape)
        assert len(descent.nets) == min(threads, SIDES)
        told.append(([step() for _ in range(5)], module_state(net), descent.state_dict()))
    for losses, weights, moments in told[1:]:
        assert losses == pytest.approx(told[0][0], rel=1e-6)
        for name, array in weights.items():
            np.testing.assert_allclose(array, told[0][1][name], rtol=1e-5, atol=1e-7)
        assert {i: {k: v.shape for k, v in m.items()} for i, m in moments.items()} == {
            i: {k: v.shape for k, v in m.items()} for i, m in told[0][2].items()
        }


def test_steps_go_down_and_the_loss_is_the_mean_over_networks() -> None:
    _, _, step = learners(2)
    losses = [step() for _ in range(200)]
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (2, 2)])
def test_a_state_of_some_threads_goes_on_with_others(before: int, after: int) -> None:
    net, descent, step = learners(before)
    for _ in range(3):
        step()
    weights, moments = module_state(net), descent.state_dict()
    expected = [step() for _ in range(3)]
    again, other, go_on = learners(after)
    go_on()
    again.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    other.load_state_dict(moments)
    assert [go_on() for _ in range(3)] == pytest.approx(expected, rel=1e-5)


def test_one_network_has_nobody_beside_it() -> None:
    assert len(learners(4, members=1)[1].nets) == 1


def test_what_goes_wrong_in_another_thread_is_raised_here() -> None:
    net = network(3, 2, 1, (4,), torch.Generator().manual_seed(0))

    def loss(some, these: slice) -> Tensor:
        if these.start:
            raise ValueError("no data")
        return some(torch.zeros(1, 2, 3)).square().mean(dim=(1, 2))

    with pytest.raises(ValueError, match="no data"):
        Descent(net, 1e-3, 2).step(loss)
