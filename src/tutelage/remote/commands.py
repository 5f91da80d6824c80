"""Robots on the network: new, policy, status."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tutelage.errors import ConfigError
from tutelage.remote.folders import claim
from tutelage.remote.telling import Teller

if TYPE_CHECKING:
    from tutelage.remote.driver import Driver

DRIVER_FAILED = 3
"""Exit status of `tutelage robot` when the driver goes on failing: whoever started it may start it again."""

ENDING = 5.0
"""Seconds from Ctrl-C for which a driver that does not return is waited for."""


def robot(
    home: Positional[Path],
    env: str,
    hz: float = 10.0,
    watchdog: float = 0.5,
    slew: float | None = None,
    cameras: bool = True,
    camera_hz: float = 10.0,
    size: tuple[int, int] = (320, 240),
    quality: int = 80,
    seed: int | None = None,
    policy: bool = False,
    health: str | None = None,
) -> None:
    """Put a robot on the fleet: a driver of yours, any Gymnasium environment, or a task of ours. Ctrl-C ends it.

    It holds whenever no fresh command is there, and whatever happens to the network or the server it comes back by itself.
    Exit status: 0 when it was told to end, 2 if something is set up wrong, 3 if the driver goes on failing.

    Args:
        home: the folder of the robot's node (tutelage keys, tutelage fleet new).
        env: module:callable that makes a driver, an environment or a fleet of one; a task such as Navigation; or the id of a
            Gymnasium environment.
        hz: timesteps in a second.
        watchdog: seconds; the robot holds when the observation that the newest command answers is older than that.
        slew: largest change of an action in a second, as a fraction of its range; default: no limit.
        cameras: send pictures of what is watched.
        camera_hz: pictures of a camera in a second, at most.
        size: of pictures that a task of ours draws, width and height.
        quality: of the pictures' JPEG, 1 to 100.
        seed: of the first episode; default: any.
        policy: decide on the robot, with weights that the server hands out; the server overrides.
        health: HOST:PORT at which to serve /healthz and /metrics; default: they are not served.
    """
    from tutelage.remote.driver import DriverFailed, make_driver
    from tutelage.remote.robot import Robot, RobotConfig
    from tutelage.sgc.commands.stopping import until_stopped
    from tutelage.sgc.health import node_health
    from tutelage.sgc.health_server import HealthServer
    from tutelage.sgc.node import Node

    teller = Teller()
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[teller.handler()])
    status = 0
    config = RobotConfig(hz, watchdog, slew, camera_hz, quality, seed)
    if min(size) < 16 or max(size) > 4096:
        raise ConfigError(f"pictures are 16 to 4096 pixels wide and high, not {size[0]} x {size[1]}")
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(until_stopped())
        if hasattr(signal, "SIGHUP"):  # the terminal is gone: hold, then end
            signal.signal(signal.SIGHUP, lambda number, frame: stop.set())
        stack.enter_context(claim(home, "a robot"))
        node = stack.enter_context(Node.open(home))
        try:
            driver = make_driver(env, render=cameras, size=size)
            stack.callback(_quietly, getattr(driver, "close", lambda: None))
            own = None
            if policy:
                from tutelage.remote.weights import PulledPolicy

                own = stack.enter_context(PulledPolicy(node))

            def report(line: str) -> None:
                teller.say(f"{node.name}: {line}")

            running = stack.enter_context(Robot(node, driver, config, report, own))
            if health is not None:
                stack.enter_context(
                    HealthServer(health, lambda: node_health(node), lambda: {**node.counters(), "robot": running.counters})
                )
            seen = ", ".join(running.eyes.names)
            report(f"{env} at {hz:g} Hz{f', cameras {seen}' if seen else ''}; Ctrl-C ends it")
            ended = threading.Event()
            threading.Thread(target=_insist, args=(stop, ended, driver, teller), name="robot-end", daemon=True).start()
            try:
                running.run(stop)
            finally:
                ended.set()
        except DriverFailed as error:
            teller.say(f"tutelage: {error}", error=True)
            status = DRIVER_FAILED
        else:
            report("ended")
    teller.close()
    _leave(status)


def new(
    folder: Positional[Path],
    robots: int = 4,
    connect: str = "tls/127.0.0.1:7447",
    cameras: tuple[str, ...] = ("front",),
    name: str = "fleet",
    hours: float = 24.0,
) -> None:
    """Keys, policy and folders of a whole fleet on this machine, to try things out.

    Args:
        folder: empty, or not there yet.
        robots: how many; they are called robot-1, robot-2, ...
        connect: where the router will be reached.
        cameras: names of each robot's cameras.
        name: of the fleet.
        hours: validity of the certificates.
    """
    from tutelage.remote.setup import new_fleet

    if not 1 <= robots <= 10_000:
        raise ConfigError(f"a fleet has 1 to 10,000 robots, not {robots}")
    if folder.exists() and not (folder.is_dir() and next(folder.iterdir(), None) is None):
        raise ConfigError(f"{folder} is not empty; choose another folder")
    made = new_fleet(folder, robots, connect=connect, cameras=cameras, name=name, hours=hours)
    port = connect.rpartition(":")[2]
    protocol = connect.partition("/")[0]
    print(f"a fleet of {robots} robots in {folder}; start it with:")
    print(f"    tutelage router {made.router} --listen {protocol}/0.0.0.0:{port}")
    print(f"    tutelage robot {made.robots[0]} --env Navigation")
    print(f"    tutelage fleet status {made.server}")


def policy(
    robots: Positional[tuple[str, ...]],
    server: str = "server",
    cameras: tuple[str, ...] = ("front",),
) -> None:
    """Print policy.toml for a fleet whose robots make their own keys.

    Args:
        robots: names of the robots' nodes.
        server: name of the server's node.
        cameras: names of each robot's cameras.
    """
    from tutelage.remote.topics import fleet_policy

    print(fleet_policy(robots, server, cameras), end="")


def status(home: Positional[Path], seconds: float = 3.0) -> None:
    """Who is there, as the server sees it: listens and commands nothing. Not while a server runs with this folder.

    Args:
        home: the folder of the server's node.
        seconds: how long to listen.
    """
    from tutelage.remote.fleet import RemoteFleet

    with contextlib.closing(RemoteFleet.connect(home, wait=max(seconds, 1.0))) as fleet:
        until = time.monotonic() + seconds
        while time.monotonic() < until and not all(row["state"] == "online" for row in fleet.status()):
            time.sleep(0.05)
        for row in fleet.status():
            age = "" if row["age"] is None else f"heard {row['age']:.2f} s ago, episode {row['episode']}, step {row['step']}"
            print(f"{row['name']:<24} {row['state']:<10} {age} {row['says']}".rstrip())
    _leave(0)


def _insist(stop: threading.Event, ended: threading.Event, driver: Driver, teller: Teller) -> None:
    """A driver that does not return keeps nobody from ending the program: it is told to stop from here, and left behind."""
    stop.wait()
    if ended.wait(ENDING):
        return
    halt = threading.Thread(target=_quietly, args=(getattr(driver, "stop", lambda: None),), daemon=True)
    halt.start()
    halt.join(1.0)
    teller.say(
        f"tutelage: the driver has not returned for {ENDING:g} s; it was told to stop, and the program ends", error=True
    )
    teller.close()
    os._exit(DRIVER_FAILED)


def _quietly(close: Callable[[], None]) -> None:
    """What the driver raises now is of no consequence: the program ends in any case."""
    try:
        close()
    except Exception as error:
        logging.warning("the driver failed in the end: %s: %s", type(error).__name__, error)


def _leave(status: int) -> None:
    """End the program now that all is closed.

    Threads that still wait inside of the network's library would be torn out of it by the interpreter's own way to end, and
    abort the program ("FATAL: exception not rethrown"), now and then: whoever started it would take that for a crash.
    """
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


VERBS: dict[str, Callable[..., None]] = {"new": new, "policy": policy, "status": status}
