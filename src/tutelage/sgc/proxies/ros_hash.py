"""Type hashes (REP 2016): since Iron, ROS 2 puts a hash of each type's description into the USER_DATA of discovery.

`ros2 topic info -v` shows it and rosbag2 records it; nothing is matched by it. It is given for types that the distribution's
standard packages define; for others it is left out, which ROS 2 reads as "unknown".
"""

from __future__ import annotations

from tutelage.sgc.proxies.ros_types import type_store

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
