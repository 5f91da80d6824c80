"""All of it, with tables."""

from __future__ import annotations

from typing import Any


def run(quick: bool = False) -> dict[str, Any]:
    """Measure, and print tables."""
    from benchmarks.connectivity import directory, loopback, start, wan
    from benchmarks.timing import table  # loads torch, which the other processes of this benchmark do not need

    def show(title: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        print(f"\n{title}\n\n{table(list(rows[0]), [list(row.values()) for row in rows])}", flush=True)
        return rows

    found = loopback.measure(quick)
    show("round trip, median; 1000-byte messages a second that arrived, one way", found["round_trips_and_rates"])
    show("ratios, medians over turns", found["ratios"])
    found["directory"] = show("directory", [directory.measure(1000 if quick else 10_000)])
    found["start"] = show("from start to first message", start.measure(3 if quick else 15))
    found["wan"] = wan.measure(quick)
    if "skipped" in found["wan"]:
        print(f"\nwide-area network: {found['wan']['skipped']}")
    else:
        show("wide-area network, 40 ms and 1 % loss each way", found["wan"]["round_trips"])
    return found
