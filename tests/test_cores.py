"""Threads that share work: every piece is done once, whoever waits takes a hand in, and nothing outlives its process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tutelage.claims import claim
from tutelage.cores import Together, share


@settings(deadline=None, max_examples=60)
@given(threads=st.integers(1, 4), groups=st.lists(st.integers(0, 9), min_size=1, max_size=5), data=st.data())
def test_each_piece_is_done_once_and_results_come_in_order(threads, groups, data) -> None:
    done: list[tuple[int, int]] = []

    def piece(group: int, k: int):
        def work() -> int:
            done.append((group, k))
            return 10 * group + k

        return work

    begun = {group: Together(threads, [piece(group, k) for k in range(size)]) for group, size in enumerate(groups)}
    for group in data.draw(st.permutations(sorted(begun))):
        expected = [10 * group + k for k in range(groups[group])]
        assert begun[group].results() == expected
        assert begun[group].results() == expected  # asked again, nothing is done again
    assert sorted(done) == [(group, k) for group, size in enumerate(groups) for k in range(size)]


def test_who_waits_for_a_helper_does_what_else_there_is_to_do() -> None:
    go_on, who = threading.Event(), []

    def held_up() -> None:
        began.set()
        go_on.wait(20)

    def other() -> None:
        who.append(threading.current_thread())
        go_on.set()

    began = threading.Event()
    first = Together(2, [held_up])
    assert began.wait(20)  # the only helper is busy with it now
    second = Together(2, [other])
    first.results()  # would take 20 s if it did nothing but wait
    assert who == [threading.current_thread()]
    second.results()


def test_with_one_thread_all_is_done_by_the_one_who_waits() -> None:
    who = Together(1, [threading.current_thread] * 3)
    assert who.results() == [threading.current_thread()] * 3


@pytest.mark.parametrize("threads", [1, 3])
def test_what_a_piece_raises_comes_when_all_have_ended(threads) -> None:
    ended = []

    def slow() -> None:
        time.sleep(0.05)
        ended.append(True)

    def bad() -> None:
        raise ValueError("bad")

    both = Together(threads, [bad, slow, slow])
    for _ in range(2):
        with pytest.raises(ValueError, match="bad"):
            both.results()
        assert len(ended) == 2
    assert Together(threads, [lambda: 1]).results() == [1]  # the helpers live on


def test_ctrl_c_reaches_the_thread_that_waits_whoever_the_piece_is_for() -> None:
    go_on, began = threading.Event(), threading.Event()

    def held_up() -> None:
        began.set()
        go_on.wait(20)

    def interrupted() -> None:
        raise KeyboardInterrupt

    first = Together(2, [held_up])
    assert began.wait(20)
    second = Together(2, [interrupted])
    with pytest.raises(KeyboardInterrupt):
        first.results()  # does the other piece meanwhile
    go_on.set()
    first.results()
    with pytest.raises(KeyboardInterrupt):
        second.results()


@numba.njit(nogil=True)
def mark(counter, times, by) -> None:  # type: ignore[no-untyped-def]
    while True:
        item = claim(counter)
        if item >= len(times):
            return
        times[item] += by


@settings(deadline=None, max_examples=40)
@given(items=st.integers(0, 5000), threads=st.integers(1, 4))
def test_every_item_is_claimed_once(items, threads) -> None:
    times = np.zeros(items, dtype=np.int64)
    share(mark, items, threads, times, 2).results()
    assert (times == 2).all()


def run(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)


def test_a_process_ends_when_its_pieces_have_and_takes_no_more_time() -> None:
    ended = run(
        "import time; from tutelage.cores import Together\n"
        "Together(3, [lambda: None] * 9).results()\n"
        "Together(3, [lambda: (time.sleep(0.2), print('done'))])\n"
        "time.sleep(0.05)\n"
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "done\n", "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_has_helpers_of_its_own() -> None:
    ended = run(
        "import os; from tutelage.cores import Together\n"
        "Together(3, [lambda: None] * 9).results()\n"
        "child = os.fork()\n"
        "print(Together(3, [os.getpid] * 5).results() == [os.getpid()] * 5, flush=True)\n"
        "child and os.waitpid(child, 0)\n"
    )
    assert (ended.returncode, ended.stdout) == (0, "True\nTrue\n"), ended.stderr
