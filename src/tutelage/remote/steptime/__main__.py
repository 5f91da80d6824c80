"""`python -m tutelage.remote.steptime`: measures, and prints JSON."""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.errors import TutelageError
from tutelage.remote.steptime import ours, ssh


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m tutelage.remote.steptime", description=__doc__)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--ssh-steps", type=int, default=20, help="of SSH and SFTP, which take longer; 0: leave them out")
    parser.add_argument("--size", default="480x640", help="of an image, HEIGHTxWIDTH")
    given = parser.parse_args()
    height, width = map(int, given.size.split("x"))
    rows: dict[str, Any] = {}
    try:
        with tempfile.TemporaryDirectory() as folder:
            at = Path(folder)
            rows["ours"] = summary(ours.measure(given.robots, given.steps, height, width, at / "fleet"))
            reason = ssh.why_not() if given.ssh_steps else "left out"
            for name, keep in (("ssh_sftp_open", True), ("ssh_sftp_each", False)):
                if reason:
                    rows[name] = {"why_not": reason}
                    continue
                rows[name] = summary(ssh.measure(given.robots, given.ssh_steps, height, width, at / name, keep_open=keep))
    except TutelageError as error:
        print(f"steptime: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    setting = {"robots": given.robots, "image": [height, width, 3], "bytes": height * width * 3}
    print(json.dumps({**setting, "python": platform.python_version(), "rows": rows}))


def summary(seconds: list[float]) -> dict[str, Any]:
    """Of the times of steps."""
    low, middle, high = np.quantile(seconds, [0.1, 0.5, 0.99])
    return {
        "steps": len(seconds),
        "mean": float(np.mean(seconds)),
        "p10": float(low),
        "p50": float(middle),
        "p99": float(high),
    }


if __name__ == "__main__":
    main()
