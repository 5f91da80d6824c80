"""Who is there, by name: what the routing information base of section 8.4 answers.

The base itself is the routers' (`roll`): each node announces its presence under a name, all routers of the mesh know it a
moment later, and it vanishes with the node. A directory follows the names it is asked to. Presence proves nothing, as a
router may invent or hide it; packets prove who sent them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from tutelage.sgc import lanes
from tutelage.sgc.names import Name
from tutelage.sgc.transport.base import Handle, Transport

GRACE = 2.0
"""Seconds for which somebody who vanished still counts as present: time to change the router or the certificate."""


class _Entry:
    """What is known of a name that is followed."""

    def __init__(self) -> None:
        self.present: dict[str, float | None] = {}  # pseudonym -> None, or since when it is gone
        self.listeners: list[Callable[[str], None]] = []
        self.handle: Handle | None = None


class Directory:
    """Names, and the pseudonyms present under them. Safe to use from several threads."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._lock = threading.Lock()
        self._entries: dict[Name, _Entry] = {}

    def publish(self, name: Name, pseudonym: str) -> Handle:
        """Be present under a name until the handle is closed or the connection is lost."""
        return self._transport.announce(lanes.key(name, lanes.HERE, pseudonym))

    def subscribe(self, name: Name, on_arrival: Callable[[str], None] | None = None) -> None:
        """Follow a name from now on.

        on_arrival: called with the pseudonym of each that comes, and again when one comes back; on the network's thread.
        """
        with self._lock:
            entry = self._entries.get(name)
            fresh = entry is None
            if entry is None:
                entry = self._entries[name] = _Entry()
            if on_arrival is not None:
                entry.listeners.append(on_arrival)
            known = [who for who, gone in entry.present.items() if gone is None]
        if fresh:
            entry.handle = self._transport.watch(
                lanes.key(name, lanes.HERE, "*"), lambda key, present: self._changed(entry, key, present)
            )
        elif on_arrival is not None:
            for who in known:
                on_arrival(who)

    def present(self, name: Name) -> frozenset[str]:
        """Pseudonyms that are present under a name that is followed."""
        with self._lock:
            entry = self._entries.get(name)
            if entry is None:
                return frozenset()
            until = time.monotonic() - GRACE
            entry.present = {who: gone for who, gone in entry.present.items() if gone is None or gone > until}
            return frozenset(entry.present)

    def __len__(self) -> int:
        """Names that are followed."""
        return len(self._entries)

    def close(self) -> None:
        """Follow no name any more."""
        with self._lock:
            entries, self._entries = list(self._entries.values()), {}
        for entry in entries:
            if entry.handle is not None:
                entry.handle.close()

    def _changed(self, entry: _Entry, key: str, present: bool) -> None:
        who = key.rpartition("/")[2]
        with self._lock:
            entry.present[who] = None if present else time.monotonic()
            listeners = list(entry.listeners) if present else []
        for listener in listeners:
            listener(who)
