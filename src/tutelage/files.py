"""Files that are whole or not there: every file of Tutelage is written this way."""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
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
            os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        with open(beside, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise TutelageError(f"cannot write {path}: {error.strerror}; free some space or choose another folder") from None


def claimed(file: int) -> bool:
    """Whether an open file (its descriptor) is this process's now, until it is closed: False while it is another's."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class Lock:
    """A lock between processes and threads: whoever holds the file's lock. The thread that holds it may enter again."""

    def __init__(self, path: Path) -> None:
        """path: the lock file, made if absent; its folder must exist when the lock is entered."""
        self._path = path
        self._threads = threading.RLock()
        self._depth = 0
        self._file = -1

    def __enter__(self) -> None:
        self._threads.acquire()
        try:
            if self._depth == 0:
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
                fcntl.flock(self._file, fcntl.LOCK_EX)
            self._depth += 1
        except OSError as error:
            self._threads.release()
            raise TutelageError(f"cannot lock {self._path}: {error.strerror}") from None

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            os.close(self._file)
        self._threads.release()
