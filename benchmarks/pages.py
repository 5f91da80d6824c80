"""`python -m benchmarks.pages [--check]`: put the tables of the pages of speed in place, from results/benchmarks.

A table of docs/connectivity-speed.md or docs/benchmarks.md stands between `<!-- table: NAME -->` and `<!-- end -->`.
--check: exit with 1 if one is not that of the results.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.timing import table

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "connectivity-speed.md": ("connectivity", "sealing", "proxies"),
    "benchmarks.md": ("loop", "loop-xeon", "allocation", "gates", "engine", "memory", "tasks", "console"),
}
"""Pages in docs/, and the benchmarks whose tables they have. loop-xeon is the loop's of another machine, kept beside it."""
RESULTS = ROOT / "results" / "benchmarks"
PLACE = re.compile(r"(?<=<!-- table: )([\w-]+) -->\n.*?(?=<!-- end -->)", re.DOTALL)
FIGURE_8_7 = {
    "VPN": {"64 B": 76.0, "8000 B": 97.0},
    "FogROS2-SGC": {"64 B": 76.0, "8000 B": 88.0},
    "rosduct-rosbridge": {"8000 B": 1670.0},
}
"""Milliseconds, as the text around the figure gives them; small messages stand beside ours of 64 B."""

AUTHENTIC = ("signature", "session", "session, direct", "chain")
"""Stacks whose messages are all authentic when they are delivered."""

Results = dict[str, dict[str, Any]]


def loop(results: Results) -> str:
    """Milliseconds a timestep, and ratios with their targets, on each of the machines."""
    found = [
        (f"{row['task']}, {each['machine']['processor'].split('(')[0]}", row)
        for each in (results[name] for name in ("loop", "loop-xeon") if name in results)
        for row in each["loop"]
    ]
    first = found[0][1]
    times = table(
        ["ms a timestep", *first["milliseconds"]], [[where, *row["milliseconds"].values()] for where, row in found]
    )
    goals = {"original / ours": ">= 3", "ours / floor with PyTorch": "<= 1.15", "overlap / floor with PyTorch": "< 0.9"}
    rows = [[ratio, goals.get(ratio, ""), *(row["ratios"][ratio] for _, row in found)] for ratio in first["ratios"]]
    return f"{times}\n\n{table(['ratio', 'target', *(where for where, _ in found)], rows)}"


def loop_phases(results: Results) -> str:
    """Where the time of the lock-step loop goes."""
    found = results["loop"]["loop"]
    phases = [[phase, *(row["phases"][phase] for row in found)] for phase in found[0]["phases"]]
    return table(["lock-step, ms a timestep", *(row["task"] for row in found)], phases)


def allocation(results: Results) -> str:
    """Of many robots and of few, against a partial sort."""
    return table(
        ["robots x humans: priorities", "ms", "/ np.partition"],
        [[f"{row['robots']:,} x {row['humans']:,}: {row['ranks']}", row["milliseconds"], row["ratio"]]
         for row in results["allocation"]["allocation"]],
    )  # fmt: skip


def gates(results: Results) -> str:
    """What the rules of a gate cost."""
    return table(
        ["gate", "robots", "ms a timestep", "rules", "signals", "rules / timestep"],
        [[*list(row.values())[:-1], f"{row['rules / timestep']:.1%}"] for row in results["gates"]["gates"]],
    )


def engine(results: Results) -> str:
    """Robot steps a second, a table for each number of robots."""
    parts = []
    for robots in dict.fromkeys(row["robots"] for row in results["engine"]["engine"]):
        rows = [row for row in results["engine"]["engine"] if row["robots"] == robots]
        head = list(rows[0]["steps a second"])
        found = [[row["task"], *(_whole(row["steps a second"].get(name)) for name in head)] for row in rows]
        parts.append(table([f"{robots} robot{'s' * (robots > 1)}", *head], found))
    return "\n\n".join(parts)


def _whole(number: float | None) -> str:
    return "" if number is None else f"{number:,.0f}"


def memory(results: Results) -> str:
    """Peak resident memory of a run."""
    rows = [[row["task"], *(_whole(row[key]) for key in list(row)[1:])] for row in results["memory"]["memory"]]
    return table(["MiB", *list(results["memory"]["memory"][0])[1:]], rows)


def machines(results: Results) -> str:
    """What the numbers were measured on."""
    rows = [
        [name, found["machine"]["processor"], found["machine"]["cores"], found["machine"]["load_average_before"],
         "quick" if found["quick"] else "full"]
        for name, found in results.items()
    ]  # fmt: skip
    return table(["benchmark", "processor", "cores", "load before", "form"], rows)


def targets(results: Results) -> str:
    """Each target, what was measured, and whether it is reached."""
    connectivity = results["connectivity"]
    ratios = {row["stack"]: row for row in connectivity["ratios"]}
    directory, start = connectivity["directory"][0], connectivity["start"]
    rows: list[list[Any]] = []
    for size in ("64 B", "8 KB", "256 KB", "14 MB"):
        best = min(AUTHENTIC, key=lambda stack: ratios[stack][f"{size} / zenoh mtls"])
        ratio = ratios[best][f"{size} / zenoh mtls"]
        rows.append([f"round trip of {size} / Zenoh mTLS", "<= 1.3", f"{ratio:.2f} ({best})", ratio <= 1.3])
    for other, least in (("cyclone", 0.97), ("rosbridge", 5.0)):
        for stack in ("signature", "session", "chain"):
            ratio = ratios[stack][f"rate / {other}"]
            rows.append([f"rate of 1000 B, {stack} / {other}", f">= {least}", f"{ratio:.2f}", ratio >= least])
    rows.append(["14 MB arrive", "always", "all, unchanged", True])
    for what, most in (("publish", 4.0), ("subscribe", 2.0)):
        took = directory[f"{what} ms"]
        rows.append(
            [f"{what} in a directory of {directory['names']:,} names", f"<= {most:g} ms", f"{took:.2f} ms", took <= most]
        )
    slowest = max(row["heard ms"] for row in start)
    rows.append(["start to first message", "<= 250 ms", f"{slowest:.0f} ms", slowest <= 250])
    return table(["what", "target", "measured", ""], [[*row[:3], "reached" if row[3] else "**missed**"] for row in rows])


def round_trips(results: Results) -> str:
    """Of all stacks."""
    return _table(results["connectivity"]["round_trips_and_rates"])


def ratios(results: Results) -> str:
    """Of all stacks."""
    return _table(results["connectivity"]["ratios"])


def directory(results: Results) -> str:
    """Of 10,000 names."""
    return _table(results["connectivity"]["directory"])


def start(results: Results) -> str:
    """Of a program."""
    return _table(results["connectivity"]["start"])


def wan(results: Results) -> str:
    """Ours beside figure 8.7."""
    found = results["connectivity"]["wan"]
    if "skipped" in found:
        return str(found["skipped"])
    rows: list[dict[str, Any]] = [*found["round_trips"]]
    rows += [
        {"stack": f"dissertation: {name}", **{f"{size} mean ms": value for size, value in values.items()}}
        for name, values in FIGURE_8_7.items()
    ]
    return _table(rows)


def sealing(results: Results) -> str:
    """Microseconds a message."""
    head = ["message", "mode", "seal, us", "open, us", "seal / floor", "open / floor", "both / primitives"]
    keys = ("seal", "open", "seal / floor", "open / floor", "both / primitives")
    return table(
        head, [[f"{row['bytes']:,} B", row["mode"], *(row[key] for key in keys)] for row in results["sealing"]["sealing"]]
    )


def proxies(results: Results) -> str:
    """Round trips through two ROS 2 proxies."""
    head = ["round trip, ms", "direct p50", "p99", "router p50", "p99", "router / direct"]
    keys = ("direct_p50", "direct_p99", "router_p50", "router_p99", "ratio")
    return table(head, [[f"{row['bytes']:,} B", *(row[key] for key in keys)] for row in results["proxies"]["latency"]])


def proxy_rates(results: Results) -> str:
    """Messages through two proxies."""
    return table(
        ["messages of 1000 B", "a second"], [[name, round(rate)] for name, rate in results["proxies"]["rates"].items()]
    )


def tasks(results: Results) -> str:
    """Robot steps and images a second, and what they were measured on."""
    from benchmarks import tasks as benchmark  # it imports the simulators, which connectivity does without

    found = results["tasks"]
    where, form = found["machine"], "quick form, " if found["quick"] else ""
    return (
        f"{benchmark.page(found)}\n\nMeasured on {where['cores']} cores of {where['processor']} "
        f"({form}load before: {where['load_average_before']})."
    )


def console(results: Results) -> str:
    """The server under the load of the issue: processors, delays, pictures."""
    found = results["console"]
    m, machine = found["measured"], found["machine"]
    rows: list[list[Any]] = [
        ["server, % of all cores", f"{m['server_cpu_percent_of_machine']:.0f}", "< 60"],
        ["round trip of a message, ms, median", f"{m['round_trip_p50_ms']:.1f}", ""],
        ["round trip of a message, ms, p99", f"{m['round_trip_p99_ms']:.1f}", "< 20"],
        ["handling of a command, ms, p99 (median over seconds)", f"{m['command_handling_p99_of_a_second_p50_ms']:.2f}", ""],
        ["timesteps a second", f"{m['timesteps_per_second']:.2f}", "10"],
        ["pictures a second", f"{m['pictures_per_second']:.0f}", "400"],
        ["from the robot's state to the picture, ms, median", f"{m['picture_delay_p50_ms']:.0f}", ""],
        ["swap of weights, ms", f"{m['weights_swap_ms']:.1f}", ""],
        ["a process that only sleeps, away for ms, p99", f"{m['idle_process_away_p99_ms']:.1f}", ""],
    ]
    where = f"{machine['cores']} cores of {machine['processor']}, load before: {machine['load_average_before']}"
    return f"{table(['', 'measured', 'target'], rows)}\n\nMeasured on {where}."


TABLES: dict[str, tuple[str, Callable[[Results], str]]] = {
    "loop": ("loop", loop),
    "loop-phases": ("loop", loop_phases),
    "allocation": ("allocation", allocation),
    "gates": ("gates", gates),
    "engine": ("engine", engine),
    "memory": ("memory", memory),
    "machines": ("", machines),
    "targets": ("connectivity", targets),
    "round-trips": ("connectivity", round_trips),
    "ratios": ("connectivity", ratios),
    "directory": ("connectivity", directory),
    "start": ("connectivity", start),
    "wan": ("connectivity", wan),
    "sealing": ("sealing", sealing),
    "proxies": ("proxies", proxies),
    "proxy-rates": ("proxies", proxy_rates),
    "tasks": ("tasks", tasks),
    "console": ("console", console),
}
"""By name, each with the benchmark whose results it needs."""


def _table(rows: list[dict[str, Any]]) -> str:
    return table(list(rows[0]), [[row.get(key, "") for key in rows[0]] for row in rows])


def render(page: str, results: Results) -> str:
    """The page with the tables of these results."""

    def fill(place: re.Match[str]) -> str:
        benchmark, make = TABLES[place[1]]
        return f"{place[1]} -->\n\n{make(results)}\n\n" if not benchmark or benchmark in results else place[0]

    return PLACE.sub(fill, page)


def renew(*, check: bool = False) -> list[str]:
    """Write the pages; with `check` only compare. The names of those that were not as they should be.

    A table whose benchmark has no results yet stays as it is.
    """
    stale = []
    for name, benchmarks in PAGES.items():
        files = {benchmark: RESULTS / f"{benchmark}.json" for benchmark in benchmarks}
        results = {known: json.loads(file.read_text(encoding="utf-8")) for known, file in files.items() if file.exists()}
        page = ROOT / "docs" / name
        before = page.read_text(encoding="utf-8")
        after = render(before, results)
        if before != after:
            stale.append(f"docs/{name}")
            if not check:
                page.write_text(after, encoding="utf-8")
    return stale


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pages", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale = renew(check=check)
    if stale and check:
        raise SystemExit(f"{' and '.join(stale)}: not what the results say; run: python -m benchmarks.pages")


if __name__ == "__main__":
    main()
