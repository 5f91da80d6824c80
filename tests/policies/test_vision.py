"""K convolutional networks side by side are K networks, and a policy that sees images keeps the promises of one that does not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from torch import nn

from tutelage.errors import ConfigError
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.networks import as_tensor, hidden_layers, network, stored_as
from tutelage.policies.vision import HEAD, BatchedCNN

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32)
SHAPE = (64, 64, 3)


def images(n: int, seed: int = 0) -> np.ndarray:
    return default_rng(seed).integers(0, 256, (n, *SHAPE), dtype=np.uint8)


def published(extra: int, outputs: int, last: nn.Module) -> list[nn.Module]:
    """The layers as appendix B.2 prints them: convolutions, then fully connected ones."""
    convolutions: list[nn.Module] = []
    for layer in [(3, 24, 5, 2), (24, 36, 5, 2), (36, 48, 5, 2), (48, 64, 3, 1), (64, 64, 3, 1)]:
        convolutions += [nn.Conv2d(*layer), nn.ELU()]
    connected: list[nn.Module] = []
    for widths in [(64 + extra, 100), (100, 50), (50, 10), (10, outputs)]:
        connected += [nn.Linear(*widths), nn.ELU()]
    return [nn.Sequential(*convolutions, nn.Flatten()), nn.Sequential(*connected[:-1], last)]


def layers(net: list[nn.Module]) -> list[nn.Module]:
    return [layer for part in net for layer in part if isinstance(layer, nn.Conv2d | nn.Linear)]


def parts(batched: BatchedCNN, k: int, of=lambda p: p.detach()) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Weights and biases of member k, in the shapes of torch's own modules."""
    convolutions = [(of(w)[k], of(b)[k]) for w, b in zip(batched.kernels, batched.biases, strict=True)]
    return convolutions + [(of(w)[k].T, of(b)[k, 0]) for w, b in zip(batched.head.weights, batched.head.biases, strict=True)]


def pair(members: int, extra: int, outputs: int, last) -> tuple[BatchedCNN, list[list[nn.Module]]]:
    """A batched network, and separate ones of torch's modules with the same weights."""
    batched = BatchedCNN(
        members, SHAPE, outputs, HEAD, torch.Generator().manual_seed(0), last=type(last)().forward, extra=extra
    )
    separate = [published(extra, outputs, last) for _ in range(members)]
    for k, net in enumerate(separate):
        for layer, (weight, bias) in zip(layers(net), parts(batched, k), strict=True):
            layer.weight.data, layer.bias.data = weight.clone(), bias.clone()
    return batched, separate


@pytest.mark.parametrize(
    ("members", "extra", "outputs", "last"), [(5, 0, 2, nn.Tanh()), (2, 2, 1, nn.Sigmoid())], ids=["policy", "critic"]
)
@pytest.mark.parametrize("own", [True, False], ids=["a batch each", "one batch for all"])
def test_values_and_gradients_are_those_of_appendix_b_2_one_network_after_the_other(
    members, extra, outputs, last, own
) -> None:
    batched, separate = pair(members, extra, outputs, last)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn((members, 4, *SHAPE) if own else (4, *SHAPE), generator=generator)
    more = torch.randn(4, extra, generator=generator) if extra else None
    y = torch.rand(members, 4, outputs, generator=generator)
    out = batched(x, more)
    (out - y).square().mean(dim=(1, 2)).sum().backward()
    for k, (convolutions, connected) in enumerate(separate):
        embedded = convolutions((x[k] if own else x).permute(0, 3, 1, 2).contiguous())
        assert embedded.shape == (4, 64)
        alone = connected(embedded if more is None else torch.cat([embedded, more], dim=1))
        torch.testing.assert_close(out[k], alone, rtol=1e-4, atol=1e-5)
        (alone - y[k]).square().mean().backward()
        found = parts(batched, k, of=lambda p: p.grad)
        for layer, (weight, bias) in zip(layers([convolutions, connected]), found, strict=True):
            torch.testing.assert_close(weight, layer.weight.grad, rtol=1e-3, atol=1e-6)
            torch.testing.assert_close(bias, layer.bias.grad, rtol=1e-3, atol=1e-6)


def test_many_images_without_gradients_give_what_few_give() -> None:
    net = BatchedCNN(2, SHAPE, 2, HEAD, torch.Generator().manual_seed(0))
    x = torch.rand(70, *SHAPE)
    with torch.no_grad():
        torch.testing.assert_close(net(x)[:, 66:], net(x[66:]), rtol=1e-4, atol=1e-6)


def test_initial_weights_have_the_spread_of_torchs_own() -> None:
    net, torchs = BatchedCNN(20, SHAPE, 2, HEAD, torch.Generator().manual_seed(0)), published(0, 2, nn.Tanh())
    for weights, layer in zip([*net.kernels, *net.head.weights], layers(torchs), strict=True):
        bound = 1 / np.sqrt(np.prod(layer.weight.shape[1:]))
        assert float(weights.detach().abs().max()) <= bound
        assert float(weights.detach().std()) == pytest.approx(bound / np.sqrt(3), rel=0.1)


def test_what_is_observed_decides_on_the_network() -> None:
    generator = torch.Generator().manual_seed(0)
    assert isinstance(network(SHAPE, 2, 1, HEAD, generator), BatchedCNN)
    assert not isinstance(network(7, 2, 1, (4,), generator), BatchedCNN)
    assert hidden_layers(SHAPE, None) == (100, 50, 10)
    assert hidden_layers(7, None) == (256, 256)
    assert hidden_layers(SHAPE, (4,)) == (4,)
    assert (stored_as(SHAPE), stored_as((7,))) == (torch.uint8, torch.float32)
    with pytest.raises(ConfigError, match="images of 60 x 64 pixels are too small for a policy: it needs 61 x 61"):
        network((60, 64, 3), 2, 1, HEAD, generator)
    assert network((61, 100, 3), 2, 1, HEAD, generator)(torch.rand(3, 61, 100, 3)).shape == (2, 3, 1)


def test_images_stay_bytes_on_their_way_to_a_network() -> None:
    seen = images(2)
    assert as_tensor(seen).data_ptr() == seen.ctypes.data
    assert as_tensor(seen.astype(np.float64)).dtype == torch.float32


# -- the policy -----------------------------------------------------------------------------------------------------


def make(members: int = 3, seed: int = 0) -> EnsemblePolicy:
    return EnsemblePolicy(SHAPE, LOW, HIGH, members=members, seed=seed)


def test_mean_acts_and_variance_in_units_of_the_range_is_uncertainty() -> None:
    policy, obs = make(), images(6)
    policy.set_normalisation(obs)
    said = policy.net((torch.from_numpy(obs).float() - policy.obs_mean) / policy.obs_std).detach().numpy().astype(np.float64)
    actions = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * said
    np.testing.assert_allclose(policy.act(obs), actions.mean(axis=0), rtol=1e-4, atol=1e-5)
    by_hand = (np.var(actions, axis=0) / np.var(np.stack([LOW, HIGH]), axis=0)).mean(axis=1)
    np.testing.assert_allclose(policy.uncertainty(obs), by_hand, rtol=1e-2, atol=1e-8)
    np.testing.assert_allclose(policy.act(obs[[4]]), policy.act(obs)[[4]], rtol=1e-4, atol=1e-6)


def test_each_channel_is_z_scored() -> None:
    policy, obs = make(), images(50)
    obs[..., 1] //= 4
    obs[..., 2] = 7
    policy.set_normalisation(obs)
    z = policy.normalise(torch.from_numpy(obs))
    torch.testing.assert_close(z[..., :2].mean(dim=(0, 1, 2)), torch.zeros(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(z[..., :2].std(dim=(0, 1, 2)), torch.ones(2), atol=1e-3, rtol=0)
    assert (z[..., 2] == 0).all()


def test_it_learns_where_a_bright_spot_is() -> None:
    """The action follows a spot: what a policy for images is for."""
    policy = make(members=2)
    rng = default_rng(0)
    spots = rng.uniform(0, 1, (64, 2))
    obs = np.zeros((64, *SHAPE), np.uint8)
    for picture, (x, y) in zip(obs, (8 + 40 * spots).astype(int), strict=True):
        picture[x : x + 8, y : y + 8] = 255
    actions = torch.from_numpy(LOW + (HIGH - LOW) * spots).float()
    policy.set_normalisation(obs)
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-3)
    first = last = 0.0
    for step in range(60):
        index = torch.from_numpy(rng.integers(64, size=(2, 16)))
        loss = policy.loss(torch.from_numpy(obs)[index], actions[index]).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        first, last = (float(loss.detach()), last) if step == 0 else (first, float(loss.detach()))
    assert last < 0.2 * first


def test_a_loaded_policy_sees_like_the_saved_one(tmp_path) -> None:
    policy, obs = make(seed=3), images(3)
    policy.set_normalisation(images(9, seed=1))
    policy.save(tmp_path / "policy", {"task": "CableRouting"})
    again, card = EnsemblePolicy.load(tmp_path / "policy")
    assert (card["obs_shape"], card["hidden"]) == ([64, 64, 3], [100, 50, 10])
    np.testing.assert_array_equal(again.act(obs), policy.act(obs))


def test_a_restart_has_new_weights_that_its_seed_decides() -> None:
    policy, obs = make(), images(2)
    before = policy.act(obs)
    policy.restart(7)
    again = policy.act(obs)
    assert not np.array_equal(before, again)
    policy.restart(7)
    np.testing.assert_array_equal(policy.act(obs), again)
