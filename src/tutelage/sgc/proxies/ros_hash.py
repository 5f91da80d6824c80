"""Type hashes (REP 2016): since Iron, ROS 2 puts a hash of each type's description into the USER_DATA of discovery.

`ros2 topic info -v` shows it and rosbag2 records it; nothing is matched by it. It is given for types that the distribution's
standard packages define; for others it is left out, which ROS 2 reads as "unknown".
"""

from __future__ import annotations

from typing import Any

from tutelage.errors import ConfigError, MissingExtraError

WITHOUT_HASH = ("dashing", "eloquent", "foxy", "galactic", "humble")


class TypeHashes:
    """Hashes of the types of a distribution.

    Args:
        distribution: such as "jazzy"; "": none are given.

    Raises:
        ConfigError: no such distribution.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, distribution: str) -> None:
        self._store = type_store(distribution) if distribution and distribution not in WITHOUT_HASH else None

    def pairs(self, type_name: str) -> dict[str, str]:
        """What goes into USER_DATA for a type, such as {"typehash": "RIHS01_..."}."""
        if self._store is None or type_name not in self._store.fielddefs:
            return {}
        return {"typehash": self._store.hash_rihs01(type_name)}


def type_store(distribution: str) -> Any:
    """The types of a distribution, a `rosbags.typesys.store.Typestore`.

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
