"""K networks trained side by side are K networks."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import nn

from tutelage.policies.mlp import BatchedMLP


def pair(hidden: tuple[int, ...], members: int = 3, seed: int = 0):
    """A batched network, and separate ones with the same weights."""
    batched = BatchedMLP(members, 5, 2, hidden, torch.Generator().manual_seed(seed), last=torch.tanh)
    separate = []
    for k in range(members):
        layers: list[nn.Module] = []
        for weight, bias in zip(batched.weights, batched.biases, strict=True):
            layer = nn.Linear(weight.shape[1], weight.shape[2])
            layer.weight.data, layer.bias.data = weight[k].T.detach().clone(), bias[k, 0].detach().clone()
            layers += [layer, nn.ReLU()]
        separate.append(nn.Sequential(*layers[:-1], nn.Tanh()))
    return batched, separate


@pytest.mark.parametrize("hidden", [(), (7,), (16, 8, 4)])
def test_outputs_and_gradients_are_those_of_separate_networks(hidden) -> None:
    batched, separate = pair(hidden)
    x = torch.randn(3, 11, 5, generator=torch.Generator().manual_seed(1))
    y = torch.randn(3, 11, 2, generator=torch.Generator().manual_seed(2))
    out = batched(x)
    (out - y).square().mean(dim=(1, 2)).sum().backward()
    for k, net in enumerate(separate):
        alone = net(x[k])
        torch.testing.assert_close(out[k], alone, rtol=1e-5, atol=1e-6)
        (alone - y[k]).square().mean().backward()
        linears = [layer for layer in net if isinstance(layer, nn.Linear)]
        for weight, bias, layer in zip(batched.weights, batched.biases, linears, strict=True):
            torch.testing.assert_close(weight.grad[k], layer.weight.grad.T, rtol=1e-4, atol=1e-6)
            torch.testing.assert_close(bias.grad[k, 0], layer.bias.grad, rtol=1e-4, atol=1e-6)


def test_the_same_inputs_for_all_members_need_not_be_repeated() -> None:
    batched, _ = pair((7,))
    x = torch.randn(11, 5, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(batched(x), batched(x.repeat(3, 1, 1)))
    assert batched(x).shape == (3, 11, 2)


def test_weights_come_from_the_generator_and_members_differ() -> None:
    (one, _), (same, _), (other, _) = pair((7,)), pair((7,)), pair((7,), seed=1)
    assert torch.equal(one.weights[0], same.weights[0])
    assert not torch.equal(one.weights[0], other.weights[0])
    assert not torch.equal(one.weights[0][0], one.weights[0][1])


def test_initial_weights_are_as_wide_as_those_of_torch() -> None:
    net = BatchedMLP(4, 64, 32, (100,), torch.Generator().manual_seed(0))
    for weight, bias in zip(net.weights, net.biases, strict=True):
        bound = 1 / np.sqrt(weight.shape[1])
        for values in (weight.detach(), bias.detach()):
            assert values.abs().max() <= bound
            assert values.std() == pytest.approx(bound / np.sqrt(3), rel=0.1)


def test_arrays_are_the_parameters_whatever_happens_to_these() -> None:
    def check(net: BatchedMLP) -> None:
        for arrays, parameters in zip(net.arrays(), (net.weights, net.biases), strict=True):
            for array, parameter in zip(arrays, parameters, strict=True):
                array += 1.0
                np.testing.assert_array_equal(array, parameter.detach().numpy())

    net, (other, _) = pair((7,))[0], pair((7,), seed=1)
    check(net)
    net.load_state_dict(other.state_dict())
    check(net)
    before = net.arrays()
    net.adopt(*(tuple(array * 2 for array in arrays) for arrays in before))
    check(net)
    net.weights[0].data = torch.zeros_like(net.weights[0])
    check(net)
    again = copy.deepcopy(net)
    check(again)
    assert not np.array_equal(again.arrays()[0][0], net.arrays()[0][0])
