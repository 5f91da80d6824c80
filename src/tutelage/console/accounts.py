"""Who may use the console, and as what: accounts, roles and sessions in `accounts.sqlite` (mode 0600).

Session tokens and set-up links are kept as their SHA-256 only: who reads the file cannot log in with it.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tutelage.console.limits import Window, network_of
from tutelage.console.passwords import Passwords
from tutelage.console.roles import Account as Account
from tutelage.console.roles import LoginError as LoginError
from tutelage.console.roles import Role as Role
from tutelage.console.roles import Session as Session
from tutelage.console.roles import TooManyAttemptsError as TooManyAttemptsError
from tutelage.errors import ConfigError, TutelageError

VERSION = 1
SESSION_SECONDS = 12 * 3600
SETUP_SECONDS = 3600
_NAME = re.compile(r"[a-z][a-z0-9._-]{0,31}")
_RESERVED = ("server", "nobody", "policy")
_SCHEMA = """
CREATE TABLE IF NOT EXISTS accounts (
    name TEXT PRIMARY KEY, role TEXT NOT NULL, password TEXT NOT NULL, created REAL NOT NULL, last_login REAL);
CREATE TABLE IF NOT EXISTS sessions (
    token BLOB PRIMARY KEY, name TEXT NOT NULL REFERENCES accounts (name) ON DELETE CASCADE,
    created REAL NOT NULL, expires REAL NOT NULL);
CREATE TABLE IF NOT EXISTS setup (token BLOB PRIMARY KEY, expires REAL NOT NULL);
"""


class Accounts:
    """The accounts of a server. Thread-safe, and safe beside `tutelage accounts` in another process.

    Args:
        folder: made if absent.
        passwords: how they are hashed.
        clock: seconds since 1970.
        ticks: monotonic seconds.
    """

    def __init__(
        self,
        folder: Path,
        passwords: Passwords | None = None,
        clock: Callable[[], float] = time.time,
        ticks: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path, self.passwords, self._clock = folder / "accounts.sqlite", passwords or Passwords(), clock
        self._lock = threading.RLock()
        # Each counts wrong attempts only. A stranger cannot lock somebody out from one address.
        self._windows = (
            (Window(5, 300, ticks), lambda name, place: f"{name}@{place}"),
            (Window(50, 300, ticks), lambda name, place: name),
            (Window(30, 300, ticks), lambda name, place: place),
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.path.touch(mode=0o600)
            self._db = sqlite3.connect(self.path, timeout=10.0, isolation_level=None, check_same_thread=False)
            for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
                self._db.execute(f"PRAGMA {pragma}")
            found = self._db.execute("PRAGMA user_version").fetchone()[0]
            if found not in (0, VERSION):
                raise TutelageError(f"{self.path} has version {found} and this Tutelage reads version {VERSION}")
            self._db.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA user_version = {VERSION}; COMMIT;")
        except (OSError, sqlite3.Error) as error:
            raise TutelageError(f"cannot open the accounts {self.path}: {error}") from None

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    # -- accounts -----------------------------------------------------------------------------------------------

    def all(self) -> list[Account]:
        """Every account, by name."""
        rows = self._query("SELECT name, role, created, last_login FROM accounts ORDER BY name")
        return [Account(name, Role.of(role), *times) for name, role, *times in rows]

    def add(self, name: str, role: Role, password: str) -> Account:
        """A new account.

        Raises:
            ConfigError: a bad name or password, or the name is taken.
        """
        self._check_name(name)
        kept = self.passwords.hash(password, name)
        account = Account(name, role, self._clock())
        try:
            self._query("INSERT INTO accounts VALUES (?, ?, ?, ?, NULL)", name, role.name.lower(), kept, account.created)
        except sqlite3.IntegrityError:
            raise ConfigError(f"there is an account {name} already") from None
        return account

    def remove(self, name: str) -> None:
        """End an account and its sessions. Raises ConfigError: unknown, or the last admin."""
        with self._lock:
            self._keep_an_admin(name)
            self._query("DELETE FROM accounts WHERE name = ?", name)

    def set_role(self, name: str, role: Role) -> None:
        """Another role, from the next request on. Raises ConfigError: unknown, or the last admin."""
        with self._lock:
            if role is not Role.ADMIN:
                self._keep_an_admin(name)
            self._get(name)
            self._query("UPDATE accounts SET role = ? WHERE name = ?", role.name.lower(), name)

    def set_password(self, name: str, password: str, keep: bytes | None = None) -> None:
        """Another password; ends all sessions of the account but the one whose key is `keep`."""
        self._get(name)
        kept = self.passwords.hash(password, name)
        with self._lock:
            self._query("UPDATE accounts SET password = ? WHERE name = ?", kept, name)
            self._query("DELETE FROM sessions WHERE name = ? AND token IS NOT ?", name, keep)

    # -- sessions -----------------------------------------------------------------------------------------------

    def login(self, name: str, password: str, address: str, replaces: str | None = None) -> tuple[str, Session]:
        """A new session: its token, to be given to the person only, and what it stands for.

        replaces: the token of a session that ends with this (a session never outlives the next login).

        Raises:
            LoginError: wrong name or password.
            TooManyAttemptsError: of this name from this address, of this name, or from this address.
        """
        name = name.strip().lower()[:64]
        kept = self.confirm(name, password, address)
        if self.passwords.outdated(kept):
            self._query("UPDATE accounts SET password = ? WHERE name = ?", self.passwords.hash(password, name), name)
        try:
            return self.begin(name, replaces)
        except ConfigError:  # removed while the password was checked
            raise LoginError("wrong name or password") from None

    def confirm(self, name: str, password: str, address: str) -> str:
        """Check a password, with the limits of `login`; returns what is kept of it."""
        place = network_of(address)
        counted: list[tuple[Window, str]] = []
        for window, key in self._windows:
            wait = window.attempt(key(name, place))
            if wait:
                for earlier, its_key in counted:
                    earlier.forgive(its_key)
                raise TooManyAttemptsError(wait)
            counted.append((window, key(name, place)))
        row = self._query("SELECT password FROM accounts WHERE name = ?", name)
        kept = row[0][0] if row else None
        if not self.passwords.check(kept, password):
            raise LoginError("wrong name or password")
        for window, its_key in counted:
            window.forgive(its_key)
        return str(kept)

    def begin(self, name: str, replaces: str | None = None) -> tuple[str, Session]:
        """A session without a password: for whoever just set theirs."""
        now, token = self._clock(), secrets.token_urlsafe(32)
        account = self._get(name)
        with self._lock:
            if replaces:
                self.logout(replaces)
            self._query("DELETE FROM sessions WHERE expires <= ?", now)
            self._query("UPDATE accounts SET last_login = ? WHERE name = ?", now, name)
            self._query("INSERT INTO sessions VALUES (?, ?, ?, ?)", _hash(token), name, now, now + SESSION_SECONDS)
        return token, Session(name, account.role, _hash(token), now + SESSION_SECONDS)

    def session(self, token: str) -> Session | None:
        """Who a token stands for now, or None: unknown, expired, or the account is gone."""
        return self.session_of(_hash(token))

    def session_of(self, key: bytes) -> Session | None:
        """The same by the session's key: whether it still lasts, and with which role."""
        rows = self._query(
            "SELECT name, role, expires FROM sessions JOIN accounts USING (name) WHERE token = ? AND expires > ?",
            key, self._clock(),
        )  # fmt: skip
        return Session(rows[0][0], Role.of(rows[0][1]), key, rows[0][2]) if rows else None

    def logout(self, token: str) -> None:
        """End a session; nothing happens if there is none."""
        self._query("DELETE FROM sessions WHERE token = ?", _hash(token))

    # -- the first account --------------------------------------------------------------------------------------

    def invite(self) -> str | None:
        """The token of a set-up link that makes the first admin: it lasts an hour, ends the ones before, and works once.
        None where there is an account."""
        if self.all():
            return None
        token = secrets.token_urlsafe(32)
        with self._lock:
            self._query("DELETE FROM setup")
            self._query("INSERT INTO setup VALUES (?, ?)", _hash(token), self._clock() + SETUP_SECONDS)
        return token

    def set_up(self, token: str, name: str, password: str) -> Account:
        """Make the first admin by the token of `invite`.

        Raises:
            LoginError: the token is wrong, used or expired, or there is an account.
            ConfigError: a bad name or password; the token goes on working.
        """
        with self._lock:
            known = self._query("SELECT 1 FROM setup WHERE token = ? AND expires > ?", _hash(token), self._clock())
            if not known or self.all():
                raise LoginError("this set-up link is not valid any more; restart the server for a new one")
            account = self.add(name, Role.ADMIN, password)
            self._query("DELETE FROM setup")
        return account

    # -----------------------------------------------------------------------------------------------------------

    def _check_name(self, name: str) -> None:
        if not _NAME.fullmatch(name) or name in _RESERVED:
            raise ConfigError("a name must be 1 to 32 of a-z, 0-9, '.', '_', '-', begin with a letter, and not be reserved")

    def _get(self, name: str) -> Account:
        for account in self.all():
            if account.name == name:
                return account
        raise ConfigError(f"no account {name}")

    def _keep_an_admin(self, name: str) -> None:
        account = self._get(name)
        if account.role is Role.ADMIN and sum(a.role is Role.ADMIN for a in self.all()) == 1:
            raise ConfigError(f"{name} is the only admin; make another one first")

    def _query(self, text: str, *values: object) -> list[tuple[Any, ...]]:
        with self._lock:
            try:
                return self._db.execute(text, values).fetchall()
            except sqlite3.IntegrityError:
                raise
            except sqlite3.Error as error:
                raise TutelageError(f"the accounts {self.path} cannot be used: {error}") from None


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode(errors="replace")).digest()
