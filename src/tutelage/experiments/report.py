"""One page about one or many runs: what was achieved, what it cost, and how the runs differ.

A report is a single HTML file that needs nothing else: no network, no script, pictures inside.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.experiments.plots import by_label, curves, heading, mean_ci, render, save
from tutelage.experiments.records import RunRecord, load_runs
from tutelage.fleet.metrics import time_in_modes
from tutelage.fleet.modes import Mode
from tutelage.store import write_atomic

Array = NDArray[Any]


# -- the table --------------------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """A row of the summary table.

    better: +1 if more is better, -1 if less is, 0 if neither; digits: decimals of a single run's number.
    """

    metric: str
    title: str
    unit: str
    better: int = 0
    digits: int = 0


ROWS = (
    Row("t", "Operation time", "timesteps"),
    Row("successes", "Successes", "tasks", +1),
    Row("rohe", "ROHE", "eq. 5.2", +1, 3),
    Row("violations", "Violations", "times", -1),
    Row("hard_resets", "Hard resets", "times", -1),
    Row("timeouts", "Timeouts", "episodes", -1),
    Row("idle_time", "Idle time", "robot timesteps", -1),
    Row("human_time", "Human time", "human timesteps", -1),
    Row("teleoperation", "  teleoperation", "human timesteps"),
    Row("resetting", "  hard resets", "human timesteps"),
    Row("waiting", "  switching", "human timesteps"),
    Row("switches_to_human", "Switches to a human", "times", -1),
    Row("switches_to_robot", "Switches to the robot", "times", -1),
    Row("intervention_length", "Intervention length", "median timesteps", 0, 1),
    Row("request_rate", "Requests", "per autonomous timestep", 0, 4),
    Row("episode/interventions", "Interventions", "mean of an episode", 0, 2),
    Row("episode/human_actions", "  actions of the human", "mean of an episode", 0, 1),
    Row("episode/robot_actions", "  actions of the robot", "mean of an episode", 0, 1),
    Row("evaluation/successes", "Evaluation: successes", "tasks", +1),
    Row("evaluation/hard_resets", "Evaluation: hard resets", "times", -1),
    Row("evaluation/idle_time", "Evaluation: idle time", "robot timesteps", -1),
    Row("evaluation/steps", "Evaluation: operation time", "timesteps"),
)
ABSENT = "–"  # noqa: RUF001 - an en dash


def statistic(runs: Sequence[RunRecord], row: Row) -> tuple[float, float, int]:
    """Mean, half width of its 95 % confidence interval, and number of runs that have the metric."""
    values = np.array([run.final.get(row.metric, math.nan) for run in runs])
    values = values[np.isfinite(values)]
    if not len(values):
        return math.nan, math.nan, 0
    mean, half = mean_ci(values)
    return float(mean), float(half), len(values)


def cell(runs: Sequence[RunRecord], row: Row) -> str:
    """Mean and half width as text, such as "746.3 ± 40.5"."""
    mean, half, n = statistic(runs, row)
    if n == 0:
        return ABSENT
    if row.metric in ("t", "evaluation/steps") and (n == 1 or half == 0):
        return f"{mean:,.0f}"
    digits = row.digits if n == 1 else max(row.digits, 1)
    return f"{mean:,.{digits}f}" + (f" ± {half:,.{digits}f}" if n > 1 else "")


def best(groups: dict[str, list[RunRecord]], row: Row) -> set[str]:
    """The labels with the best mean, if there is anything to compare."""
    means = {label: statistic(group, row)[0] for label, group in groups.items()}
    means = {label: mean for label, mean in means.items() if math.isfinite(mean)}
    if not row.better or len(set(means.values())) < 2:
        return set()
    top = max(mean * row.better for mean in means.values())
    return {label for label, mean in means.items() if mean * row.better == top}


def _present(runs: Sequence[RunRecord]) -> list[Row]:
    """The rows that at least one run can fill; a latency of 0 has no waiting to show."""
    rows = [row for row in ROWS if statistic(runs, row)[2]]
    return [row for row in rows if row.metric != "waiting" or statistic(runs, row)[0] > 0]


def summary_table(runs: Sequence[RunRecord]) -> str:
    """The final metrics as plain text for the terminal: a column for each algorithm, mean ± 95 % interval over its runs."""
    groups = by_label(runs)
    lines = [["", "", *groups], ["Runs", "", *(str(len(group)) for group in groups.values())]]
    lines += [[row.title, row.unit, *(cell(group, row) for group in groups.values())] for row in _present(runs)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    lines.insert(1, ["─" * width for width in widths])
    text = [
        "  ".join(part.ljust(w) if k < 2 else part.rjust(w) for k, (part, w) in enumerate(zip(line, widths, strict=True)))
        for line in lines
    ]
    if any(len(group) > 1 for group in groups.values()):
        text.append("mean ± half width of the 95 % confidence interval (Student's t)")
    return "\n".join(line.rstrip() for line in text)


# -- configurations ---------------------------------------------------------------------------------------------------------


def flatten(config: dict[str, Any], prefix: str = "", digits: int = 17) -> dict[str, str]:
    """A nested configuration as dotted keys and JSON texts, its floats with so many significant digits."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, dict) and value:
            flat |= flatten(value, f"{prefix}{key}.", digits)
        else:
            value = float(f"{value:.{digits}g}") if isinstance(value, float) else value
            flat[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return flat


SELF_EVIDENT = {"algorithm", "label", "out"}
"""Settings that name a run or its place: they differ, but not in what the run does."""


def differences(runs: Sequence[RunRecord]) -> dict[str, list[str]]:
    """Settings that are not the same in all runs: dotted key -> the values of each algorithm, joined by commas.

    Numbers have 4 digits, unless they are the same then.
    """
    groups, short = ([[flatten(run.config, digits=d) for run in g] for g in by_label(runs).values()] for d in (17, 4))
    keys = {key: None for group in groups for flat in group for key in flat if key not in SELF_EVIDENT}

    def kinds(groups: list[list[dict[str, str]]], key: str) -> int:
        return len({flat.get(key) for group in groups for flat in group})

    shown = {key: short if kinds(short, key) > 1 else groups for key in keys if kinds(groups, key) > 1}
    return {
        key: [", ".join(dict.fromkeys(flat.get(key, ABSENT) for flat in group)) for group in chosen]
        for key, chosen in shown.items()
    }


# -- the page ---------------------------------------------------------------------------------------------------------------


def write_report(paths: Sequence[Path | str], out: Path | str) -> Path:
    """Write a report on run folders as one HTML file, and its figure as `plots/curves.png` beside it.

    Args:
        paths: run folders, at least one.
        out: a file whose name ends in .html; or a folder, then `report.html` in it.

    Returns:
        The file.

    Raises:
        RunFolderError: a path is not a run folder, or is damaged.
        MissingExtraError: matplotlib is not installed.
    """
    runs, out = load_runs(paths), Path(out)
    out = out if out.suffix == ".html" and not out.is_dir() else out / "report.html"
    light, dark = (render(curves(runs, dark, titled=False), "svg") for dark in (False, True))
    page = "".join(_page(runs, light, dark))
    save(curves(runs), out.parent / "plots" / "curves.png")
    write_atomic(out, page.encode())
    return out


def _page(runs: Sequence[RunRecord], light: bytes, dark: bytes) -> Iterator[str]:
    groups = by_label(runs)
    title = heading(runs) or "Report"
    yield '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
    yield '<meta name="color-scheme" content="light dark">\n'
    yield f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n"
    yield f"<header><p class=kind>Tutelage report</p>\n<h1>{escape(title)}</h1>\n"
    yield f"<p class=sub>{escape(_scope(runs, groups))}</p>\n{''.join(_notes(runs))}</header>\n"
    if len(groups) == 1:
        yield _tiles(runs)
    yield "<section>\n<h2>Over time</h2>\n<figure><picture>"
    yield f'<source media="(prefers-color-scheme: dark)" srcset="{_data(dark)}">'
    yield f'<img src="{_data(light)}" alt="{escape(_caption(runs))}"></picture>\n'
    yield f"<figcaption>{escape(_caption(runs))}</figcaption></figure>\n</section>\n"
    yield f"<section>\n<h2>Results</h2>\n{_results(runs, groups)}</section>\n"
    changed = differences(runs)
    if changed:
        yield f"<section>\n<h2>What differs between the runs</h2>\n{_differences(changed, groups)}</section>\n"
    yield "<section>\n<h2>Runs</h2>\n"
    for run in runs:
        yield _details(run, opened=len(runs) == 1)
    yield "</section>\n</main>\n</body>\n</html>\n"


def _data(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode()


def _scope(runs: Sequence[RunRecord], groups: dict[str, list[RunRecord]]) -> str:
    steps = sorted({run.steps for run in runs})
    time = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    names = ", ".join(f"{label} ({len(group)})" if len(runs) > 1 else label for label, group in groups.items())
    return f"{names}: {_plural(len(runs), 'run')} of {time} timesteps"


def _plural(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")


def _notes(runs: Sequence[RunRecord]) -> Iterator[str]:
    """What a reader must know before comparing numbers."""
    if len({run.steps for run in runs}) > 1:
        yield _note(
            "The runs have different lengths. The table shows each at its own end, a curve ends with its shortest run."
        )
    for key in ("task", "robots", "humans"):
        if len({str(run.config.get(key)) for run in runs}) > 1:
            yield _note(f"The runs differ in “{key}”: their numbers are not directly comparable.")
    for run in runs:
        planned = run.config.get("steps")
        if isinstance(planned, int) and planned > run.steps:
            yield _note(f"{run.name} stands at timestep {run.steps:,} of {planned:,}.")
        if run.disagreement:
            # Events become durable at checkpoints, metrics line by line.
            yield _note(f"{run.name} is going on, or was interrupted; its files disagree: {run.disagreement}.")


def _note(text: str) -> str:
    return f"<p class=note>{escape(text)}</p>\n"


def _tiles(runs: Sequence[RunRecord]) -> str:
    """The most important numbers of one algorithm."""
    chosen = ("successes", "rohe", "hard_resets", "idle_time", "human_time", "intervention_length")
    tiles = [
        f"<div><dt>{escape(row.title)}</dt><dd>{escape(cell(runs, row))}</dd><p>{escape(row.unit)}</p></div>"
        for row in ROWS
        if row.metric in chosen
    ]
    return f"<dl class=tiles>{''.join(tiles)}</dl>\n"


def _caption(runs: Sequence[RunRecord]) -> str:
    text = "Cumulative successes, return on human effort, hard resets, idle time, human time and policy loss over time."
    if any(len(group) > 1 for group in by_label(runs).values()):
        text += " Lines are means over runs, bands the 95 % confidence intervals of the means."
    return text


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "") -> str:
    """A table of HTML cells; the first column names the row."""
    top = "".join(f"<th scope=col>{cell}</th>" for cell in head)
    body = "".join(
        f"<tr><th scope=row>{row[0]}</th>{''.join(f'<td>{cell}</td>' for cell in row[1:])}</tr>\n" for row in rows
    )
    return f"<div class='scroll {kind}'><table>\n<thead><tr>{top}</tr></thead>\n<tbody>\n{body}</tbody>\n</table></div>\n"


def _results(runs: Sequence[RunRecord], groups: dict[str, list[RunRecord]]) -> str:
    rows = []
    for row in _present(runs):
        arrow = {1: " ↑", -1: " ↓", 0: ""}[row.better]
        name = f"<span class=inner>{escape(row.title.strip())}</span>" if row.title.startswith(" ") else escape(row.title)
        winners = best(groups, row)
        texts = {label: escape(cell(group, row)) for label, group in groups.items()}
        cells = [f"<b>{text}</b>" if label in winners else text for label, text in texts.items()]
        rows.append([f"{name}{arrow} <span class=unit>{escape(row.unit)}</span>", *cells])
    head = ["", *(f"{escape(label)}<span class=unit>{_plural(len(g), 'run')}</span>" for label, g in groups.items())]
    notes = []
    if any(len(group) > 1 for group in groups.values()):
        notes.append("Mean ± half width of the 95 % confidence interval over runs (Student's t).")
    if len(groups) > 1:
        notes.append("↑ more is better, ↓ less is better; the best mean is bold, which alone does not make it significant.")
    notes.append(
        "ROHE = M/N · successes / (1 + human timesteps / 100). Idle time runs from a violation to the end of its reset."
    )
    return _table(head, rows, "narrow" if len(groups) == 1 else "") + f"<p class=caption>{escape(' '.join(notes))}</p>\n"


def _differences(changed: dict[str, list[str]], groups: dict[str, list[RunRecord]]) -> str:
    rows = [[f"<code>{escape(key)}</code>", *(escape(value) for value in values)] for key, values in changed.items()]
    return _table(["", *(escape(label) for label in groups)], rows, "wraps")


def _details(run: RunRecord, opened: bool) -> str:
    """One run: where its robots' time went, its last metrics and its configuration."""
    facts = [f"{run.steps:,} timesteps"]
    if run.config.get("seed") is not None:
        facts.insert(0, f"seed {run.config['seed']}")
    if run.config.get("version") is not None:
        facts.append(f"version {run.config['version']}")
    last = {name: column[np.isfinite(column)] for name, column in run.metrics.items() if name.startswith("loss/")}
    values = run.final | {name: float(column[-1]) for name, column in last.items() if len(column)}
    metrics = [[f"<code>{escape(name)}</code>", _number(value)] for name, value in values.items()]
    settings = [[f"<code>{escape(key)}</code>", escape(value)] for key, value in flatten(run.config).items()]
    return (
        f"<details{' open' if opened else ''}>\n<summary><b>{escape(run.label)}</b> {escape(run.name)} "
        f"<span class=unit>{escape(', '.join(facts))}</span></summary>\n"
        f"<p class=path>{escape(str(run.path))}</p>\n{_time_bar(run)}"
        f"<div class=columns><div><h3>Metrics at the end</h3>{_table(['', ''], metrics)}</div>"
        f"<div><h3>Configuration</h3>{_table(['', ''], settings)}</div></div>\n</details>\n"
    )


def _number(value: float) -> str:
    if not math.isfinite(value):
        return ABSENT
    return f"{value:,.0f}" if value == int(value) else f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.1f}"


def _time_bar(run: RunRecord) -> str:
    """A bar with the share of robot time in each mode."""
    time = time_in_modes(run.log)
    total = max(int(time.sum()), 1)
    shares = [(mode, time[mode] / total) for mode in Mode if time[mode]]
    bar = "".join(f'<i class="m{mode.value}" style="width:{share:.4%}"></i>' for mode, share in shares)
    legend = "".join(
        f'<li><i class="m{mode.value}"></i>{mode.name.lower()} <span class=unit>{_percent(share)}</span></li>'
        for mode, share in shares
    )
    return f"<h3>Robot time</h3>\n<div class=bar>{bar}</div>\n<ul class=legend>{legend}</ul>\n"


def _percent(share: float) -> str:
    return "under 0.1 %" if share < 0.001 else f"{100 * share:.1f} %"


CSS = """
:root { --bg: #f6f8fa; --card: #ffffff; --text: #1c2330; --muted: #5b6575; --line: #dde3ea; --accent: #0072b2;
  --note: #fff6df; --note-line: #e69f00;
  --m0: #56b4e9; --m1: #cc79a7; --m2: #0072b2; --m3: #d55e00; --m4: #e69f00; --m5: #8a93a0; }
@media (prefers-color-scheme: dark) {
  :root { --bg: #0d1117; --card: #161b22; --text: #e6edf3; --muted: #9aa7b6; --line: #2b3440; --accent: #4aa8e0;
    --note: #2b2413; --note-line: #f2b632;
    --m0: #8fd0f5; --m1: #e39cc4; --m2: #3d8fd0; --m3: #f08040; --m4: #f2b632; --m5: #6b7583; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--text);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 2.2rem 1.4rem 4rem; }
.kind { margin: 0; color: var(--accent); font-size: .8rem; font-weight: 600;
  letter-spacing: .08em; text-transform: uppercase; }
h1 { margin: .1rem 0 .3rem; font-size: 1.9rem; line-height: 1.2; letter-spacing: -.01em; overflow-wrap: anywhere; }
h2 { margin: 2.4rem 0 .8rem; font-size: 1.2rem; }
h3 { margin: 1.2rem 0 .5rem; font-size: .95rem; }
.sub { margin: 0; color: var(--muted); overflow-wrap: anywhere; }
.note { margin: .8rem 0 0; padding: .5rem .9rem; background: var(--note); border-left: 3px solid var(--note-line);
  border-radius: 4px; overflow-wrap: anywhere; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(160px, 1fr)); gap: .8rem; margin: 1.6rem 0 0; }
.tiles div, figure, .scroll, details { background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
.tiles div { padding: .8rem 1rem; }
dt, .tiles p { margin: 0; color: var(--muted); font-size: .85rem; }
dd { margin: .1rem 0; font-size: 1.35rem; font-weight: 600; font-variant-numeric: tabular-nums; }
figure { margin: 0; padding: 1rem; }
figure img { display: block; width: 100%; height: auto; }
figcaption, .caption { margin: .7rem 0 0; color: var(--muted); font-size: .87rem; }
.scroll { overflow-x: auto; }
.narrow { max-width: 600px; }
.wraps td { white-space: normal; }
table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .42rem .9rem; text-align: right; white-space: nowrap; border-top: 1px solid var(--line); }
thead th { border-top: 0; font-weight: 600; vertical-align: bottom; }
thead th .unit { display: block; }
tbody th { text-align: left; font-weight: 400; }
tbody tr:hover { background: color-mix(in srgb, var(--accent) 7%, transparent); }
td b { color: var(--accent); }
.inner { padding-left: 1.2rem; }
.unit { color: var(--muted); font-size: .82rem; font-weight: 400; }
code { font: .85rem ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
details { margin-top: .7rem; padding: 0 1rem; }
details[open] { padding-bottom: 1rem; }
summary { margin: 0 -1rem; padding: .7rem 1rem; cursor: pointer; overflow-wrap: anywhere; }
details thead { display: none; }
details tbody tr:first-child > * { border-top: 0; }
details td { white-space: normal; overflow-wrap: anywhere; }
.path { margin: 0; color: var(--muted); font-size: .85rem; overflow-wrap: anywhere; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 0 1.2rem; }
.bar { display: flex; height: 18px; overflow: hidden; border-radius: 4px; background: var(--line); }
.bar i { display: block; height: 100%; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.4rem; margin: .5rem 0 0; padding: 0; list-style: none; }
.legend i { display: inline-block; width: .75rem; height: .75rem; margin-right: .45rem; border-radius: 3px; }
.m0 { background: var(--m0); } .m1 { background: var(--m1); } .m2 { background: var(--m2); }
.m3 { background: var(--m3); } .m4 { background: var(--m4); } .m5 { background: var(--m5); }
@media print { body { background: none; } details, figure, .scroll { break-inside: avoid; } }
"""
