"""K multilayer perceptrons trained side by side as batched matrix products."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Arrays = tuple[NDArray[Any], ...]


class BatchedMLP(nn.Module):
    """K independent networks of one shape: (K, B, inputs) -> (K, B, outputs), one `baddbmm` a layer.

    Args:
        members: K.
        inputs, outputs: widths.
        hidden: widths of the hidden layers.
        generator: draws the initial weights (uniform, He et al. as in torch.nn.Linear).
        last: applied to the outputs, such as torch.tanh.
        activation: of the hidden layers, in place (the sum before it is not needed for gradients).
    """

    def __init__(
        self,
        members: int,
        inputs: int,
        outputs: int,
        hidden: tuple[int, ...],
        generator: torch.Generator,
        last: Callable[[Tensor], Tensor] | None = None,
        activation: Callable[[Tensor], Tensor] = torch.relu_,
    ) -> None:
        super().__init__()
        self.last, self.activation = last, activation
        widths = [inputs, *hidden, outputs]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for a, b in pairwise(widths):
            bound = 1 / math.sqrt(a)
            for parameters, shape in ((self.weights, (members, a, b)), (self.biases, (members, 1, b))):
                parameters.append(nn.Parameter((torch.rand(shape, generator=generator) * 2 - 1) * bound))
        self._at: list[int] = []
        self._arrays: tuple[Arrays, Arrays] = (), ()
        self._layers = list(zip(self.weights, self.biases, strict=True))  # a ParameterList takes long to say what it holds

    def forward(self, x: Tensor, extra: Tensor | None = None) -> Tensor:
        """(K, B, inputs), or (B, inputs) for the same inputs to all members -> (K, B, outputs).

        extra: the last of the inputs, (B, E), where they come apart.
        """
        if extra is not None:
            x = torch.cat([x, extra.expand(*x.shape[:-1], -1)], dim=-1)
        if x.dim() == 2:
            x = x.expand(len(self._layers[0][0]), *x.shape)
        for k, (weight, bias) in enumerate(self._layers):
            x = torch.baddbmm(bias, x, weight)
            if k < len(self._layers) - 1:
                x = self.activation(x)
        return self.last(x) if self.last else x

    def arrays(self) -> tuple[Arrays, Arrays]:
        """Weights (K, a, b) and biases (K, 1, b) of each layer as arrays, which share their memory with the parameters."""
        at = [parameter.data_ptr() for layer in self._layers for parameter in layer]
        if at != self._at:  # it takes long to ask PyTorch for them
            weights, biases = zip(*((w.detach().numpy(), b.detach().numpy()) for w, b in self._layers), strict=True)
            self._at, self._arrays = at, (weights, biases)
        return self._arrays

    def adopt(self, weights: Arrays, biases: Arrays) -> None:
        """Let these arrays, of the same shapes, be the parameters from now on; those of before are free."""
        for (weight, bias), new_weight, new_bias in zip(self._layers, weights, biases, strict=True):
            weight.data, bias.data = torch.from_numpy(new_weight), torch.from_numpy(new_bias)
