"""The aggregated dataset and its bags."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from tutelage.errors import ConfigError
from tutelage.learning.dataset import AggregatedDataset, GrowingArray
from tutelage.store import load_tree, save_tree


def filled(n: int, members: int = 5, seed: int = 0, bootstrap: bool = True, at_once: int = 50) -> AggregatedDataset:
    """n pairs, in several parts; the observation of pair i is (i, i) and its action -i."""
    dataset = AggregatedDataset((2,), 1, members, default_rng(seed), bootstrap)
    for start in range(0, n, at_once):
        index = np.arange(start, min(start + at_once, n), dtype=float)[:, None]
        dataset.add(np.repeat(index, 2, axis=1), -index)
    return dataset


@given(st.lists(st.integers(0, 700), max_size=8))
def test_a_growing_array_is_the_concatenation_of_its_parts(sizes) -> None:
    array, rng = GrowingArray((2, 3), torch.float32), default_rng(0)
    parts = [rng.random((n, 2, 3), dtype=np.float32) for n in sizes]
    for part in parts:
        array.append(part)
    np.testing.assert_array_equal(array.rows.numpy(), np.concatenate([np.zeros((0, 2, 3)), *parts]))


def test_pairs_keep_their_order_and_stay_together() -> None:
    dataset = filled(1000)
    assert len(dataset) == 1000
    np.testing.assert_array_equal(dataset.obs.rows[:, 0].numpy(), np.arange(1000))
    np.testing.assert_array_equal(dataset.actions.rows[:, 0].numpy(), -np.arange(1000))


def test_a_pair_enters_each_bag_poisson_1_times_whenever_it_arrives() -> None:
    n, members = 20_000, 4
    dataset = filled(n, members)
    counts = np.stack([np.bincount(bag.rows.numpy(), minlength=n) for bag in dataset.bags])
    for k, probability in enumerate(np.exp(-1) / np.array([1, 1, 2, 6, 24])):  # P(k) = e^-1 / k!
        assert np.abs((counts == k).mean(axis=1) - probability).max() < 5 * np.sqrt(probability / n)
    for part in np.split(counts, 4, axis=1):  # early and late pairs alike
        assert np.abs(part.mean(axis=1) - 1).max() < 0.05
    assert np.abs(np.corrcoef(counts) - np.eye(members)).max() < 0.04  # bags are independent of each other


@given(n=st.integers(1, 80), seed=st.integers(0, 1000), at_once=st.integers(1, 80))
def test_bags_hold_nothing_but_pairs_that_exist(n, seed, at_once) -> None:
    dataset = filled(n, seed=seed, at_once=at_once)
    for bag in dataset.bags:
        assert ((bag.rows >= 0) & (bag.rows < n)).all()
    obs, actions = dataset.batches(16)
    assert obs.shape == (5, 16, 2)
    assert actions.shape == (5, 16, 1)
    assert obs.dtype == actions.dtype == torch.float32
    torch.testing.assert_close(obs[:, :, :1], -actions)
    assert ((obs >= 0) & (obs < n)).all()


def test_a_member_learns_only_from_its_own_bag_and_without_bootstrap_from_everything() -> None:
    dataset = filled(30)
    obs, _ = dataset.batches(3000)
    for member, bag in zip(obs[:, :, 0], dataset.bags, strict=True):
        assert set(member.tolist()) == set(bag.rows.tolist()) != set(range(30))
    everything, _ = filled(30, bootstrap=False).batches(3000)
    assert all(set(member.tolist()) == set(range(30)) for member in everything[:, :, 0])


def test_batches_are_uniform_over_the_bag() -> None:
    dataset = filled(20, members=1, bootstrap=False)
    counts = np.bincount(dataset.batches(20_000)[0][0, :, 0].long().numpy(), minlength=20)
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)


def test_a_member_whose_bag_is_still_empty_learns_from_all_pairs() -> None:
    dataset = next(d for d in (filled(1, seed=seed) for seed in range(100)) if any(not bag.size for bag in d.bags))
    obs, _ = dataset.batches(4)
    assert (obs == 0).all()


def test_no_data_at_all_is_said_in_one_line() -> None:
    with pytest.raises(ConfigError, match="no human data to learn from yet"):
        filled(0).batches(4)


def test_adding_nothing_changes_nothing() -> None:
    dataset = filled(10)
    dataset.add(np.zeros((0, 2)), np.zeros((0, 1)))
    assert len(dataset) == 10


def test_images_keep_their_shape() -> None:
    dataset = AggregatedDataset((3, 8, 8), 2, 2, default_rng(0))
    dataset.add(np.ones((5, 3, 8, 8)), np.ones((5, 2)))
    assert dataset.batches(4)[0].shape == (2, 4, 3, 8, 8)


def test_images_are_kept_and_drawn_as_the_bytes_that_they_are(tmp_path) -> None:
    seen = default_rng(0).integers(0, 256, (300, 4, 5, 3), dtype=np.uint8)
    dataset = AggregatedDataset((4, 5, 3), 1, 2, default_rng(0), dtype=torch.uint8)
    dataset.add(seen[:200], np.arange(200.0)[:, None])
    save_tree(tmp_path / "data", dataset.state_dict())
    again = AggregatedDataset((4, 5, 3), 1, 2, default_rng(1), dtype=torch.uint8)
    again.load_state_dict(load_tree(tmp_path / "data"))
    for d in (dataset, again):
        d.add(seen[200:], np.arange(200.0, 300.0)[:, None])
        assert d.obs.rows.dtype == torch.uint8
        np.testing.assert_array_equal(d.obs.rows, seen)
        obs, actions = d.batches(50)
        assert obs.dtype == torch.uint8
        np.testing.assert_array_equal(obs, seen[actions[:, :, 0].long().numpy()])


def test_after_a_round_trip_to_disk_bags_and_batches_continue_alike(tmp_path) -> None:
    dataset = filled(300)
    save_tree(tmp_path / "data", dataset.state_dict())
    again = filled(1000, seed=9)
    again.load_state_dict(load_tree(tmp_path / "data"))
    for d in (dataset, again):
        d.add(np.ones((40, 2)), np.zeros((40, 1)))
    for bag, other in zip(dataset.bags, again.bags, strict=True):
        torch.testing.assert_close(bag.rows, other.rows)
    for _ in range(3):
        for a, b in zip(dataset.batches(8), again.batches(8), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_a_state_stays_as_it_was_while_the_dataset_goes_on() -> None:
    dataset = filled(10)
    early, late = dataset.state_dict(), None
    dataset.add(np.ones((10, 2)), np.ones((10, 1)))
    late = dataset.state_dict()
    copy = late["obs"].copy()
    dataset.load_state_dict(early)
    dataset.add(np.full((10, 2), 7.0), np.ones((10, 1)))
    np.testing.assert_array_equal(late["obs"], copy)
    assert len(early["obs"]) == 10
