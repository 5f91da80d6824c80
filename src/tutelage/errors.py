"""Errors that a user can act on: each message is one line that says what is wrong and what to do."""

from __future__ import annotations


class TutelageError(Exception):
    """Base of every error that Tutelage raises on purpose. The command line prints it and exits with 2."""


class ConfigError(TutelageError):
    """A setting, or a combination of settings, that cannot work."""


class ContractError(TutelageError):
    """A fleet, policy, priority or supervisor that returned something its contract forbids (shape, type, NaN)."""


class RunFolderError(TutelageError):
    """A run folder that cannot be read or continued: wrong version, damaged, or in use."""


class MissingExtraError(TutelageError):
    """An optional dependency that is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; run: pip install 'tutelage[{extra}]'")
