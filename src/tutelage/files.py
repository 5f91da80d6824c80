"""Files that are whole or not there: every file of Tutelage is written this way."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from tutelage.errors import TutelageError


def write_atomic(path: Path, content: bytes, *, private: bool = False) -> None:
    """Replace `path` by `content` (write beside, flush, rename), or leave it as it was and raise.

    private: only the owner may read it (mode 0600), from its first byte on.

    Raises:
        TutelageError: the disk is full or the folder cannot be written.
    """
    beside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if private:
            with contextlib.suppress(FileNotFoundError):
                beside.unlink()  # one that a crash left may be readable by others
        mode = 0o600 if private else 0o666
        with open(beside, "wb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise TutelageError(f"cannot write {path}: {error.strerror}; free some space or choose another folder") from None


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock file `path` (made if absent) against other processes and threads that do the same."""
    with open(path, "ab", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
