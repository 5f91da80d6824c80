"""Accounts, roles, sessions, and why a login is refused."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from tutelage.errors import ConfigError, TutelageError


class Role(IntEnum):
    """What an account may do; each role may do all that the ones before it may."""

    VIEWER = 0
    """Look."""
    OPERATOR = 1
    """Help robots, stop them."""
    ADMIN = 2
    """Manage accounts."""

    @classmethod
    def of(cls, name: str) -> Role:
        """The role of that name. Raises ConfigError where there is none."""
        if name.upper() not in cls.__members__:
            raise ConfigError(f"no role {name!r}; choose from {', '.join(role.name.lower() for role in cls)}")
        return cls[name.upper()]


@dataclass(frozen=True)
class Account:
    """One person. created, last_login: seconds since 1970."""

    name: str
    role: Role
    created: float
    last_login: float | None = None


@dataclass(frozen=True)
class Session:
    """Somebody who is logged in. `key` names the session, and is no secret: the token's hash."""

    name: str
    role: Role
    key: bytes
    expires: float


class LoginError(TutelageError):
    """Name or password is wrong; which of them is not said."""

    retry_after = 0.0


class TooManyAttemptsError(LoginError):
    """Too many wrong attempts; `retry_after` seconds until the next one is looked at."""

    def __init__(self, retry_after: float) -> None:
        super().__init__(f"too many attempts; try again in {retry_after:.0f} s")
        self.retry_after = retry_after
