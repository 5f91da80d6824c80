"""The keys of one topic on disk: a file in the node's home, sealed to the node."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from tutelage.files import Lock, write_atomic
from tutelage.sgc.access import Entry
from tutelage.sgc.envelope import open_sealed, seal_to
from tutelage.sgc.epochs import Epoch, Epochs
from tutelage.sgc.errors import KeysError
from tutelage.sgc.grants import Exchange
from tutelage.sgc.home import Home
from tutelage.sgc.reasons import Refused
from tutelage.sgc.trust import Member

_CONTEXT = b"tutelage topic keys 1"


class _Folder(Lock):
    """The lock of a folder of keys, which is made anew if somebody removed it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path / ".lock")
        self._folder = path

    def __enter__(self) -> None:
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise KeysError(f"cannot make the folder {self._folder}: {error.strerror}; move away what is there") from None
        super().__enter__()


class TopicKeys:
    """What a node holds of one topic.

    Attributes:
        entry: the topic.
        exchange: its requests and grants.
        epochs: its keys.
        owner: as the newest grant showed it; None: no grant yet, or this node is the owner.
        path: the file.
        lock: to be held while it is read, changed and written.
    """

    def __init__(self, home: Home, entry: Entry) -> None:
        self.entry = entry
        self.exchange = Exchange(entry)
        self.epochs = Epochs()
        self.path = home.path / "keys" / f"{entry.rule.alias}.keys"
        self.lock = _Folder(self.path.parent)
        self.owner: Member | None = None
        self._owner = ""
        self._sealing = home.sealing_key
        self._made_under: list[int | str] = []
        self._seen = 0
        self.refresh()

    def current(self, now: float) -> list[Epoch]:
        """What a member needs: the epoch under which to seal, and later ones."""
        sealing = self.epochs.sealing(now)
        return [epoch for epoch in self.epochs.all() if sealing is None or epoch.number >= sealing.number][-4:]

    def learn(self, epochs: list[Epoch], owner: Member) -> bool:
        """Keep what a grant brought; True if it was news."""
        with self.lock:
            self.refresh()
            new = self.epochs.add(epochs)
            self.owner, known, self._owner = owner, self._owner, owner.pseudonym
            if new or known != self._owner:
                self.save()
            return new

    def drop(self, now: float) -> bool:
        """Forget keys that are over; True if there were any."""
        with self.lock:
            self.refresh()
            dropped = self.epochs.drop(now)
            if dropped:
                self.save()
            return dropped

    def owner_revoked(self, denied: frozenset[str]) -> bool:
        """Is the owner that granted the keys one of these pseudonyms?"""
        return self._owner in denied

    def forget(self) -> None:
        """Drop all keys."""
        self.epochs = Epochs()
        self.save()

    def made(self, epoch: Epoch, home: Home) -> None:
        """Keep what this node made as the owner, under the deny list and rule of now."""
        self.epochs.add([epoch])
        self.owner, self._owner, self._made_under = None, home.pseudonym, self._under(home)
        self.save()

    def outdated(self, home: Home) -> bool:
        """Was somebody revoked, or did the rule change who may hold the key, since the owner made it?"""
        return self.epochs.newest is not None and self._made_under != self._under(home)

    def save(self) -> None:
        """Write the file."""
        content = {
            "name": self.entry.name.hex(),
            "epochs": [
                [epoch.number, epoch.key.hex(), epoch.begins, epoch.ends, epoch.grace, epoch.learned]
                for epoch in self.epochs.all()
            ],
            "made_under": self._made_under,
            "owner": self._owner,
        }
        sealed = seal_to(self._sealing.public_key(), _CONTEXT, json.dumps(content).encode())
        with self.lock:
            write_atomic(self.path, sealed, private=True)
            self._seen = self._stamp()

    def refresh(self) -> bool:
        """Read the file if another process wrote it; True if that brought keys. One that cannot be read counts as none: the
        keys are asked for again."""
        stamp = self._stamp()
        if stamp == self._seen:
            return False
        self._seen = stamp
        try:
            content = json.loads(open_sealed(self._sealing, _CONTEXT, self.path.read_bytes()))
            if content["name"] != self.entry.name.hex():  # the topic's metadata changed, so it is another topic
                return False
            epochs = [
                Epoch(int(number), bytes.fromhex(key), *map(float, times)) for number, key, *times in content["epochs"]
            ]
            self._made_under, self._owner = list(content["made_under"]), str(content["owner"])
        except (Refused, OSError, ValueError, TypeError, KeyError):
            return False
        return self.epochs.add(epochs)

    def _under(self, home: Home) -> list[int | str]:
        rule = self.entry.rule
        who = [rule.owner, rule.publish, rule.subscribe, rule.serve, rule.request]
        return [home.trust.deny_list.serial, hashlib.sha256(json.dumps(who).encode()).hexdigest()]

    def _stamp(self) -> int:
        try:
            return os.stat(self.path).st_mtime_ns
        except OSError:
            return 0
