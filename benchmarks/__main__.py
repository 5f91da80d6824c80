"""`python -m benchmarks [name...] [--quick]`: run benchmarks, print tables, write results/benchmarks/<name>.json."""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path

from benchmarks.timing import machine
from tutelage.experiments.tables import insert

NAMES = (
    "loop", "allocation", "engine", "tasks", "gates", "images", "memory", "robosuite", "sealing", "connectivity", "proxies"
)  # fmt: skip


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=f"which ones, of {', '.join(NAMES)}; default: all")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--page", action="store_true", help="measure nothing: renew docs/benchmarks.md from the JSON files")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the JSON files")
    given = parser.parse_args()
    unknown = set(given.names) - set(NAMES)
    if unknown:
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}; known: {', '.join(NAMES)}")
    if given.page:
        renew(given.out)
        return
    for name in given.names or NAMES:
        where = machine()
        print(
            f"\n{name}, on {where['cores']} cores of {where['processor']}, load {where['load_average_before']}\n", flush=True
        )
        result = importlib.import_module(f"benchmarks.{name}").run(quick=given.quick)
        given.out.mkdir(parents=True, exist_ok=True)
        path = given.out / f"{name}.json"
        path.write_text(json.dumps({"machine": where, "quick": given.quick, **result}, indent=1) + "\n", encoding="utf-8")
    renew(given.out)


def renew(results: Path, page: Path = Path("docs/benchmarks.md")) -> None:
    """Write the tables of those benchmarks that have markers on the page, from their JSON files."""
    before = text = page.read_text(encoding="utf-8")
    for name in NAMES:
        if f"<!-- begin: {name} -->" in text and (results / f"{name}.json").exists():
            found = json.loads((results / f"{name}.json").read_text(encoding="utf-8"))
            where = found["machine"]
            tables = importlib.import_module(f"benchmarks.{name}").page(found)
            form = "quick form, " if found["quick"] else ""
            text = insert(
                text,
                name,
                f"{tables}\n\nMeasured on {where['cores']} cores of {where['processor']} ({form}load before: "
                f"{where['load_average_before']}).",
            )
    if text != before:
        page.write_text(text, encoding="utf-8")
        print(f"written: {page}")


if __name__ == "__main__":
    main()
