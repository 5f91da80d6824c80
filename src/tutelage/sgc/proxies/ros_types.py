"""The definitions of ROS 2 types, for proxies that have to look into messages.

Standard messages come with rosbags, for each distribution. Others, and services, come from .msg and .srv files: those of a
ROS 2 installation (AMENT_PREFIX_PATH), and folders laid out like its share: <package>/msg/*.msg, <package>/srv/*.srv.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tutelage.errors import ConfigError, MissingExtraError

DEFAULT_DISTRIBUTION = "jazzy"
EMPTY = "structure_needs_at_least_one_member"
"""The field that ROS 2 gives to a message without fields; it is never shown."""
_MAX_DEPTH = 32

_SERVICES = {
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "example_interfaces/srv/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum",
}
"""Services so common that nobody should need a file for them."""


def type_store(distribution: str) -> Any:
    """The standard types of a distribution, a `rosbags.typesys.store.Typestore`.

    Raises:
        ConfigError: no such distribution.
        MissingExtraError: rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "ros2") from None
    known = {store.name.removeprefix("ROS2_").lower(): store for store in Stores if store.name.startswith("ROS2_")}
    if distribution not in known:
        raise ConfigError(f"there is no ROS 2 distribution {distribution!r}; there are {', '.join(sorted(known))}")
    return get_typestore(known[distribution])


class RosTypes:
    """Types by name; definitions are looked up when a type is first needed.

    Args:
        distribution: of ROS 2; "": the default.
        folders: where .msg and .srv files are, besides AMENT_PREFIX_PATH.

    Raises:
        ConfigError: a folder or distribution that does not exist.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, distribution: str = "", folders: Iterable[Path] = ()) -> None:
        self.store = type_store(distribution or DEFAULT_DISTRIBUTION)
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        self._folders = [*folders, *(Path(prefix) / "share" for prefix in prefixes if prefix)]
        for folder in folders:
            if not folder.is_dir():
                raise ConfigError(f"{folder} is not a folder of ROS 2 definitions")

    def need(self, type_name: str, depth: int = 0) -> str:
        """Make a message type known, with all types of its fields; services have two, <type>_Request and <type>_Response.

        Raises:
            ConfigError: its definition is nowhere, or cannot be read.
        """
        if depth > _MAX_DEPTH:
            raise ConfigError(f"the definition of {type_name} goes round in a circle")
        if type_name not in self.store.fielddefs:
            self._register(type_name)
        for _, (_, detail) in self.store.fielddefs[type_name][1]:
            inner = detail[0] if isinstance(detail[0], tuple) else None
            name = detail if isinstance(detail, str) else inner[1] if inner and isinstance(inner[1], str) else None
            if name is not None:
                self.need(name, depth + 1)
        return type_name

    def need_service(self, type_name: str) -> tuple[str, str]:
        """The message types of a service's requests and responses.

        Raises:
            ConfigError: see `need`.
        """
        return self.need(f"{type_name}_Request"), self.need(f"{type_name}_Response")

    def _register(self, type_name: str) -> None:
        from rosbags.typesys import get_types_from_msg

        package, kind, name = type_name.split("/")
        text = self._definition(package, kind, name)
        if text is None:
            where = ", ".join(map(str, self._folders)) or "nowhere; give a folder of definitions"
            raise ConfigError(f"the type {type_name} is not known; looked in {where}")
        try:
            # rosbags reads messages only, so a part of a service is read as if it were one and renamed.
            alias = f"{package}/msg/{name}"
            parsed = {(type_name if key == alias else key): value for key, value in get_types_from_msg(text, alias).items()}
            self.store.register(parsed)
        except Exception as error:  # the parser of rosbags raises many things
            raise ConfigError(f"cannot read the definition of {type_name}: {error}") from None

    def _definition(self, package: str, kind: str, name: str) -> str | None:
        if kind == "msg":
            return self._file(f"{package}/msg/{name}.msg")
        base, _, part = name.rpartition("_")
        if kind != "srv" or part not in ("Request", "Response"):
            return None
        whole = self._file(f"{package}/srv/{base}.srv") or _SERVICES.get(f"{package}/srv/{base}")
        if whole is None:
            return None
        request, _, response = _split_service(whole)
        return request if part == "Request" else response

    def _file(self, relative: str) -> str | None:
        for folder in self._folders:
            file = folder / relative
            if file.is_file():
                return file.read_text(encoding="utf-8")
        return None


def _split_service(text: str) -> tuple[str, str, str]:
    lines = text.splitlines()
    at = next((i for i, line in enumerate(lines) if line.strip() == "---"), len(lines))
    return "\n".join(lines[:at]) + "\n", "---", "\n".join(lines[at + 1 :]) + "\n"
