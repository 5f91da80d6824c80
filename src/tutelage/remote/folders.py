"""One program for a node's folder: two robots or servers of one name would take each other's sessions away, or disagree."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from tutelage.errors import ConfigError
from tutelage.files import claimed

FILE = ".running"

LEAVING = 1.0
"""Seconds for which one is waited for that was killed and is about to be gone."""


@contextlib.contextmanager
def claim(folder: Path, what: str) -> Iterator[None]:
    """Keep other programs of this machine out of a node's folder. Ends with the program, however that ends.

    Args:
        folder: of the node.
        what: runs, such as "a robot".

    Raises:
        ConfigError: another program has claimed it.
    """
    if not folder.is_dir():  # whoever opens the node says it better
        yield
        return
    try:
        file = os.open(folder / FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:  # a disk that is full, or cannot be written: no reason for a robot not to run
        yield
        return
    try:
        until = time.monotonic() + LEAVING
        while not claimed(file):
            if time.monotonic() < until:
                time.sleep(0.05)
                continue
            by = os.pread(file, 100, 0).decode(errors="replace").strip() or "another program"
            raise ConfigError(f"{folder} is in use by {by}; end that first, or use another folder")
        with contextlib.suppress(OSError):  # the disk is full: the claim holds, and cannot be told from others
            os.ftruncate(file, 0)
            os.pwrite(file, f"{what} (process {os.getpid()})\n".encode(), 0)
        yield
    finally:
        os.close(file)
