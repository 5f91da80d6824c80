"""More images from few: copies that differ in light, colour and sharpness, but show the same (appendices A.4, C.3, D.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError

Images = NDArray[np.uint8]
Floats = NDArray[np.float32]

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""How much of each colour makes grey (ITU-R BT.601)."""
_GREY = np.float32(127.5)
"""Half of the brightness."""


@dataclass(frozen=True)
class Augmentation:
    """What varies, uniformly within these bounds and independently for each copy. The defaults are those of block pushing.

    Attributes:
        copies: of each image; they take its place.
        contrast: distance from mid-grey is scaled by 1 +- this.
        add: up to this much is added to or taken from each channel, in steps of brightness from 0 to 255.
        gamma: brightness, from 0 to 1, is raised to the power 1 +- this.
        blur: largest standard deviation of a Gaussian blur, pixels.
        saturation: distance from grey of the same brightness is scaled by 1 +- this.
        noise: largest standard deviation of Gaussian noise on each pixel and channel, in steps of brightness.
    """

    copies: int = 10
    contrast: float = 0.15
    add: float = 10.0
    gamma: float = 0.1
    blur: float = 0.3
    saturation: float = 0.05
    noise: float = 255 / 80

    def __post_init__(self) -> None:
        if self.copies < 1:
            raise ConfigError(f"an image needs at least one copy, got {self.copies}")
        for name in ("contrast", "add", "gamma", "blur", "saturation", "noise"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"augmentation {name} must be a number >= 0, got {getattr(self, name)}")
        if self.gamma >= 1:
            raise ConfigError(f"augmentation gamma must be below 1, got {self.gamma}")

    def __call__(self, images: Images, rng: np.random.Generator) -> Images:
        """Copies (n * copies, H, W, 3) of images (n, H, W, 3): first those of the first image, and so on.

        Raises:
            ContractError: something that is no batch of RGB images of bytes.
        """
        if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
            raise ContractError(f"augmentation takes images (n, H, W, 3) of uint8, got {images.shape} {images.dtype}")
        n = len(images) * self.copies

        def draw(low: float, high: float, width: int = 1) -> Floats:
            return rng.uniform(low, high, (n, 1, 1, width)).astype(np.float32)

        x: Floats = np.repeat(images, self.copies, axis=0).astype(np.float32)
        x = _GREY + draw(1 - self.contrast, 1 + self.contrast) * (x - _GREY)
        x += draw(-self.add, self.add, 3)
        x = np.float32(255) * (np.clip(x, 0, 255) / np.float32(255)) ** draw(1 - self.gamma, 1 + self.gamma)
        x = _blur(x, draw(0, self.blur))
        grey = (x @ _LUMA)[..., None]
        x = grey + draw(1 - self.saturation, 1 + self.saturation) * (x - grey)
        x += draw(0, self.noise) * rng.standard_normal(x.shape, dtype=np.float32)
        return np.rint(np.clip(x, 0, 255)).astype(np.uint8)


def _blur(x: Floats, sigma: Floats) -> Floats:
    """Images (n, H, W, 3) under Gaussian blurs of standard deviation sigma (n, 1, 1, 1), pixels; edges are continued.

    Three taps along each axis: enough up to a sigma of about 0.6, where the fifth would weigh 0.3 %.
    """
    side = np.exp(-0.5 / np.maximum(sigma, 1e-3) ** 2)
    middle, side = 1 / (1 + 2 * side), side / (1 + 2 * side)
    for axis in (1, 2):
        padded = np.concatenate([np.take(x, [0], axis), x, np.take(x, [-1], axis)], axis)
        length = x.shape[axis]
        before, after = (np.take(padded, range(k, k + length), axis) for k in (0, 2))
        x = middle * x + side * (before + after)
    return x
