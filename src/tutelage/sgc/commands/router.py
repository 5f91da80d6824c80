"""The verb `tutelage router`."""

from __future__ import annotations

import contextlib
from pathlib import Path

from tyro.conf import Positional


def router(
    home: Positional[Path],
    listen: tuple[str, ...] = ("tls/0.0.0.0:7447", "quic/0.0.0.0:7447"),
    mesh: tuple[str, ...] = (),
    health: str | None = None,
) -> None:
    """Move packets between the nodes that dial in. A router can read none of them and lets pass only what the policy allows.

    Args:
        home: the router's folder (tutelage keys init --router).
        listen: addresses, protocol/host:port with one of tls, quic, ws, wss.
        mesh: addresses of other routers to join; none: it stands alone, unless others name it.
        health: HOST:PORT at which to serve /healthz and /metrics; without it, neither is served.
    """
    from tutelage.sgc.commands.stopping import until_stopped
    from tutelage.sgc.health import router_counters, router_health
    from tutelage.sgc.health_server import HealthServer
    from tutelage.sgc.home import Home
    from tutelage.sgc.router import Router, RouterConfig

    config = RouterConfig.of(listen, mesh)
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(until_stopped())
        running = stack.enter_context(Router(Home.open(home), config))
        if health is not None:
            stack.enter_context(HealthServer(health, lambda: router_health(running), lambda: router_counters(running)))
        joined = f", joined to {' '.join(mesh)}" if mesh else ""
        print(f"{running.home.name} listens on {' '.join(listen)}{joined}; Ctrl-C ends it", flush=True)
        stop.wait()
