"""The record of `tutelage serve`: verify."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from tutelage.errors import ConfigError, TutelageError


def verify(folder: Positional[Path], noted: str | None = None) -> None:
    """Is the record whole? Names the first row that was altered, removed or cut off, if any, and exits with 2.

    Who acts as the server's user can rewrite the whole record. So note the hash that is printed, elsewhere, now and then:
    a record that does not contain it any more was rewritten.

    Args:
        folder: the server's folder.
        noted: a hash that was printed earlier; left out: a record that was rewritten with its key, or put back, passes.
    """
    from tutelage.console.audit import verify_folder
    from tutelage.console.chain import START

    try:
        hash = bytes.fromhex(noted) if noted is not None else None
    except ValueError:
        hash = b""
    if hash is not None and len(hash) != len(START):  # half a hash is no sign that a record was rewritten
        raise ConfigError("--noted is a hash as this command prints it, 64 digits")
    verdict = verify_folder(folder, hash)
    if not verdict.ok:
        raise TutelageError(f"{folder}: {verdict.why}")
    print(f"{folder}: {verdict.why}; newest hash: {verdict.head}")


VERBS = {"verify": verify}
