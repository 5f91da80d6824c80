"""Augmented images: as many as asked for, reproducible, and no farther from the original than the bounds allow."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from tutelage.errors import ConfigError, ContractError
from tutelage.learning.augmentation import Augmentation

STILL = Augmentation(copies=3, contrast=0, add=0, gamma=0, blur=0, saturation=0, noise=0)


def images(n: int = 2) -> Any:
    return np.random.default_rng(0).integers(0, 256, (n, 16, 12, 3), dtype=np.uint8)


def alone(**what: float) -> Augmentation:
    """One transform, many copies."""
    return dataclasses.replace(STILL, copies=400, **what)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_ten_copies_take_the_place_of_each_image_and_the_seed_decides_them() -> None:
    given = images()
    kept = given.copy()
    copies = Augmentation()(given, rng())
    assert copies.shape == (20, 16, 12, 3)
    assert copies.dtype == np.uint8
    assert np.array_equal(given, kept)
    assert np.array_equal(copies, Augmentation()(given, rng()))
    assert not np.array_equal(copies, Augmentation()(given, rng(1)))
    assert len({copy.tobytes() for copy in copies}) == 20
    far = np.abs(copies.astype(int) - np.repeat(given, 10, axis=0).astype(int)).mean(axis=(1, 2, 3))
    assert (far > 1).all()
    assert (far < 40).all()


def test_without_any_transform_copies_are_exact() -> None:
    assert np.array_equal(STILL(images(), rng()), np.repeat(images(), 3, axis=0))


def flat(*colour: int) -> Any:
    return np.full((1, 8, 8, 3), colour, dtype=np.uint8)


def test_each_transform_stays_within_its_bounds_and_uses_them() -> None:
    contrast = alone(contrast=0.15)(flat(227, 127, 27), rng())[:, 0, 0].astype(float)
    assert contrast[:, 0].min() == pytest.approx(127.5 + 0.85 * 99.5, abs=1)
    assert contrast[:, 0].max() == pytest.approx(127.5 + 1.15 * 99.5, abs=1)
    np.testing.assert_allclose(contrast[:, 0] - 127.5, 127.5 - contrast[:, 2], atol=2)
    added = alone(add=10)(flat(100, 100, 100), rng())[:, 0, 0].astype(int) - 100
    assert (added.min(axis=0) <= -9).all()
    assert (added.max(axis=0) >= 9).all()
    assert np.abs(added).max() <= 10
    assert (np.abs(added[:, 0] - added[:, 1]) > 2).mean() > 0.5, "each channel for itself"
    gamma = alone(gamma=0.1)(flat(64, 64, 64), rng())[:, 0, 0, 0] / 255
    assert gamma.min() == pytest.approx((64 / 255) ** 1.1, abs=0.003)
    assert gamma.max() == pytest.approx((64 / 255) ** 0.9, abs=0.003)
    saturation = alone(saturation=0.05)(flat(200, 100, 50), rng())[:, 0, 0].astype(float)
    np.testing.assert_allclose(saturation @ [0.299, 0.587, 0.114], np.dot([200, 100, 50], [0.299, 0.587, 0.114]), atol=1)
    assert np.ptp(saturation[:, 0]) == pytest.approx(0.1 * (200 - 124.2), abs=1.1)
    noise = alone(noise=255 / 80)(flat(128, 128, 128), rng()).astype(float).std(axis=(1, 2, 3))
    assert noise.min() < 0.5
    assert 2.5 < noise.max() < 4


def test_blur_spreads_a_point_over_its_neighbours_and_keeps_the_light() -> None:
    point = flat(0, 0, 0)
    point[0, 4, 4] = 200
    blurred = alone(blur=0.6)(point, rng()).astype(float)[..., 0]
    np.testing.assert_allclose(blurred.sum(axis=(1, 2)), 200, atol=4)
    weights = np.exp(-0.5 / 0.6**2)
    assert blurred[:, 4, 4].min() == pytest.approx(200 / (1 + 2 * weights) ** 2, abs=3)
    assert blurred[:, 4, 4].max() == 200
    np.testing.assert_allclose(blurred, blurred.transpose(0, 2, 1))
    assert np.array_equal(alone(blur=0.6)(flat(77, 3, 250), rng()), np.repeat(flat(77, 3, 250), 400, axis=0))


def test_what_is_no_batch_of_images_is_refused() -> None:
    for bad in (np.zeros((3, 8, 8, 3)), np.zeros((8, 8, 3), dtype=np.uint8), np.zeros((1, 8, 8, 4), dtype=np.uint8)):
        with pytest.raises(ContractError, match="takes images"):
            Augmentation()(bad, rng())
    for settings in ({"copies": 0}, {"noise": -1.0}, {"gamma": 1.0}, {"add": float("nan")}):
        with pytest.raises(ConfigError):
            Augmentation(**settings)
