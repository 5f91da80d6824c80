"""Gradient steps of multilayer perceptrons as compiled code: the forward pass, backpropagation and Adam.

A step holds no interpreter lock from its first number to its last, so networks learn side by side in threads, beside
physics. Each network's numbers come from one thread in one order: the same whatever the number of threads.
"""

from __future__ import annotations

import numba
import numpy as np

from tutelage.claims import claim
from tutelage.policies.compiled import ALONG, FAST, ONE, RECTIFIED, SIGMOID, TANH, ZERO, join, layer, normalise_row

BETA_1, BETA_2, EPSILON = np.float32(0.9), np.float32(0.999), np.float32(1e-8)
"""Of Adam, as in PyTorch."""
TWO = np.float32(2)
TINY = np.finfo(np.float32).tiny
"""The smallest number of full precision."""


@numba.njit(nogil=True, cache=True)
def imitate(counter, losses, *arguments):  # type: ignore[no-untyped-def]
    """`_imitate` for network after network that is claimed; what it returns for each into losses (K,)."""
    while True:
        k = claim(counter)
        if k >= len(losses):
            return
        losses[k] = _imitate(k, *arguments)


@numba.njit(nogil=True, cache=True)
def _imitate(  # type: ignore[no-untyped-def]
    k, obs, actions, index, mean, std, middle, half,
    weights, biases, new_weights, new_biases, first, second, rate, correction,
):  # fmt: skip
    """One step of tanh network k towards the human actions in its batch (eq. 5.3); returns its mean squared error before.

    Args:
        k: which of the K networks.
        obs, actions: (n, D) and (n, A) float32: all data.
        index: (K, B): the rows that each network's batch consists of.
        mean, std: (D,), to normalise observations; middle, half: (A,): errors are in units of half the range of actions.
        weights, and all that follows: see `_descend`.
    """
    batch, layers = index.shape[1], len(weights)
    room = _room(batch, weights)
    x = _rows(room, 0, batch, len(mean))
    for i in range(batch):
        normalise_row(obs[index[k, i]], mean, std, x[i])
    said = _forward(k, batch, weights, biases, room, TANH)
    loss = _imitation_error(said, actions, index[k], middle, half, _rows(room, layers + 1, batch, len(middle)))
    _descend(k, batch, weights, biases, new_weights, new_biases, room, first, second, rate, correction)
    return loss


@numba.njit(nogil=True, cache=True, fastmath=FAST)  # not along: few numbers, rounded as in all results so far
def _imitation_error(said, actions, index, middle, half, delta):  # type: ignore[no-untyped-def]
    """The mean squared error of `said` (B, A), and into delta its gradient with respect to the sums before tanh."""
    loss, scale = 0.0, TWO / np.float32(said.size)
    for i in range(said.shape[0]):
        for j in range(said.shape[1]):
            error = said[i, j] - (actions[index[i], j] - middle[j]) / half[j]
            loss += error * error
            delta[i, j] = scale * error * (ONE - said[i, j] * said[i, j])
    return loss / said.size


@numba.njit(nogil=True, cache=True)
def criticise(counter, losses, *arguments):  # type: ignore[no-untyped-def]
    """`_criticise` for network after network that is claimed; what it returns for each into losses (K,)."""
    while True:
        k = claim(counter)
        if k >= len(losses):
            return
        losses[k] = _criticise(k, *arguments)


@numba.njit(nogil=True, cache=True)
def _criticise(  # type: ignore[no-untyped-def]
    k, obs, actions, target, mean, std, middle, half, slow_weights, slow_biases, tau,
    weights, biases, new_weights, new_biases, first, second, rate, correction,
):  # fmt: skip
    """One step of critic k towards `target`, and of its slow copy towards it; returns its mean squared error before.

    Args:
        k: which of the K sigmoid networks.
        obs, actions, target: (B, D), (B, A) and (B,) float32: the batch of all networks.
        mean, std, middle, half: see `_imitate`.
        slow_weights, slow_biases, tau: the target network, which goes tau of the way.
        weights, and all that follows: see `_descend`.
    """
    batch, layers = len(target), len(weights)
    room = _room(batch, weights)
    x = _rows(room, 0, batch, len(mean) + len(middle))
    for i in range(batch):
        join(obs[i], actions[i], mean, std, middle, half, x[i])
    said = _forward(k, batch, weights, biases, room, SIGMOID)
    loss = _critic_error(said, target, _rows(room, layers + 1, batch, 1))
    _descend(k, batch, weights, biases, new_weights, new_biases, room, first, second, rate, correction)
    for number in range(layers):
        _approach(slow_weights[number][k].ravel(), new_weights[number][k].ravel(), tau)
        _approach(slow_biases[number][k].ravel(), new_biases[number][k].ravel(), tau)
    return loss


@numba.njit(**ALONG)
def _critic_error(said, target, delta):  # type: ignore[no-untyped-def]
    """The mean squared error of `said` (B, 1), and into delta its gradient with respect to the sums before the sigmoid."""
    loss, scale = 0.0, TWO / np.float32(said.size)
    for i in range(said.shape[0]):
        error = said[i, 0] - target[i]
        loss += error * error
        delta[i, 0] = scale * error * said[i, 0] * (ONE - said[i, 0])
    return loss / said.size


@numba.njit(**ALONG)
def _approach(slow, fast, tau):  # type: ignore[no-untyped-def]
    """slow goes tau of the way to fast, (n,) each."""
    for i in range(slow.shape[0]):
        slow[i] += tau * (fast[i] - slow[i])


@numba.njit(nogil=True, cache=True)
def _room(batch, weights):  # type: ignore[no-untyped-def]
    """For a step of a network of L layers: L + 2 rows; n is for what goes into layer n, row L for what comes out at the end.

    The gradient with respect to the sums of layer n goes to row n + 2: what that held is not needed any more. The room is
    that of the thread and not of the network, so it stays in the cache of one core.
    """
    width = weights[0].shape[1]
    for number in range(len(weights)):
        width = max(width, weights[number].shape[2])
    return np.empty((len(weights) + 2, batch * width), np.float32)


@numba.njit(nogil=True, cache=True)
def _rows(room, number, batch, width):  # type: ignore[no-untyped-def]
    """A row of the room as (batch, width)."""
    return room[number, : batch * width].reshape((batch, width))


@numba.njit(nogil=True, cache=True)
def _forward(k, batch, weights, biases, room, kind):  # type: ignore[no-untyped-def]
    """What network k says of the inputs in the room: `kind` of its last sums; all others are rectified."""
    last = len(weights) - 1
    for number in range(last + 1):
        a, b = weights[number].shape[1:]
        said = _rows(room, number + 1, batch, b)
        now = kind if number == last else RECTIFIED
        layer(_rows(room, number, batch, a), weights[number][k], biases[number][k, 0], now, said)
    return said


@numba.njit(nogil=True, cache=True)
def _descend(k, batch, weights, biases, new_weights, new_biases, room, first, second, rate, correction):  # type: ignore[no-untyped-def]
    """Network k goes one step of Adam down the gradient that the room's last row begins. Arrays are float32 and contiguous.

    Args:
        weights, biases: a layer's (K, a, b) and (K, 1, b), for each layer.
        new_weights, new_biases: where those after the step go.
        room: what `_forward` left there; changed.
        first, second: (K, P): Adam's moments, each layer's weights and then its biases; changed.
        rate: learning rate / (1 - beta_1^t), correction: 1 / sqrt(1 - beta_2^t), at Adam's step t.
    """
    stop = first.shape[1]
    for number in range(len(weights) - 1, -1, -1):
        a, b = weights[number].shape[1:]
        start, between = stop - (a + 1) * b, stop - b
        inputs, delta = _rows(room, number, batch, a), _rows(room, number + 2, batch, b)
        gradient, total = np.empty((a, b), np.float32), np.empty(b, np.float32)
        np.dot(inputs.T, delta, gradient)
        _sum_rows(delta, total)
        if number:
            before = _rows(room, number + 1, batch, a)
            np.dot(delta, weights[number][k].T, before)
            _mask(before, inputs)
        for old, new, slope, i, j in (
            (weights[number][k].ravel(), new_weights[number][k].ravel(), gradient.ravel(), start, between),
            (biases[number][k].ravel(), new_biases[number][k].ravel(), total, between, stop),
        ):
            _adam(old, new, slope, first[k, i:j], second[k, i:j], rate, correction)
        stop = start


@numba.njit(**ALONG)
def _mask(delta, hidden):  # type: ignore[no-untyped-def]
    """The gradient after a rectifier becomes the one before it, in place: nothing passes where it gave 0. (B, b) each."""
    for i in range(delta.shape[0]):
        for j in range(delta.shape[1]):
            delta[i, j] = delta[i, j] if hidden[i, j] > ZERO else ZERO


@numba.njit(**ALONG)
def _sum_rows(x, total):  # type: ignore[no-untyped-def]
    """(B, b) -> (b,)."""
    total[:] = ZERO
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            total[j] += x[i, j]


@numba.njit(**ALONG)
def _adam(old, new, gradient, first, second, rate, correction):  # type: ignore[no-untyped-def]
    """Adam on n numbers. Moments of a parameter that has no gradient any more become 0 and not denormal, which is slow."""
    for i in range(old.shape[0]):
        g = gradient[i]
        m = first[i] + (ONE - BETA_1) * (g - first[i])
        v = BETA_2 * second[i] + (ONE - BETA_2) * g * g
        first[i] = ZERO if abs(m) < TINY else m
        second[i] = ZERO if v < TINY else v
        new[i] = old[i] - rate * first[i] / (np.sqrt(second[i]) * correction + EPSILON)
