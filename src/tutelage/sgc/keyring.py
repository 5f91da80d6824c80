"""Keys of topics: one a topic and epoch, made by the topic's owner, sealed to each member (HPKE), signed by the owner.

Members ask the owner (`ask`, `answer`, `accept`); all three are plain bytes that any channel may carry and any file hold.
The owner changes the key from time to time and whenever somebody is revoked; an epoch also ends by itself, so that
revocation holds even if no message about it arrives.
"""

from __future__ import annotations

from dataclasses import dataclass

from tutelage.sgc.home import Home


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
    """The keys of a node's topics. Safe to use from several threads; kept in the home's folder, sealed to the node."""

    def __init__(self, home: Home, *, grace: float = 30.0) -> None:
        """
        Args:
            home: whose keys.
            grace: seconds for which an epoch is still accepted after the next one began.
        """
        raise NotImplementedError

    @property
    def version(self) -> int:
        """Counts up when a key came or went."""
        raise NotImplementedError

    def owns(self, alias: str) -> bool:
        """Is this node the topic's owner?"""
        raise NotImplementedError

    def epoch(self, alias: str, now: float | None = None) -> int | None:
        """The epoch under which this node would seal now; None without a valid key (then `ask` the owner)."""
        raise NotImplementedError

    def ask(self, alias: str) -> bytes:
        """A request for the topic's key, to its owner. Reveals nothing to whoever carries it.

        Raises:
            NotAllowed: this node has no part in the topic.
        """
        raise NotImplementedError

    def answer(self, alias: str, request: bytes) -> bytes:
        """The owner's answer: the present key (and the next, if it is about to begin), for the node that asked.

        Raises:
            Refused: not asked by a member, or too long ago; see the reason.
            NotAllowed: this node is not the owner.
        """
        raise NotImplementedError

    def accept(self, alias: str, grant: bytes) -> int:
        """Take a grant, in answer to `ask` or pushed. Returns the epoch.

        Raises:
            Refused: NOT_FOR_US, NOT_ALLOWED (not from the owner), ROLLBACK, MALFORMED, TAMPERED, ...
        """
        raise NotImplementedError

    def rotate(self, alias: str, *, delay: float = 2.0) -> list[Push]:
        """Make a new key, which senders use `delay` seconds from now; grants for all members known and still allowed.

        Raises:
            NotAllowed: this node is not the owner.
        """
        raise NotImplementedError

    def tend(self, now: float | None = None) -> list[Push]:
        """To be called about once a second: rotates the keys of own topics that are due, or whose members were revoked
        or lost their right (these at once, without delay); drops keys whose time is over. Returns the grants to send."""
        raise NotImplementedError

    def wanted(self, now: float | None = None) -> list[str]:
        """Aliases of topics whose key this node should `ask` for: it has none, or the one it has ends soon."""
        raise NotImplementedError
