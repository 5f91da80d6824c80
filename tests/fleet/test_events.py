"""The event log."""

from __future__ import annotations

import numpy as np

from tutelage.fleet.events import Events, Journal
from tutelage.fleet.modes import Event, Mode


def test_a_journal_keeps_the_order_and_is_empty_after_it_was_taken() -> None:
    journal = Journal(t=7)
    journal.add(Event.ASSIGN, np.array([3, 1]), np.array([0, 1]), np.array([Mode.SWITCHING] * 2))
    journal.add(Event.SUCCESS, np.array([], dtype=int), -1, np.array([]))
    journal.add(Event.VIOLATE, np.array([2]), -1, np.array([Mode.VIOLATED]))
    events = journal.take()
    assert [column.tolist() for column in events] == [
        [7, 7, 7], [3, 1, 2], [0, 1, -1], [Event.ASSIGN, Event.ASSIGN, Event.VIOLATE],
        [Mode.SWITCHING, Mode.SWITCHING, Mode.VIOLATED],
    ]  # fmt: skip
    assert len(journal.take().t) == 0


def test_events_are_chosen_by_kind() -> None:
    journal = Journal()
    for event in (Event.VIOLATE, Event.SUCCESS, Event.TIMEOUT, Event.SUCCESS):
        journal.add(event, np.array([int(event)]), -1, np.array([0]))
    assert journal.take().of(Event.SUCCESS, Event.VIOLATE).robot.tolist() == [Event.VIOLATE, Event.SUCCESS, Event.SUCCESS]


def test_no_events_at_all_are_empty_columns_of_integers() -> None:
    events = Events.concatenate([])
    assert all(column.shape == (0,) and column.dtype == np.int64 for column in events)
