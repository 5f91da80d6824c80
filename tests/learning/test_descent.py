"""Networks that learn side by side learn what each would learn alone, with PyTorch's own Adam."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import default_rng

from tutelage.learning.descent import Descent
from tutelage.policies.networks import network
from tutelage.policies.weights import module_state

MEMBERS = 3


def made(shape=5):
    """Networks, their descent, and a function that takes one step on the same data each time."""
    net = network(shape, MEMBERS, 2, (6,), torch.Generator().manual_seed(0), torch.tanh)
    rng = default_rng(0)
    size = (shape,) if isinstance(shape, int) else shape
    x = torch.from_numpy(rng.normal(size=(MEMBERS, 4, *size))).float()
    y = torch.from_numpy(rng.uniform(-1, 1, (MEMBERS, 4, 2))).float()

    def losses(members=slice(None)):
        return (net(x) - y).square().mean(dim=(1, 2))[members]

    descent = Descent(net, 1e-2)
    return net, descent, losses, lambda: descent.step(losses())


@pytest.mark.parametrize("shape", [5, (61, 61, 3)], ids=["vectors", "images"])
def test_each_network_goes_down_its_own_loss(shape) -> None:
    together = made(shape)
    told = [together[3]() for _ in range(5)]
    seen = []
    for member in range(MEMBERS):
        net, _, losses, _ = made(shape)
        alone = torch.optim.Adam(net.parameters(), lr=1e-2)
        seen.append([])
        for _ in range(5):
            loss = losses()[member]
            seen[-1].append(float(loss.detach()))
            alone.zero_grad()
            loss.backward()
            alone.step()
        for name, array in module_state(net).items():
            np.testing.assert_allclose(array[member], module_state(together[0])[name][member], rtol=1e-4, atol=1e-6)
    assert told == pytest.approx(np.mean(seen, axis=0), rel=1e-5)


def test_a_saved_state_goes_on_as_if_nothing_had_been() -> None:
    net, descent, _, step = made()
    for _ in range(3):
        step()
    weights, moments = module_state(net), descent.state_dict()
    expected = [step() for _ in range(3)]
    again, other, _, go_on = made()
    go_on()
    again.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    other.load_state_dict(moments)
    assert [go_on() for _ in range(3)] == expected
    assert expected[-1] < float(made()[2]().mean())
