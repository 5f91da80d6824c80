"""Keys of topics: one a topic and epoch, made by the topic's owner, sealed to each member (HPKE), signed by the owner.

Members ask the owner (`ask`, `answer`, `accept`); all three are plain bytes that any channel may carry and any file hold.
The owner changes the key from time to time and whenever somebody is revoked; an epoch also ends by itself, so that
revocation holds even if no message about it arrives.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tutelage.sgc.epochs import CLOCK_TOLERANCE, Epoch
from tutelage.sgc.errors import NoKey, NotAllowed
from tutelage.sgc.grants import NONCE_BYTES, Asker
from tutelage.sgc.home import Home
from tutelage.sgc.keyfile import TopicKeys
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.rules import Lane
from tutelage.sgc.trust import Member

_MAX_ASKED = 32
_MAX_ASKERS = 16_384


@dataclass(frozen=True)
class Push:
    """A grant that a member should get.

    Attributes:
        alias: of the topic.
        grant: bytes for `Keyring.accept` of the member.
        node: name of the member.
    """

    alias: str
    grant: bytes
    node: str


class Keyring:
    """The keys of a node's topics. Safe to use from several threads; kept in the home's folder, sealed to the node.

    Attributes:
        home: whose keys.
        refusals: requests and grants that were not accepted, by reason.
        version: counts up when a key came or went.
    """

    def __init__(self, home: Home, *, grace: float = 30.0) -> None:
        """
        Args:
            home: whose keys.
            grace: seconds for which an epoch of own topics is still accepted after the next one began. Other senders ask
                for the key about as often, in case they missed a change.
        """
        self.home = home
        self.refusals = Refusals()
        self.version = 0
        self._grace = grace
        self._lock = threading.RLock()
        self._topics: dict[str, TopicKeys] = {}
        self._asked: dict[str, OrderedDict[bytes, None]] = {}
        self._answered: dict[str, float] = {}
        self._askers: dict[str, OrderedDict[str, Asker]] = {}
        self._reply_to = X25519PrivateKey.generate()

    def owns(self, alias: str) -> bool:
        """Is this node the topic's owner?"""
        entry = self.home.access.topics.get(alias)
        return entry is not None and entry.rule.owner == self.home.name

    def epoch(self, alias: str, now: float | None = None) -> int | None:
        """The epoch under which this node would seal now; None without a valid key (then `ask` the owner)."""
        try:
            return self.sealing(alias, now).number
        except NoKey:
            return None

    def sealing(self, alias: str, now: float | None = None) -> Epoch:
        """The key under which to seal.

        Raises:
            NoKey: none, or its time is over; the message names the owner.
            NotAllowed: this node has no part in the topic.
        """
        now = time.time() if now is None else now
        with self._lock:
            keys = self._keys(alias, now)
            epoch = keys.epochs.sealing(now)
            if epoch is None:
                owner = keys.entry.rule.owner
                if keys.owner_revoked(self.home.trust.deny_list.pseudonyms):
                    raise NoKey(
                        f"{self.home.name} has no key for {alias}: {owner} is revoked; name another owner in the policy"
                    )
                why = "the last one is over" if keys.epochs.newest else "none has arrived yet"
                raise NoKey(
                    f"{self.home.name} has no valid key for {alias} ({why}); is its owner, {owner}, running and connected?"
                )
            return epoch

    def held(self, alias: str) -> int | None:
        """The epoch that is on disk and valid; unlike `epoch`, an owner makes none if there is none."""
        with self._lock:
            keys = self._topics.get(alias) or TopicKeys(self.home, self.home.access.entry(alias))
            epoch = keys.epochs.sealing(time.time())
            return epoch.number if epoch is not None else None

    def opening(self, alias: str, number: int, now: float | None = None) -> Epoch:
        """The key of an epoch, to open a packet.

        Raises:
            Refused: UNKNOWN_EPOCH or OLD_EPOCH.
            NotAllowed: this node has no part in the topic.
        """
        now = time.time() if now is None else now
        with self._lock:
            return self._keys(alias, now).epochs.opening(number, now)

    def ask(self, alias: str, *, by_hand: bool = False) -> bytes:
        """A request for the topic's key, to its owner. Reveals nothing to whoever carries it.

        by_hand: the answer will come by file, perhaps when this program no longer runs: `accept` it by hand too.

        Raises:
            NotAllowed: this node has no part in the topic.
        """
        nonce = secrets.token_bytes(NONCE_BYTES)
        with self._lock:
            keys = self._keys(alias, time.time())
            asked = self._asked.setdefault(alias, OrderedDict())
            asked[nonce] = None
            while len(asked) > _MAX_ASKED:
                asked.popitem(last=False)
        reply_to = self.home.sealing_key if by_hand else self._reply_to
        return keys.exchange.ask(self.home, nonce, reply_to.public_key())

    def answer(self, alias: str, request: bytes) -> bytes:
        """The owner's answer: the present key (and the next, if it is about to begin), for the node that asked.

        Raises:
            Refused: not asked by a member; see the reason. Counted.
            NotAllowed: this node is not the owner.
        """
        self._check_owner(alias)
        with self.refusals.counting():
            keys = self._keys(alias, time.time())
            asker, nonce = keys.exchange.read_ask(bytes(request), self.home.trust)
            with self._lock:
                epochs = keys.current(time.time())
                askers = self._askers.setdefault(alias, OrderedDict())
                askers[asker.member.pseudonym] = asker
                askers.move_to_end(asker.member.pseudonym)
                while len(askers) > _MAX_ASKERS:
                    askers.popitem(last=False)
            return keys.exchange.grant(self.home, asker, epochs, nonce)

    def accept(self, alias: str, grant: bytes, *, by_hand: bool = False) -> int:
        """Take a grant, in answer to `ask` or pushed. Returns the number of the newest epoch.

        by_hand: the grant came by file from a person, and may be the first. Over a network, a first key is only accepted in
            answer to `ask`, as a pushed one might be old and repeated by a router.

        Raises:
            Refused: NOT_FOR_US, NOT_ALLOWED (not from the owner), ROLLBACK, REPLAYED, TAMPERED, ... Counted.
            NotAllowed: this node has no part in the topic.
        """
        now = time.time()
        keys = self._keys(alias, now)
        with self.refusals.counting():
            signing, reply_to = self.home.signing_key.public_key(), self.home.sealing_key if by_hand else self._reply_to
            owner, epochs, nonce = keys.exchange.read_grant(bytes(grant), signing, reply_to, self.home.trust, now)
            with self._lock:
                newest = keys.epochs.newest
                if nonce and not by_hand:
                    if nonce not in self._asked.get(alias, ()):
                        raise Refused(Reason.REPLAYED, f"a grant of {alias} that answers no request of {self.home.name}")
                    del self._asked[alias][nonce]
                elif newest is None and not by_hand:
                    raise Refused(Reason.REPLAYED, f"a first grant of {alias} that nobody asked for")
                number = max(epoch.number for epoch in epochs)
                if newest is not None and number < newest.number:
                    raise Refused(Reason.ROLLBACK, f"a grant of {alias} with epoch {number}, and {newest.number} is known")
                if nonce:
                    self._answered[alias] = now
                if keys.learn(epochs, owner):
                    self.version += 1
                return number

    def rotate(self, alias: str, *, delay: float = 2.0) -> list[Push]:
        """Make a new key, which senders use `delay` seconds from now; grants for all members known and still allowed.

        Raises:
            NotAllowed: this node is not the owner.
        """
        self._check_owner(alias)
        now = time.time()
        with self._lock:
            self._keys(alias, now)
            self._rotate(alias, now, begins=now + delay, grace=self._grace)
        return self._pushes(alias, now)

    def tend(self, now: float | None = None) -> list[Push]:
        """To be called about once a second: rotates the keys of own topics that are due, or whose members were revoked or
        lost their right (these at once, and without grace); drops keys whose time is over. Returns the grants to send."""
        now = time.time() if now is None else now
        changed: list[str] = []
        with self._lock:
            self.home.refresh()
            for alias in [alias for alias in self._topics if alias not in self.home.access.topics]:
                self._topics.pop(alias).path.unlink(missing_ok=True)
                self.version += 1
            for alias in self.home.access.topics:
                keys = self._keys(alias, now)
                if keys.refresh() | keys.drop(now):
                    self.version += 1
                if not self.owns(alias):
                    continue
                newest = keys.epochs.newest
                if keys.outdated(self.home):
                    # Backdated, so that members whose clocks are behind use it at once too.
                    self._rotate(alias, now, begins=now - CLOCK_TOLERANCE, grace=0.0)
                elif newest is None or now >= newest.learned + keys.entry.rule.rotate_every:
                    self._rotate(alias, now, begins=now + 2.0, grace=self._grace)
                else:
                    continue
                changed.append(alias)
        return [push for alias in changed for push in self._pushes(alias, now)]

    def wanted(self, now: float | None = None) -> list[str]:
        """Aliases of topics whose key this node should `ask` for: it has none, the one it has ends soon, it has not asked
        since it started, or it sends there and has not heard from the owner for a while."""
        now = time.time() if now is None else now
        with self._lock:
            return [alias for alias in self.home.access.topics if not self.owns(alias) and self._wants(alias, now)]

    def known(self, alias: str) -> list[Member]:
        """Members of the topic whose credentials passed through here: the owner, and (at the owner) all that asked for the
        key since it started. Their messages need no introduction."""
        with self._lock:
            keys = self._topics.get(alias)
            owner = [keys.owner] if keys is not None and keys.owner is not None else []
            return [*owner, *(asker.member for asker in self._askers.get(alias, OrderedDict()).values())]

    def _wants(self, alias: str, now: float) -> bool:
        keys = self._keys(alias, now)
        rule, epoch = keys.entry.rule, keys.epochs.sealing(now)
        if epoch is None or epoch.ends - now < rule.rotate_every / 2 or alias not in self._answered:
            return True
        sends = any(rule.may_send(self.home.name, lane) for lane in rule.lanes() if lane != Lane.PRESENCE)
        return sends and now - self._answered.get(alias, 0.0) > self._grace

    def _keys(self, alias: str, now: float) -> TopicKeys:
        """What is known of a topic; the owner makes its first key here."""
        entry = self.home.access.entry(alias)
        with self._lock:
            keys = self._topics.get(alias)
            if keys is None or keys.entry is not entry:
                before, keys = keys, TopicKeys(self.home, entry)
                keys.owner = before.owner if before is not None else keys.owner
                self._topics[alias] = keys
                self.version += 1
            if keys.epochs.newest and keys.owner_revoked(self.home.trust.deny_list.pseudonyms):
                keys.forget()  # whoever revoked the owner does not want it to read on
                self.version += 1
            if self.owns(alias) and keys.epochs.sealing(now) is None:
                self._rotate(alias, now, begins=now - CLOCK_TOLERANCE, grace=self._grace)
            return keys

    def _rotate(self, alias: str, now: float, *, begins: float, grace: float) -> None:
        keys = self._topics[alias]
        with keys.lock:
            # Another process of this node may have done so a moment ago.
            if keys.refresh() and keys.epochs.sealing(now) is not None and not keys.outdated(self.home):
                return
            number = max(int(now), keys.epochs.newest.number + 1 if keys.epochs.newest else 1)
            ends = now + 2 * keys.entry.rule.rotate_every
            keys.made(Epoch(number, secrets.token_bytes(32), begins, ends, grace, learned=now), self.home)
        self.version += 1

    def _pushes(self, alias: str, now: float) -> list[Push]:
        allowed = []
        with self._lock:
            keys, askers = self._topics[alias], self._askers.get(alias, OrderedDict())
            epochs = keys.current(now)
            for pseudonym, asker in list(askers.items()):
                try:
                    self.home.trust.check(asker.member, now)
                    keys.exchange.check_member(asker.member)
                    allowed.append(asker)
                except Refused:
                    del askers[pseudonym]  # it must ask again, and show that it may
        # Without the lock, as thousands of members take a second, and messages must go on meanwhile.
        return [Push(alias, keys.exchange.grant(self.home, asker, epochs), asker.member.node) for asker in allowed]

    def _check_owner(self, alias: str) -> None:
        entry = self.home.access.entry(alias)
        if not self.owns(alias):
            raise NotAllowed(f"{self.home.name} does not own {alias}; its owner in the policy is {entry.rule.owner}")
