"""`python -m benchmarks [name...] [--quick]`: run, print tables, write results/benchmarks/<name>.json and pages' tables."""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path

from benchmarks.pages import RESULTS, renew
from benchmarks.timing import machine

NAMES = (
    "loop", "allocation", "engine", "tasks", "gates", "images", "memory", "robosuite", "sealing", "connectivity", "proxies"
)  # fmt: skip


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=f"which ones, of {', '.join(NAMES)}; default: all")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the JSON files")
    given = parser.parse_args()
    unknown = set(given.names) - set(NAMES)
    if unknown:
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}; known: {', '.join(NAMES)}")
    for name in given.names or NAMES:
        where = machine()
        print(
            f"\n{name}, on {where['cores']} cores of {where['processor']}, load {where['load_average_before']}\n", flush=True
        )
        result = importlib.import_module(f"benchmarks.{name}").run(quick=given.quick)
        given.out.mkdir(parents=True, exist_ok=True)
        path = given.out / f"{name}.json"
        path.write_text(json.dumps({"machine": where, "quick": given.quick, **result}, indent=1) + "\n", encoding="utf-8")
    if given.out.resolve() == RESULTS:
        renew()


if __name__ == "__main__":
    main()
