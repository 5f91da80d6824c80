"""The topics of a robot on the fleet network, and the policy that lets robots and server use them.

ROBOT.observation       robot -> server, the newest wins
ROBOT.picture.CAMERA    robot -> server, the newest wins
ROBOT.command           server -> robot, the newest wins; session: nobody but the server can have made one
ROBOT.stop              server -> robot, reliable, signed: the emergency stop, on a lane of its own
ROBOT.service           server asks, robot answers: its description, soft and hard resets
fleet.policy            robots ask, server answers: weights of the policy
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence

from tutelage.errors import ConfigError

OBSERVATION, COMMAND, STOP, SERVICE, PICTURE = "observation", "command", "stop", "service", "picture"
WEIGHTS = "fleet.policy"


def alias(robot: str, what: str, camera: str = "") -> str:
    """What the policy calls a topic of a robot."""
    return f"{robot}.{what}.{camera}" if camera else f"{robot}.{what}"


def robots_in(aliases: Collection[str]) -> tuple[str, ...]:
    """The robots among the topics that a server may use, in the order of their names; numbers count as such."""
    found = {name.removesuffix(f".{COMMAND}") for name in aliases if name.endswith(f".{COMMAND}")}
    whole = {robot for robot in found if all(alias(robot, what) in aliases for what in (OBSERVATION, STOP, SERVICE))}
    return tuple(sorted(whole, key=_natural))


def cameras_in(robot: str, aliases: Collection[str]) -> tuple[str, ...]:
    """The cameras of a robot among the topics that a node may use."""
    head = alias(robot, PICTURE) + "."
    return tuple(sorted(name.removeprefix(head) for name in aliases if name.startswith(head)))


def fleet_policy(robots: Sequence[str], server: str = "server", cameras: Sequence[str] = ("front",)) -> str:
    """The text of `policy.toml` for a fleet of robots and a server.

    Args:
        robots: names of the robots' nodes.
        server: name of the server's node.
        cameras: names of each robot's cameras.

    Raises:
        ConfigError: no robot, a name twice, or one that cannot be the name of a topic.
    """
    names = [*robots, server]
    if not robots or len(set(names)) < len(names) or len(set(cameras)) < len(cameras):
        raise ConfigError("a fleet needs at least one robot, and different names for robots, server and cameras")
    for name in names:
        if len(name) > 30:
            raise ConfigError(f"{name!r} is too long for a robot or a server; use at most 30 characters")
    if "fleet" in robots:
        raise ConfigError('a robot cannot be called "fleet", as topics of the whole fleet are')
    tables = [_table(WEIGHTS, server, "/policy", "tutelage/policy", server, kind="service", serve=[server], request=robots)]
    for robot in robots:
        lossy = {"authenticity": "session", "delivery": "lossy"}
        to_server = {"publish": [robot], "subscribe": [server], **lossy}
        tables.append(_table(alias(robot, OBSERVATION), robot, "/observation", "tutelage/observation", robot, **to_server))
        tables += [
            _table(alias(robot, PICTURE, camera), robot, f"/picture/{camera}", "tutelage/picture", robot, **to_server)
            for camera in cameras
        ]
        tables.append(
            _table(
                alias(robot, COMMAND), robot, "/command", "tutelage/command", robot,
                publish=[server], subscribe=[robot], **lossy,
            )
        )  # fmt: skip
        tables.append(
            _table(alias(robot, STOP), robot, "/stop", "tutelage/stop", robot, publish=[server], subscribe=[robot])
        )
        tables.append(
            _table(
                alias(robot, SERVICE), robot, "/service", "tutelage/service", robot,
                kind="service", serve=[robot], request=[server],
            )
        )  # fmt: skip
    return "version = 1\n" + "".join(tables)


def _table(name: str, node: str, interface: str, type: str, owner: str, **more: str | Sequence[str]) -> str:
    fields: dict[str, str | Sequence[str]] = {"node": node, "interface": interface, "type": type, "owner": owner, **more}
    lines = [f"{key} = {json.dumps(value if isinstance(value, str) else list(value))}" for key, value in fields.items()]
    return "\n".join(["", f'[topics."{name}"]', *lines, ""])


def _natural(name: str) -> tuple[tuple[bool, int, str], ...]:
    """arm-2 before arm-10."""
    pieces: list[str] = []
    for character in name:
        if pieces and pieces[-1][-1].isdecimal() == character.isdecimal():
            pieces[-1] += character
        else:
            pieces.append(character)
    return tuple((not p[0].isdecimal(), int(p) if p[0].isdecimal() and p.isascii() else 0, p) for p in pieces)
