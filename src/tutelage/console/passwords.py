"""Passwords: argon2id, with the same work for a name that does not exist."""

from __future__ import annotations

import threading
import unicodedata

from tutelage.errors import ConfigError, MissingExtraError

try:
    import argon2
except ModuleNotFoundError:
    raise MissingExtraError("argon2-cffi", "console") from None

SHORTEST, LONGEST = 10, 256


class Passwords:
    """Hashes and checks passwords, two at a time at most: each takes 64 MiB, and the robots need the processor too.

    Args:
        time_cost: passes over the memory.
        memory_cost: KiB.
    """

    def __init__(self, time_cost: int = 3, memory_cost: int = 65536) -> None:
        self._hasher = argon2.PasswordHasher(time_cost=time_cost, memory_cost=memory_cost, parallelism=1)
        self._turns = threading.BoundedSemaphore(2)
        self._nobody = self._hasher.hash("a password that nobody has")

    def hash(self, password: str, name: str) -> str:
        """The string to keep.

        Raises:
            ConfigError: too short, too long, or the name itself.
        """
        self.judge(password, name)
        with self._turns:
            return self._hasher.hash(_normal(password))

    @staticmethod
    def judge(password: str, name: str) -> None:
        """Whether somebody may have this password. Raises ConfigError as `hash`."""
        if not SHORTEST <= len(password) <= LONGEST:
            raise ConfigError(f"a password must have {SHORTEST} to {LONGEST} characters")
        if password.casefold() == name.casefold() or len(set(password)) < 4:
            raise ConfigError("that password is too easy to guess")

    def check(self, kept: str | None, password: str) -> bool:
        """Whether it is the password of `kept`; None (no such account) takes as long and is never right."""
        with self._turns:
            try:
                right = self._hasher.verify(kept or self._nobody, _normal(password[:LONGEST]))
            except (argon2.exceptions.VerificationError, argon2.exceptions.InvalidHashError):
                return False
        return right and kept is not None and len(password) <= LONGEST

    def outdated(self, kept: str) -> bool:
        """Whether it was made with other costs than today's."""
        return self._hasher.check_needs_rehash(kept)


def _normal(password: str) -> str:
    """One form for what different keyboards send for the same letters."""
    return unicodedata.normalize("NFKC", password)
