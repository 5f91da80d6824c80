"""Who may use the console of `tutelage serve`: add, list, remove, role, password."""

from __future__ import annotations

import contextlib
import getpass
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tutelage.errors import ConfigError

if TYPE_CHECKING:
    from tutelage.console.accounts import Accounts
    from tutelage.console.audit import Audit

RoleName = Literal["viewer", "operator", "admin"]
FOLDER = Path("served")


def add(name: Positional[str], role: RoleName = "operator", out: Path = FOLDER, password_file: Path | None = None) -> None:
    """Make an account. The password is asked for, or is the first line of a file or of the input.

    Args:
        name: a-z, 0-9, '.', '_', '-'.
        role: viewer (looks), operator (helps and stops robots) or admin (manages accounts too).
        out: folder of the server.
        password_file: its first line is the password; left out: it is asked for, or is the first line of the input.
    """
    from tutelage.console.accounts import Role

    with _open(out, may_be_new=True) as (accounts, audit):
        accounts.add(name, Role.of(role), _password(name, password_file))
        audit.write("account", _me(), action="add", account=name, role=role)
    print(f"{name} may log in as {role}")


def show(out: Path = FOLDER) -> None:
    """Everybody, with their role and when they last logged in.

    Args:
        out: folder of the server.
    """
    with _open(out) as (accounts, _):
        for account in accounts.all():
            last = account.last_login and time.strftime("%Y-%m-%d %H:%M", time.localtime(account.last_login))
            print(f"{account.name:<32} {account.role.name.lower():<9} {last or 'never'}")


def remove(name: Positional[str], out: Path = FOLDER) -> None:
    """End an account and its sessions, at once.

    Args:
        name: whose.
        out: folder of the server.
    """
    with _open(out) as (accounts, audit):
        accounts.remove(name)
        audit.write("account", _me(), action="remove", account=name)
    print(f"{name} is removed")


def role(name: Positional[str], role: Positional[RoleName], out: Path = FOLDER) -> None:
    """Give an account another role, at once.

    Args:
        name: whose.
        role: which.
        out: folder of the server.
    """
    from tutelage.console.accounts import Role

    with _open(out) as (accounts, audit):
        accounts.set_role(name, Role.of(role))
        audit.write("account", _me(), action="role", account=name, role=role)
    print(f"{name} is {role}")


def password(name: Positional[str], out: Path = FOLDER, password_file: Path | None = None) -> None:
    """Give an account another password; its sessions end.

    Args:
        name: whose.
        out: folder of the server.
        password_file: its first line is the password; left out: it is asked for, or is the first line of the input.
    """
    with _open(out) as (accounts, audit):
        if name not in {account.name for account in accounts.all()}:
            raise ConfigError(f"no account {name}")
        accounts.set_password(name, _password(name, password_file))
        audit.write("account", _me(), action="password", account=name)
    print(f"{name} has a new password")


VERBS = {"add": add, "list": show, "remove": remove, "role": role, "password": password}


@contextlib.contextmanager
def _open(out: Path, may_be_new: bool = False) -> Iterator[tuple[Accounts, Audit]]:
    from tutelage.console.accounts import Accounts
    from tutelage.console.audit import Audit

    if not may_be_new and not (out / "accounts.sqlite").exists():
        raise ConfigError(f"there are no accounts in {out}; name the server's folder by --out")
    with contextlib.closing(Accounts(out)) as accounts, contextlib.closing(Audit(out)) as audit:
        yield accounts, audit


def _me() -> str:
    """Who types this, as the system knows them."""
    try:
        return f"shell:{getpass.getuser()}"
    except (OSError, KeyError):
        return f"shell:{os.getuid()}"


def _password(name: str, file: Path | None) -> str:
    if file is not None:
        try:
            lines = file.read_text().splitlines()
        except OSError as error:
            raise ConfigError(f"cannot read {file}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"cannot read {file}: not text") from None
        return lines[0] if lines else ""
    if not sys.stdin.isatty():
        return sys.stdin.readline(1024).rstrip("\r\n")
    first = getpass.getpass(f"password of {name}: ")
    if getpass.getpass("again: ") != first:
        raise ConfigError("the two are not the same")
    return first
