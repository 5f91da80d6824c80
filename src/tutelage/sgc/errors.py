"""Errors of connectivity that a user can act on: each names the node and the remedy."""

from __future__ import annotations

from tutelage.errors import TutelageError


class NotAllowed(TutelageError):
    """The policy does not allow this node to do that."""


class NotIssued(TutelageError):
    """A home that has no certificate yet, or one that has expired."""


class NoKey(TutelageError):
    """A topic whose key this node does not hold (yet)."""


class KeysError(TutelageError):
    """A folder, file or request of the fleet's keys that cannot be used."""
