"""Critics: the probability they estimate, and the transitions they keep."""

from __future__ import annotations

import subprocess
import sys
from collections import deque

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from tutelage.errors import ConfigError
from tutelage.learning.critic import Critic, CriticConfig, Ring
from tutelage.learning.twins import BatchedTwins, CompiledTwins
from tutelage.policies.mlp import BatchedMLP
from tutelage.store import load_tree, save_tree

# -- the ring -------------------------------------------------------------------------------------------------------


def transitions(first: int, n: int) -> dict[str, np.ndarray]:
    """n transitions that can be told apart."""
    index = np.arange(first, first + n, dtype=float)
    return {
        "obs": np.stack([index, -index], axis=1), "action": index[:, None] + 0.5,
        "next_obs": np.stack([index + 1, -index - 1], axis=1), "end": index % 2 == 0,
    }  # fmt: skip


def rows(first: int, n: int) -> np.ndarray:
    """The same, one behind the other in each row."""
    parts = transitions(first, n)
    return np.column_stack([*parts.values()]).astype(np.float32)


def oldest_first(ring: Ring) -> list[float]:
    """What the ring holds, by the first number of obs."""
    index = np.arange(ring.size) if ring.size < ring.capacity else (ring.cursor + np.arange(ring.size)) % ring.capacity
    return ring.rows[torch.from_numpy(index), 0].tolist()


@given(
    capacity=st.one_of(st.integers(1, 30), st.sampled_from([1024, 1500, 5000])),
    parts=st.lists(st.tuples(st.one_of(st.integers(0, 40), st.integers(900, 2500)), st.booleans()), max_size=12),
)
def test_a_ring_is_a_queue_of_limited_length(capacity, parts) -> None:
    ring, model, first = Ring(capacity, 2, 1), deque(maxlen=capacity), 0
    for n, round_trip in parts:
        ring.add(rows(first, n))
        model.extend(range(first, first + n))
        first += n
        if round_trip:
            state, ring = ring.state_dict(), Ring(capacity, 2, 1)
            ring.load_state_dict(state)
        assert ring.size == len(model)
        assert oldest_first(ring) == list(model)
        for name, column in ring.columns(ring.rows[: ring.size]).items():
            expected = transitions(0, first)[name].astype(np.float32)
            np.testing.assert_array_equal(column, expected[ring.rows[: ring.size, 0].long().numpy()])


def test_a_ring_takes_memory_as_it_fills() -> None:
    program = """
import numpy as np, psutil
from tutelage.learning.critic import Ring

def resident():
    return psutil.Process().memory_info().rss / 2**20  # MiB

before = resident()
ring = Ring(100_000, 500, 3)  # 383 MiB when it is full
empty = resident() - before
some = np.ones((10_000, 1004), np.float32)
ready = resident()
ring.add(some)
print(empty, resident() - ready, ring.size)
"""
    # In a process of its own: one that has freed a lot may get memory again that it must fill with zeros first.
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    empty, tenth, size = map(float, done.stdout.split())
    assert empty < 20
    assert 20 < tenth < 80
    assert size == 10_000


def test_draws_are_uniform_over_what_is_kept_and_rows_stay_together() -> None:
    ring = Ring(10, 2, 1)
    ring.add(rows(0, 25))
    drawn = ring.columns(ring.draw(20_000, default_rng(0)))
    index = drawn["obs"][:, 0]
    counts = np.bincount(index.long().numpy(), minlength=25)
    assert (counts[:15] == 0).all()
    assert np.abs(counts[15:] - 2000).max() < 5 * np.sqrt(2000)
    torch.testing.assert_close(drawn["next_obs"][:, 0], index + 1)
    torch.testing.assert_close(drawn["action"][:, 0], index + 0.5)
    torch.testing.assert_close(drawn["end"], (index % 2 == 0).float())


def test_the_state_of_a_ring_stays_as_it_was_while_the_ring_goes_round() -> None:
    ring = Ring(5, 2, 1)
    ring.add(rows(0, 5))
    state = ring.state_dict()
    ring.add(rows(100, 4))
    assert state["rows"][:, 0].tolist() == [0, 1, 2, 3, 4]


def pictures(first: int, n: int, size: tuple[int, int] = (5, 4)) -> dict[str, np.ndarray]:
    """n transitions between images, that can be told apart."""
    obs = default_rng(first).integers(0, 256, (n + 1, *size, 3), dtype=np.uint8)
    action = default_rng(first).uniform(-1, 1, (n, 2)).astype(np.float32)
    return {"obs": obs[:-1], "action": action, "next_obs": obs[1:], "end": np.arange(n) % 2 == 0}


def test_images_are_kept_as_the_bytes_that_they_are_and_numbers_to_the_bit(tmp_path) -> None:
    ring, seen = Ring(8, (5, 4, 3), 2), pictures(0, 11)
    for part in (slice(0, 2), slice(2, 11)):
        ring.add(ring.pack(**{name: column[part] for name, column in seen.items()}))
    assert ring.rows.dtype == torch.uint8
    assert ring.rows.shape == (8, 2 * 60 + 3 * 4)
    save_tree(tmp_path / "ring", ring.state_dict())
    again = Ring(8, (5, 4, 3), 2)
    again.load_state_dict(load_tree(tmp_path / "ring"))
    for kept in (ring, again):
        index = torch.from_numpy((kept.cursor + np.arange(8)) % 8)
        for name, column in kept.columns(kept.rows[index]).items():
            np.testing.assert_array_equal(column, seen[name][3:].astype(column.numpy().dtype))


# -- what a critic estimates ----------------------------------------------------------------------------------------

GAMMA, LENGTH = 0.8, 5
NO_SCALE = torch.zeros(LENGTH), torch.ones(LENGTH), torch.zeros(1), torch.ones(1)
CONFIG = CriticConfig(gamma=GAMMA, tau=0.1, learning_rate=3e-3, batch=64, hidden=(32, 32))


class Rightwards:
    """The robot policy of the chain: always +1. Answers in float64, as a policy may."""

    def act(self, obs):
        return np.ones((len(obs), 1))


def chain_transitions():
    """States 0..4 in a row, one-hot; +1 goes right, -1 goes left (and stays at 0); the event is leaving 4 to the right."""
    state, action = (x.ravel() for x in np.meshgrid(np.arange(LENGTH), [1, -1], indexing="ij"))
    after = np.clip(state + action, 0, LENGTH - 1)
    event = (state == LENGTH - 1) & (action == 1)
    eye = np.eye(LENGTH)
    return eye[state], action[:, None].astype(float), eye[after], event


def chain_values(gamma: float) -> np.ndarray:
    """Q of each transition of the chain by dynamic programming, under the policy that goes right."""
    obs, action, after, event = chain_transitions()
    q = np.zeros(len(obs))
    for _ in range(100):
        value = {int(o.argmax()): q[i] for i, o in enumerate(obs) if action[i] == 1}
        q = np.array([1.0 if e else gamma * value[int(a.argmax())] for a, e in zip(after, event, strict=True)])
    return q


def make(event="bad", config: CriticConfig = CONFIG, seed: int = 0) -> Critic:
    return Critic(LENGTH, 1, event, Rightwards(), config, NO_SCALE, default_rng(seed), seed)


def never(n: int) -> np.ndarray:
    return np.zeros(n, dtype=bool)


@pytest.mark.parametrize("event", ["bad", "good"])
def test_a_critic_learns_the_discounted_probability_on_a_chain(event) -> None:
    critic = make(event)
    obs, action, after, happens = chain_transitions()
    critic.add(obs, action, after, happens, end=happens)
    for _ in range(700):
        critic.update()
    expected = chain_values(GAMMA)
    np.testing.assert_allclose(expected[::2], GAMMA ** np.arange(LENGTH - 1, -1, -1))
    np.testing.assert_allclose(critic(obs, action), expected, atol=0.03)


def test_a_critic_learns_the_probability_of_a_chance_event() -> None:
    """A state that is left one time in four, the share of events in a batch: Q = p / (1 - gamma (1 - p))."""
    critic = make()
    obs, action = np.eye(LENGTH)[np.zeros(40, dtype=int)], np.ones((40, 1))
    event = np.arange(40) % 4 == 0
    critic.add(obs, action, obs, event, end=event)
    for _ in range(500):
        critic.update()
    assert critic(obs[:1], action[:1])[0] == pytest.approx(0.25 / (1 - GAMMA * 0.75), abs=0.08)


def test_a_timeout_is_not_an_end_but_an_end_is() -> None:
    """The same transition towards a doomed state counts as gamma if the episode merely timed out, and as 0 if it ended."""
    for end, expected in ((False, GAMMA), (True, 0.0)):
        critic, eye = make(), np.eye(LENGTH)
        one = np.ones((1, 1))
        critic.add(eye[[1]], one, eye[[1]], np.array([True]), end=np.array([True]))
        critic.add(eye[[0]], one, eye[[1]], never(1), end=np.array([end]))
        for _ in range(400):
            critic.update()
        assert critic(eye[[0]], one)[0] == pytest.approx(expected, abs=0.05)


class SpyCritic(Critic):
    """Keeps what its networks are asked and taught."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self.asked, self.taught, inner = [], [], self.twins
        ask, step = inner.ask, inner.step

        def spied_ask(obs, actions, of_target=False):
            self.asked.append((of_target, obs.copy(), np.array(actions)))
            return ask(obs, actions, of_target)

        def spied_step(obs, actions, y):
            self.taught.append((obs.copy(), actions.copy(), y.copy(), by_hand(self, self.net, obs, actions)))
            return step(obs, actions, y)

        inner.ask, inner.step = spied_ask, spied_step


def by_hand(critic: Critic, net, obs, actions) -> np.ndarray:
    """What both twins say, (2, B), by PyTorch alone; for the scale that every critic here has."""
    x = torch.from_numpy(np.asarray(obs, dtype=np.float32))
    if x.dim() == 4:
        x = (x - 127) / 74
    with torch.no_grad():
        return net(x, torch.from_numpy(np.asarray(actions, dtype=np.float32)))[:, :, 0].numpy()


@pytest.mark.parametrize(("batch", "positives", "expected"), [(256, 0.25, 64), (64, 0.1, 6), (2, 0.25, 1), (8, 0.9, 7)])
def test_a_batch_has_its_share_of_events_however_rare_they_are(batch, positives, expected) -> None:
    config = CriticConfig(batch=batch, positives=positives, hidden=(4,))
    critic = SpyCritic(LENGTH, 1, "bad", Rightwards(), config, NO_SCALE, default_rng(0), 0)
    eye = np.eye(LENGTH)
    critic.add(eye[np.zeros(999, int)], np.ones((999, 1)), eye[np.zeros(999, int)], never(999), end=never(999))
    critic.update()
    assert (critic.taught[-1][0][:, 4] == 0).all()  # no events yet: a batch without
    critic.add(eye[[4]], np.ones((1, 1)), eye[[4]], np.array([True]), end=np.array([True]))
    critic.update()
    obs = critic.taught[-1][0]
    assert len(obs) == batch
    assert int(obs[:, 4].sum()) == expected


@pytest.mark.parametrize(("event", "worst"), [("bad", np.max), ("good", np.min)])
def test_queries_and_targets_take_the_same_twin(event, worst) -> None:
    config = CriticConfig(batch=16, hidden=(8,), gamma=0.9, learning_rate=1e-9)
    critic = SpyCritic(LENGTH, 1, event, Rightwards(), config, NO_SCALE, default_rng(0), 3)
    obs, action, after, _ = chain_transitions()
    critic.add(obs, action, after, never(10), end=never(10))

    said = by_hand(critic, critic.net, obs, action)
    assert (said[0] != said[1]).all()
    np.testing.assert_allclose(critic(obs, action), worst(said, axis=0), rtol=1e-5)
    assert not critic.asked[-1][0]
    target = [parameter.detach().clone() for parameter in critic.target.parameters()]
    loss = critic.update()
    of_target, after, then = critic.asked[-1]
    assert of_target
    assert (then == 1).all()
    _, _, y, now = critic.taught[-1]
    for parameter, before in zip(critic.target.parameters(), target, strict=True):
        parameter.data.copy_(before)
    np.testing.assert_allclose(y, 0.9 * worst(by_hand(critic, critic.target, after, then), axis=0), rtol=1e-5)
    assert loss == pytest.approx(float(np.square(now - y).mean()), rel=1e-5)


def test_the_target_network_follows_slowly() -> None:
    critic = make(config=CriticConfig(tau=0.25, batch=8, hidden=(4,)))
    obs, action, after, happens = chain_transitions()
    critic.add(obs, action, after, happens, end=happens)
    before = [p.detach().clone() for p in critic.target.parameters()]
    critic.update()
    for old, new, net in zip(before, critic.target.parameters(), critic.net.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.25 * (net - old))


@pytest.mark.parametrize("largest", [True, False])
@pytest.mark.parametrize("batch", [1, 40])
def test_compiled_twins_learn_and_answer_as_those_of_pytorch(largest, batch) -> None:
    rng, both = default_rng(0), []
    scale = torch.full((5,), 5.0), torch.full((5,), 2.0), torch.tensor([1.0, 0.0]), torch.tensor([3.0, 1.0])
    for kind in (CompiledTwins, BatchedTwins):
        nets = [BatchedMLP(2, 7, 1, (16, 8), torch.Generator().manual_seed(s), torch.sigmoid) for s in (0, 1)]
        threads = (2,) if kind is CompiledTwins else ()
        both.append((kind(*nets, scale, largest, 1e-2, 0.1, *threads), nets))
    (compiled, nets), (reference, expected) = both
    for _ in range(20):
        obs, actions, y = rng.normal(5, 3, (batch, 5)), rng.normal(size=(batch, 2)), rng.random(batch)
        assert compiled.step(obs, actions, y) == pytest.approx(reference.step(obs, actions, y), rel=1e-4)
        for of_target in (False, True):
            said = compiled.ask(obs, actions, of_target)
            assert said.shape == (batch,)
            np.testing.assert_allclose(said, reference.ask(obs, actions, of_target), rtol=1e-3)
    for net, other in zip(nets, expected, strict=True):
        for mine, theirs in zip(net.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=2e-5)


def test_estimates_are_probabilities_of_shape_n() -> None:
    q = make()(default_rng(0).normal(size=(7, LENGTH)) * 100, np.ones((7, 1)))
    assert q.shape == (7,)
    assert ((q >= 0) & (q <= 1)).all()


def test_without_transitions_there_is_nothing_to_learn() -> None:
    assert np.isnan(make().update())


def test_inputs_are_normalised_with_the_given_scale() -> None:
    scale = torch.full((LENGTH,), 5.0), torch.full((LENGTH,), 2.0), torch.tensor([1.0]), torch.tensor([3.0])
    scaled = Critic(LENGTH, 1, "bad", Rightwards(), CONFIG, scale, default_rng(0), 0)
    obs, action = default_rng(1).normal(size=(6, LENGTH)), default_rng(2).uniform(-1, 1, (6, 1))
    np.testing.assert_allclose(scaled(5 + 2 * obs, 1 + 3 * action), make()(obs, action), rtol=1e-5)


def test_after_a_round_trip_to_disk_a_critic_continues_bit_for_bit(tmp_path) -> None:
    def some(critic: Critic, n: int) -> list[float]:
        losses = []
        for _ in range(n):
            obs, action, after, happens = chain_transitions()
            critic.add(obs, action, after, happens, end=happens)
            losses.append(critic.update())
        return losses

    config = CriticConfig(batch=16, hidden=(8,), capacity=50)
    critic, again = make(config=config), make(config=config, seed=5)
    some(critic, 9)
    save_tree(tmp_path / "critic", critic.state_dict())
    again.load_state_dict(load_tree(tmp_path / "critic"))
    assert some(critic, 9) == some(again, 9)
    obs, action, _, _ = chain_transitions()
    np.testing.assert_array_equal(critic(obs, action), again(obs, action))


@pytest.mark.parametrize(
    "wrong", [{"gamma": 1.0}, {"gamma": -0.1}, {"tau": 0.0}, {"positives": 0.0}, {"positives": 1.0}, {"batch": 1},
              {"every": 0}, {"capacity": 1}],
)  # fmt: skip
def test_impossible_hyper_parameters_are_refused(wrong) -> None:
    with pytest.raises(ConfigError):
        CriticConfig(**wrong)


# -- critics that see images ----------------------------------------------------------------------------------------


class Pointing:
    """A robot policy that goes where the first pixel says."""

    def act(self, obs):
        assert obs.dtype == np.uint8
        return (obs[:, 0, 0, :2] / 127.5 - 1).astype(np.float32)


def seeing(batch: int = 8, seed: int = 0) -> Critic:
    scale = torch.full((3,), 127.0), torch.full((3,), 74.0), torch.zeros(2), torch.ones(2)
    config = CriticConfig(batch=batch, gamma=0.9, learning_rate=1e-9, capacity=40)
    return SpyCritic((64, 64, 3), 2, "good", Pointing(), config, scale, default_rng(seed), seed)


def test_a_critic_of_images_has_the_targets_of_any_other() -> None:
    critic, seen = seeing(), pictures(0, 6, (64, 64))
    critic.add(**{**seen, "event": never(6), "end": never(6)})
    loss = critic.update()
    (_, after, then), (_, _, y, now) = critic.asked[-1], critic.taught[-1]
    np.testing.assert_array_equal(then, Pointing().act(after))
    future = by_hand(critic, critic.target, after, then)  # it goes 0.005 of a way of 1e-9 in a step
    np.testing.assert_allclose(y, 0.9 * future.min(axis=0), rtol=1e-4)
    assert loss == pytest.approx(float(np.square(now - y).mean()), rel=1e-5)
    q = critic(seen["obs"], seen["action"])
    assert q.shape == (6,)
    assert ((q > 0) & (q < 1)).all()
    assert not np.allclose(q, critic(seen["obs"], -seen["action"])), "the action counts"


def test_after_a_round_trip_to_disk_a_critic_of_images_continues_bit_for_bit(tmp_path) -> None:
    critic, again = seeing(), seeing(seed=5)
    for k in range(3):
        critic.add(**pictures(k, 4, (64, 64)), event=np.arange(4) == 3)
        critic.update()
    save_tree(tmp_path / "critic", critic.state_dict())
    again.load_state_dict(load_tree(tmp_path / "critic"))
    assert [critic.update() for _ in range(3)] == [again.update() for _ in range(3)]


def test_a_step_in_which_no_robot_that_sees_moved_is_no_transition() -> None:
    ring, none = Ring(8, (2, 2, 3), 1), np.zeros((0, 2, 2, 3), dtype=np.uint8)
    ring.add(ring.pack(none, np.zeros((0, 1)), none, np.zeros(0, dtype=bool)))
    assert ring.size == 0
