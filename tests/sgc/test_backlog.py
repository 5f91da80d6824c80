"""What waits to be sent comes out in order, in batches that are neither too large nor too far apart in time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tutelage.sgc.backlog import BATCH_BYTES, BATCH_MESSAGES, QUEUE_BYTES, QUEUE_MESSAGES, Backlog

SPREAD = 1000


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 1000, 100_000, BATCH_BYTES, BATCH_BYTES + 1]), st.integers(0, 900)), max_size=50
    ),
    st.booleans(),
)
def test_batches_keep_order_size_and_age(messages: list[tuple[int, int]], back: bool) -> None:
    backlog, now, sent = Backlog(SPREAD), 0, []
    for size, pause in messages:
        now += pause
        sent.append((bytes(size), now))
        backlog.add(*sent[-1])
    out = []
    while backlog:
        batch = backlog.take()
        if back:
            backlog.put_back(batch)
            assert backlog.take() == batch
        assert len(batch) == 1 or sum(len(payload) for payload, _ in batch) <= BATCH_BYTES
        assert batch[-1][1] - batch[0][1] <= SPREAD
        out += batch
    assert out == sent


def test_many_small_messages_are_several_batches() -> None:
    backlog = Backlog(SPREAD)
    for _ in range(BATCH_MESSAGES + 1):
        backlog.add(b"", 0)
    assert [len(backlog.take()), len(backlog.take())] == [BATCH_MESSAGES, 1]


def test_it_is_full_by_messages_or_by_bytes_and_never_refuses_the_first() -> None:
    backlog = Backlog(SPREAD)
    assert backlog.room(QUEUE_BYTES + 1)
    backlog.add(bytes(1000), 0)
    assert backlog.room(QUEUE_BYTES - 1000)
    assert not backlog.room(QUEUE_BYTES - 999)
    for _ in range(QUEUE_MESSAGES - 1):
        backlog.add(b"", 0)
    assert not backlog.room(0)
    assert backlog.drop() == QUEUE_MESSAGES
    assert backlog.room(QUEUE_BYTES + 1)
