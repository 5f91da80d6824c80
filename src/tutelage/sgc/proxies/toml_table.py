"""Taking a TOML table apart, so that every mistake in it is named."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.ros_qos import QosProfile, parse_qos


class Table:
    """A TOML table that is taken apart; what is left over at the end is unknown."""

    def __init__(self, content: Any, what: str) -> None:
        if not isinstance(content, dict):
            raise ConfigError(f"{what} must be a table, not {content!r}")
        self._left = dict(content)
        alias = content.get("alias")
        self.what = f"{what.split()[-1]} {alias}" if isinstance(alias, str) else what

    def take(self, key: str, kind: type | tuple[type, ...], *default: Any) -> Any:
        """A setting of that kind; without a default it must be there."""
        if key not in self._left:
            if default:
                return default[0]
            raise ConfigError(f"{self.what} needs {key}")
        value = self._left.pop(key)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ConfigError(f"{self.what}: {key} cannot be {value!r}")
        return value

    def tables(self, key: str) -> Iterator[Any]:
        """The tables of a [[key]]."""
        yield from self.take(key, list, [])

    def qos(self, default: str) -> QosProfile:
        """The quality of service."""
        return parse_qos(self._left.pop("qos", default), self.what)

    def number(self, key: str, default: float, low: float, high: float, kind: type | tuple[type, ...] = int) -> Any:
        """A number in a range."""
        value = self.take(key, kind, default)
        if not low <= value <= high:
            raise ConfigError(f"{self.what}: {key} must be from {low:g} to {high:g}, not {value!r}")
        return value

    def finish(self) -> None:
        """Refuse what is left over."""
        if self._left:
            raise ConfigError(f"{self.what}: unknown setting {', '.join(sorted(self._left))}")
