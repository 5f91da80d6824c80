"""`python -m benchmarks.connectivity.route HOME ADDRESS...` or `... plain ADDRESS`: a router until standard input ends."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def main() -> None:
    """Ours, or one without encryption and access control to compare with."""
    if sys.argv[1] == "plain":
        from tutelage.sgc.transport.config import Timers, import_zenoh, zenoh_config, zenoh_settings

        settings = zenoh_settings("router", Timers(), None)
        settings["listen"] = {"endpoints": [sys.argv[2]]}
        session = import_zenoh().open(zenoh_config(settings))
        print(json.dumps(str(session.zid())), flush=True)
        sys.stdin.read()
    else:
        from tutelage.sgc.home import Home
        from tutelage.sgc.router import Router, RouterConfig

        with Router(Home.open(Path(sys.argv[1])), RouterConfig.of(sys.argv[2:])):
            print("up", flush=True)
            sys.stdin.read()


if __name__ == "__main__":
    main()
