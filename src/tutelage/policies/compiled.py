"""Multilayer perceptrons as compiled code: what ensembles and critics say of many robots at once.

Nothing here holds the interpreter lock, so parts of a fleet are asked side by side, in the threads of physics. A part has
the same robots whatever the number of threads, and its numbers come from one thread in one order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tutelage.claims import claim
from tutelage.cores import one_thread_a_product, share
from tutelage.policies import networks

one_thread_a_product()
Array = NDArray[Any]

LIMIT = np.float32(networks.LIMIT)
ZERO, ONE = np.float32(0), np.float32(1)
RECTIFIED, TANH, SIGMOID = 0, 1, 2
"""What follows the sums of a layer."""
PART = 64
"""Robots that a network is asked about at a time: with fewer, products would be too small to be fast."""
FEW = 16
"""For fewer robots than this, other threads would take longer to wake than to answer."""

FAST = {"contract", "reassoc", "arcp", "nsz"}
"""Sums may change their order, once, when they are compiled. NaN and infinity stay what they are."""
ALONG = {"nogil": True, "cache": True, "fastmath": FAST, "error_model": "numpy"}
"""Of loops over many numbers, which go several at a time: they could not if a division by zero had to raise an error."""


@numba.njit(**ALONG)
def normalise_row(row, mean, std, x):  # type: ignore[no-untyped-def]
    """The clipped z-scores of D numbers, into x (D,)."""
    for j in range(x.shape[0]):
        z = (row[j] - mean[j]) / std[j]
        x[j] = LIMIT if z > LIMIT else -LIMIT if z < -LIMIT else z


@numba.njit(**ALONG)
def layer(x, weight, bias, kind, out):  # type: ignore[no-untyped-def]
    """kind(x weight + bias), into out. x: (B, a), weight: (a, b), bias: (b,), out: (B, b)."""
    np.dot(x, weight, out)
    for i in range(out.shape[0]):
        if kind == RECTIFIED:
            for j in range(out.shape[1]):
                z = out[i, j] + bias[j]
                out[i, j] = ZERO if z < ZERO else z
        elif kind == TANH:
            for j in range(out.shape[1]):
                out[i, j] = np.tanh(out[i, j] + bias[j])
        else:
            for j in range(out.shape[1]):
                out[i, j] = ONE / (ONE + np.exp(-(out[i, j] + bias[j])))


@numba.njit(nogil=True, cache=True)
def _forward(x, k, weights, biases, kind, said):  # type: ignore[no-untyped-def]
    """What network k says of x (B, D), into said (B, outputs): `kind` of its last sums; all others are rectified."""
    last = len(weights) - 1
    for number in range(last):
        out = np.empty((x.shape[0], weights[number].shape[2]), np.float32)
        layer(x, weights[number][k], biases[number][k, 0], RECTIFIED, out)
        x = out
    layer(x, weights[last][k], biases[last][k, 0], kind, said)


@numba.njit(nogil=True, cache=True)
def members(counter, said, *arguments):  # type: ignore[no-untyped-def]
    """`_member` for each network and part of the robots that is claimed."""
    while True:
        k, start, stop = _part(claim(counter), said)
        if k >= len(said):
            return
        _member(k, start, stop, said, *arguments)


@numba.njit(nogil=True, cache=True)
def critics(counter, said, *arguments):  # type: ignore[no-untyped-def]
    """`_critic` for each network and part of the robots that is claimed."""
    while True:
        k, start, stop = _part(claim(counter), said)
        if k >= len(said):
            return
        _critic(k, start, stop, said, *arguments)


@numba.njit(nogil=True, cache=True)
def _part(number, said):  # type: ignore[no-untyped-def]
    """Which network (K or more: none), and which robots: from, to."""
    robots = said.shape[1]
    k, part = divmod(number, -(-robots // PART))
    return k, part * PART, min((part + 1) * PART, robots)


@numba.njit(nogil=True, cache=True)
def _member(k, start, stop, said, obs, mean, std, weights, biases):  # type: ignore[no-untyped-def]
    """What tanh network k says of robots start to stop, into said (K, N, A), in units of half the range of actions.

    obs: (N, D) float32; mean, std: (D,), to normalise them; weights, biases: (K, a, b) and (K, 1, b) for each layer.
    """
    x = np.empty((stop - start, obs.shape[1]), np.float32)
    for i in range(stop - start):
        normalise_row(obs[start + i], mean, std, x[i])
    _forward(x, k, weights, biases, TANH, said[k][start:stop])


@numba.njit(**ALONG)
def mean_and_variance(said, middle, half, action, variance):  # type: ignore[no-untyped-def]
    """Of what the members say (K, N, A): the mean, within a range of actions, into action (N, A), and the variance.

    The latter, averaged over the actions, into variance (N,). middle, half: (A,), of the range.
    """
    members, n, width = said.shape
    for i in range(n):
        total = ZERO
        for j in range(width):
            centre, spread = ZERO, ZERO
            for k in range(members):
                centre += said[k, i, j]
            centre /= np.float32(members)
            for k in range(members):
                spread += (said[k, i, j] - centre) ** 2
            total += spread / np.float32(members)
            action[i, j] = middle[j] + half[j] * centre
        variance[i] = total / np.float32(width)


@numba.njit(nogil=True, cache=True)
def _critic(k, start, stop, said, obs, actions, mean, std, middle, half, weights, biases):  # type: ignore[no-untyped-def]
    """What sigmoid network k says of robots start to stop, into said (K, N, 1).

    obs, actions: (N, D), (N, A) float32; middle, half: (A,), to normalise actions; all else as in `_member`.
    """
    x = np.empty((stop - start, obs.shape[1] + actions.shape[1]), np.float32)
    for i in range(stop - start):
        join(obs[start + i], actions[start + i], mean, std, middle, half, x[i])
    _forward(x, k, weights, biases, SIGMOID, said[k][start:stop])


@numba.njit(**ALONG)
def join(obs, action, mean, std, middle, half, x):  # type: ignore[no-untyped-def]
    """What a critic sees: z-scores of obs (D,), and action (A,) in units of half its range, into x (D + A,)."""
    width = obs.shape[0]
    normalise_row(obs, mean, std, x[:width])
    for j in range(action.shape[0]):
        x[width + j] = (action[j] - middle[j]) / half[j]


def ask_all(kernel: Callable[..., None], said: Array, threads: int, *arguments: Any) -> None:
    """kernel(counter, said, *arguments) for K networks and N robots, part by part, side by side where it pays.

    said: (K, N, outputs), where their answers go.
    """
    networks, robots = said.shape[:2]
    if robots:
        share(kernel, networks * -(-robots // PART), 1 if robots < FEW else threads, said, *arguments).results()
