"""Networks that learn side by side learn what each would learn alone, with PyTorch's own Adam."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from numpy.random import default_rng

from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.descent import Descent
from tutelage.learning.regression import BatchedRegression, CompiledRegression, regression
from tutelage.policies.ensemble import EnsemblePolicy
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
    assert expected[-1] < float(made()[2]().mean().detach())


# -- compiled -------------------------------------------------------------------------------------------------------


def ensemble(hidden: tuple[int, ...], actions: int = 2, seed: int = 0, threads: int = 2) -> EnsemblePolicy:
    low, high = np.full(actions, -2.0), np.full(actions, 1.0)
    policy = EnsemblePolicy(5, low, high, members=MEMBERS, hidden=hidden, seed=seed, threads=threads)
    policy.set_normalisation(default_rng(9).normal(1.0, 2.0, (50, 5)))
    return policy


def pairs(n: int = 40, actions: int = 2) -> AggregatedDataset:
    rng = default_rng(1)
    data = AggregatedDataset((5,), actions, MEMBERS, default_rng(2))
    data.add(rng.normal(1.0, 4.0, (n, 5)), rng.uniform(-2, 1, (n, actions)))
    return data


@pytest.mark.parametrize("hidden", [(), (7,), (16, 8, 4)])
@pytest.mark.parametrize("batch", [1, 6])
def test_compiled_steps_are_those_of_automatic_differentiation(hidden, batch) -> None:
    compiled, reference = ensemble(hidden), ensemble(hidden)
    one, other = regression(compiled, 1e-2), Descent(reference.net, 1e-2)
    assert isinstance(one, CompiledRegression)
    data, same = pairs(), pairs()
    for _ in range(30):
        one.begin(data, batch)
        loss = other.step(reference.loss(*same.batches(batch)))
        assert one.end() == pytest.approx(loss, rel=1e-4)
        for mine, theirs in zip(compiled.net.parameters(), reference.net.parameters(), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=2e-5)


def test_compiled_moments_are_those_of_pytorchs_adam_and_go_both_ways() -> None:
    compiled, reference = ensemble((7,)), ensemble((7,))
    one, other = regression(compiled, 1e-2), BatchedRegression(reference, 1e-2)
    assert one.state_dict() == {}
    data, same = pairs(), pairs()
    for _ in range(3):
        one.begin(data, 6)
        one.end()
        other.begin(same, 6)
        other.end()
    mine, theirs = one.state_dict(), other.state_dict()
    assert mine.keys() == theirs.keys()
    for position, moments in mine.items():
        for name, array in moments.items():
            assert array.shape == theirs[position][name].shape
            np.testing.assert_allclose(array, theirs[position][name], rtol=1e-3, atol=1e-7)
    again = ensemble((7,))
    again.load_state_dict(compiled.state_dict())
    go_on = regression(again, 1e-2)
    go_on.load_state_dict(mine)
    more = data.state_dict()
    for each in (one, go_on):
        data.load_state_dict(more)
        each.begin(data, 6)
        each.end()
    assert all(torch.equal(a, b) for a, b in zip(compiled.net.parameters(), again.net.parameters(), strict=True))
    go_on.load_state_dict({})
    assert go_on.state_dict() == {}


def test_the_number_of_threads_changes_no_bit() -> None:
    said = []
    for threads in (1, 2, 3):
        policy, data = ensemble((64, 64), threads=threads), pairs()
        learner = regression(policy, 1e-2)
        for _ in range(5):
            learner.begin(data, 32)
            learner.end()
        obs = default_rng(3).normal(size=(300, 5))
        said.append((policy.act(obs), policy.uncertainty(obs)))
    for action, uncertainty in said[1:]:
        np.testing.assert_array_equal(action, said[0][0])
        np.testing.assert_array_equal(uncertainty, said[0][1])


@pytest.mark.parametrize("compiled", [True, False])
def test_a_policy_is_what_it_was_until_the_end_of_a_step(compiled) -> None:
    policy, data, obs = ensemble((64, 64)), pairs(), default_rng(3).normal(size=(4, 5))
    learner = regression(policy, 1e-2) if compiled else BatchedRegression(policy, 1e-2)
    for _ in range(5):
        before, weights = policy.act(obs), module_state(policy)
        learner.begin(data, 32)
        for _ in range(20):
            np.testing.assert_array_equal(policy.act(obs.copy()), before)
        assert all(np.array_equal(array, weights[name]) for name, array in module_state(policy).items())
        learner.end()
        policy.forget()
        assert not np.array_equal(policy.act(obs), before)


def test_what_goes_wrong_in_the_background_is_raised_at_the_end() -> None:
    policy, data = ensemble((7,)), pairs()
    learner = BatchedRegression(policy, 1e-2)
    policy.loss = lambda *_: torch.zeros(1) / "nothing"  # type: ignore[operator]
    learner.begin(data, 4)
    with pytest.raises(TypeError):
        learner.end()


def test_moments_without_a_gradient_fade_to_zero_and_never_to_denormal_numbers() -> None:
    from tutelage.learning.compiled import _adam

    old, new, first, second = (np.full(40, value, np.float32) for value in (1.0, 0.0, 1e-3, 1e-6))
    gradient = np.zeros(40, np.float32)
    tiny = np.finfo(np.float32).tiny
    for _ in range(1500):
        _adam(old, new, gradient, first, second, np.float32(1e-3), np.float32(1.0))
        assert not ((first != 0) & (np.abs(first) < tiny)).any()
        old[:] = new
    assert (first == 0).all()
    assert (second > 0).all(), "this one fades more slowly"
    assert np.isfinite(new).all()


def test_a_gradient_that_is_no_number_is_not_hidden() -> None:
    from tutelage.learning.compiled import _adam

    old, new, first, second = (np.ones(3, np.float32) for _ in range(4))
    _adam(old, new, np.array([0.0, np.nan, np.inf], np.float32), first, second, np.float32(1e-3), np.float32(1.0))
    assert np.isnan(new).tolist() == [False, True, True]


def test_loops_over_many_numbers_take_several_at_a_time() -> None:
    import numba

    from tutelage.learning.compiled import _adam
    from tutelage.policies.compiled import ALONG, join, normalise_row

    number, numbers = numba.float32, numba.float32[::1]
    fresh = {**ALONG, "cache": False}  # what comes from the cache has no code to look at
    for loop, arguments in (
        (_adam, [numbers] * 5 + [number] * 2), (normalise_row, [numbers] * 4), (join, [numbers] * 7),
    ):  # fmt: skip
        compiled = numba.njit(numba.void(*arguments), **fresh)(loop.py_func)
        assert any(re.search(r"fdiv [^<\n]*<\d+ x float>", code) for code in compiled.inspect_llvm().values())
