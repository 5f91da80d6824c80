"""A supervision server that is small and fast enough for tests, robots that do nothing by themselves, and who listens."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fakes import PointFleet

from tutelage.console.audit import Audit
from tutelage.console.offers import Terms
from tutelage.console.states import LeaseEnded, LeaseGranted, Notice, Offer, Snapshot, Stepped, Told
from tutelage.console.supervision import EngineConfig, Supervision
from tutelage.remote.jpeg import decode, encode

QUICK = Terms(offer=5.0, declined=5.0, ignored=0.2, fresh=0.5, grace=1.0, idle=20.0)


def config(out: Path, **changes: Any) -> EngineConfig:
    """Points on a line; nobody asks for help but who fell, and the policy stays as it is."""
    settings: dict[str, Any] = {
        "fleet": "sim:floor:points", "robots": 4, "humans": 2, "priority": "C.", "hz": 50.0, "policy": "none",
        "learner": "none", "out": out, "terms": QUICK, "t_reset": 3,
        "run": {"expert": "small:Homing", "hidden": (8,), "members": 2, "offline_pairs": 100, **changes.pop("run", {})},
    }  # fmt: skip
    return EngineConfig(**{**settings, **changes})


def points(num_envs: int) -> PointFleet:
    """They fall off the table at -1 and beyond 1, and are done at 0.9. Ten timesteps at full speed."""
    return PointFleet(num_envs, bound=1.0, goal=0.9)


def filmed(num_envs: int) -> PointFleet:
    """Points with cameras of their own, which send JPEG: grey, brighter the farther to the right the robot is."""
    fleet = points(num_envs)

    def jpeg(robot: int, camera: int) -> tuple[float, bytes]:
        del camera
        grey = round(100 + 50 * float(fleet.obs[robot, 0]))
        return time.time(), encode(np.full((18, 32, 3), grey, dtype=np.uint8))

    def picture(robot: int, camera: int) -> tuple[float, Any]:
        taken, content = jpeg(robot, camera)
        return taken, decode(content)

    fleet.jpeg, fleet.picture = jpeg, picture  # type: ignore[attr-defined]
    return fleet


class Serving:
    """`with Serving(config) as server:` a server that runs, and everything that it told."""

    def __init__(self, config: EngineConfig) -> None:
        self.config = config
        self.events: list[Told] = []
        self._stack = ExitStack()

    def __enter__(self) -> Serving:
        self.audit = Audit(self.config.out)
        self._stack.callback(self.audit.close)
        self.of = Supervision.open(self.config, self.audit)
        self._stack.callback(self.of.close)
        self.of.subscribe(self.events.append)
        if self.config.policy == "none":
            with torch.no_grad():
                for weights in self.of.engine.parts.policy.net.parameters():
                    weights.zero_()  # it does nothing
            self.of.engine.parts.policy.forget()
        self.of.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def wait(self, until: Callable[[], Any], seconds: float = 10.0, why: str = "") -> Any:
        """What `until` gives as soon as it is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := until():
                return found
            time.sleep(0.005)
        raise AssertionError(why or "it did not happen in time")

    def told(self, kind: type[Told], **values: Any) -> list[Any]:
        """The events of a kind whose fields have these values."""
        fits = lambda e: all(getattr(e, name) == value for name, value in values.items())  # noqa: E731
        return [e for e in list(self.events) if isinstance(e, kind) and fits(e)]

    def wait_told(self, kind: type[Told], seconds: float = 10.0, **values: Any) -> Any:
        """The first such event."""
        return self.wait(lambda: self.told(kind, **values), seconds, f"no {kind.__name__} {values}")[0]

    @property
    def now(self) -> Snapshot:
        """The newest snapshot."""
        return self.of.snapshot()

    def steps(self, n: int = 3) -> None:
        """Let some timesteps pass."""
        until = self.now.t + n
        self.wait(lambda: self.now.t >= until, why="the loop stands still")

    def take(self, name: str, robot: int) -> Any:
        """Somebody takes a robot on their own judgement."""
        self.of.join(name)
        self.of.take(name, robot)
        lease = self.of.engine.offers.holds[robot].lease
        self.wait(lambda: self.now.leases.get(robot, {}).get("id") == lease.id and self.now.human[robot] >= 0)
        return lease


__all__ = ["LeaseEnded", "LeaseGranted", "Notice", "Offer", "Serving", "Stepped", "config"]
