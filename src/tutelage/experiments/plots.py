"""The curves of runs as a figure: mean and 95 % confidence band over the runs of each algorithm."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import MissingExtraError
from tutelage.store import write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tutelage.experiments.records import RunRecord

Array = NDArray[Any]

POINTS = 250
"""Points of a drawn curve: about one for each pixel of a panel."""

# fmt: off
_T95 = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)
# fmt: on


class Theme(NamedTuple):
    """Colours of a figure. The series are those of Okabe and Ito, which colour-blind readers can tell apart."""

    background: str
    text: str
    muted: str
    grid: str
    series: tuple[str, ...]


LIGHT = Theme(
    "#ffffff", "#1c2330", "#5b6575", "#e4e8ee", ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#4a4a4a")
)
DARK = Theme(
    "#161b22", "#e6edf3", "#9aa7b6", "#2b3440", ("#4aa8e0", "#f08040", "#2cc59a", "#e39cc4", "#f2b632", "#8fd0f5", "#c0c6cf")
)
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.5, 1.5)))
"""The second and third round of colours differ by their dashes."""


# -- statistics over seeds ------------------------------------------------------------------------------------------------


def t95(degrees: int) -> float:
    """The two-sided 95 % quantile of Student's t for a number of degrees of freedom >= 1."""
    if degrees <= len(_T95):
        return _T95[degrees - 1]
    z = 1.959964  # Cornish-Fisher expansion, right to 3 decimals from here on
    return z + (z**3 + z) / (4 * degrees) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * degrees**2)


def mean_ci(values: Array) -> tuple[Array, Array]:
    """Mean and half width of its 95 % confidence interval over the runs: (n, ...) -> (...), (...).

    NaN half width for a single run: one run says nothing about the others.
    """
    n = len(values)
    mean = np.mean(values, axis=0)
    if n < 2:
        return mean, np.full_like(mean, np.nan)
    return mean, t95(n - 1) * np.std(values, axis=0, ddof=1) / math.sqrt(n)


def interval(values: Array, digits: int = 0) -> str:
    """Mean and half width of its 95 % confidence interval over runs (n,), such as "0.98 ± 0.03"; one run has no width."""
    mean, half = mean_ci(values)
    return f"{mean:,.{digits}f}" + (f" ± {half:,.{digits}f}" if len(values) > 1 else "")


def by_label(runs: Sequence[RunRecord]) -> dict[str, list[RunRecord]]:
    """The runs of each algorithm, in the order of their first appearance."""
    groups: dict[str, list[RunRecord]] = {}
    for run in runs:
        groups.setdefault(run.label, []).append(run)
    return groups


# -- what the panels show -------------------------------------------------------------------------------------------------


class Panel(NamedTuple):
    """A panel of the figure: a metric over time."""

    metric: str
    title: str
    unit: str


PANELS = (
    Panel("successes", "Successes", "tasks completed"),
    Panel("rohe", "Return on human effort", "successes · M/N per 100 human timesteps"),
    Panel("hard_resets", "Hard resets", "resets completed"),
    Panel("idle_time", "Idle time", "robot timesteps in violation"),
    Panel("human_time", "Human time", "human timesteps"),
    Panel("loss", "Policy loss", "training loss, moving average"),
)
SPLIT = (("teleoperation", "teleoperation"), ("resetting", "hard resets"), ("waiting", "switching"))


def series(run: RunRecord, metric: str) -> tuple[Array, Array]:
    """A metric of a run over time: timesteps (k,) and values (k,), without gaps. Cumulative metrics start at (0, 0)."""
    if metric == "loss":
        names = sorted(name for name in run.metrics if name.startswith("loss/"))
        metric = "loss/policy" if "loss/policy" in names else names[0] if names else "loss/policy"
    t, values = run.metrics["t"], run.metrics.get(metric, np.full(len(run.metrics["t"]), np.nan))
    known = np.isfinite(values)
    t, values = t[known], values[known]
    if metric.startswith("loss/"):
        return t, smooth(values, width=max(1, len(values) // 50))
    if len(t) and t[0] > 0:
        t, values = np.concatenate([[0.0], t]), np.concatenate([[0.0], values])
    return t, values


def smooth(values: Array, width: int) -> Array:
    """Centred moving average over up to 2 `width` + 1 values (fewer at the ends), (k,) -> (k,)."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    k = np.arange(len(values))
    low, high = np.maximum(k - width, 0), np.minimum(k + width + 1, len(values))
    return np.asarray((total[high] - total[low]) / (high - low))


def band(runs: Sequence[RunRecord], metric: str) -> tuple[Array, Array, Array]:
    """Timesteps, mean and half width of the 95 % band of a metric over runs, (k,) each; k = 0 where no run has it.

    Ends where the shortest run ends: a mean over different runs at different times would jump.
    """
    curves = [(t, values) for t, values in (series(run, metric) for run in runs) if len(t)]
    if not curves:
        return np.empty(0), np.empty(0), np.empty(0)
    start, end = max(t[0] for t, _ in curves), min(t[-1] for t, _ in curves)
    grid = np.linspace(start, end, POINTS) if end > start else np.array([end])
    mean, half = mean_ci(np.array([np.interp(grid, t, values) for t, values in curves]))
    return grid, mean, half


def heading(runs: Sequence[RunRecord]) -> str:
    """What all runs have in common, such as "humanoid, 100 robots, 10 humans"."""
    parts = []
    for key, text in (("task", "{}"), ("robots", "{} robots"), ("humans", "{} humans")):
        values = {str(run.config.get(key)) for run in runs}
        if len(values) == 1 and values != {"None"}:
            parts.append(text.format(values.pop()))
    return ", ".join(parts)


# -- drawing ----------------------------------------------------------------------------------------------------------------


def curves(runs: Sequence[RunRecord], dark: bool = False, titled: bool = True) -> Figure:
    """Successes, ROHE, hard resets, idle time, human time and policy loss over time, in 2 x 3 panels.

    Args:
        runs: at least one. Runs with the same label become one line with a band.
        dark: light lines on a dark background.
        titled: with a title; a page may have its own.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch
    except ImportError:
        raise MissingExtraError("matplotlib", "report") from None
    theme = DARK if dark else LIGHT
    groups = by_label(runs)
    with rc_context({"font.family": "sans-serif", "font.size": 9, "text.parse_math": False}):
        layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08, wspace=0.03, hspace=0.05)
        figure = Figure(figsize=(12, 6.9), layout=layout, facecolor=theme.background)
        axes = figure.subplots(2, 3)
        end = max(float(run.metrics["t"][-1]) for run in runs)
        for panel, axis in zip(PANELS, axes.flat, strict=True):
            if panel.metric == "human_time" and len(runs) == 1:
                _split(axis, runs[0], theme)
            else:
                for k, group in enumerate(groups.values()):
                    line(axis, band(group, panel.metric), **style(theme, k))
            dress(axis, panel, theme, end, readable(end))
        entries: list[tuple[str, Any]] = []
        if len(groups) > 1:
            count = "  (n = {})" if len(runs) > len(groups) else ""
            entries = [
                (label + count.format(len(group)), Line2D([], [], linewidth=2.4, **style(theme, k)))
                for k, (label, group) in enumerate(groups.items())
            ]
        if len(runs) > len(groups):
            entries.append(("95 % confidence interval", Patch(facecolor=theme.muted, alpha=0.25, linewidth=0)))
        if titled:
            title = heading(runs) if len(groups) > 1 else ", ".join(filter(None, [heading(runs), next(iter(groups))]))
            figure.suptitle(title, x=0.012, ha="left", fontsize=14, fontweight="bold", color=theme.text)
        if entries:
            columns = min(len(entries), 5)
            names, handles = zip(*by_column(entries, columns), strict=True)
            figure.legend(
                handles, names, loc="outside lower left", ncols=columns, frameon=False, fontsize=10,
                labelcolor=theme.text, handlelength=2.2, columnspacing=2,
            )  # fmt: skip
    return figure


def by_column(entries: list[Any], columns: int) -> list[Any]:
    """Reorder the entries of a legend, which matplotlib fills column by column, so that they read row by row."""
    rows = [entries[k : k + columns] for k in range(0, len(entries), columns)]
    return [row[k] for k in range(columns) for row in rows if k < len(row)]


def style(theme: Theme, k: int) -> dict[str, Any]:
    """Colour and dashes of the k-th line."""
    rounds = len(theme.series)
    return {"color": theme.series[k % rounds], "linestyle": DASHES[k // rounds % len(DASHES)]}


def line(axis: Axes, curve: tuple[Array, Array, Array], color: str, linestyle: Any) -> None:
    """Draw timesteps, mean and half width of the band, (k,) each."""
    t, mean, half = curve
    if len(t) == 1:
        axis.plot(t, mean, color=color, marker="o", markersize=4, clip_on=False)
    elif len(t):
        # Nothing shown here is negative, so the part of an interval below 0 is left out.
        axis.fill_between(t, np.maximum(mean - half, 0), mean + half, color=color, alpha=0.18, linewidth=0)
        axis.plot(t, mean, color=color, linestyle=linestyle, linewidth=1.8, solid_capstyle="round")


def _split(axis: Axes, run: RunRecord, theme: Theme) -> None:
    """Human time of a single run, stacked by what it was spent on, with the names beside the layers."""
    parts = [(name, *series(run, metric)) for metric, name in SPLIT]
    parts = [(name, t, values) for name, t, values in parts if len(t) and values[-1] > 0]
    if not parts:
        return
    grid = np.linspace(0, max(t[-1] for _, t, _ in parts), POINTS)
    layers = np.array([np.interp(grid, t, values) for _, t, values in parts])
    colors = [theme.series[k] for k in (0, 4, 3)][: len(parts)]
    axis.stackplot(grid, layers, colors=colors, alpha=0.85, linewidth=0)
    axis.legend(
        axis.collections[::-1], [f"{name}  {values[-1]:,.0f}" for name, _, values in parts[::-1]], loc="upper left",
        frameon=False, fontsize=9, labelcolor=theme.text, handlelength=1, handleheight=1,
    )  # fmt: skip


def dress(axis: Axes, panel: Panel, theme: Theme, end: float, label: Callable[..., str]) -> None:
    """Title, units, grid, limits."""
    axis.set_facecolor(theme.background)
    axis.set_title(panel.title, loc="left", fontsize=11.5, fontweight="bold", color=theme.text, pad=19)
    axis.text(0, 1.025, panel.unit, transform=axis.transAxes, fontsize=9, color=theme.muted, va="bottom")
    axis.set_xlabel("timestep", color=theme.muted)
    axis.set_xlim(0, max(end, 1))
    axis.grid(axis="y", color=theme.grid, linewidth=0.8)
    axis.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    axis.spines["bottom"].set_color(theme.muted)
    axis.tick_params(colors=theme.muted, length=0, pad=5)
    axis.xaxis.set_major_formatter(label)
    axis.locator_params(axis="x", nbins=6, integer=True)
    if not axis.has_data():
        axis.set_yticks([])
        axis.text(
            0.5, 0.5, "not recorded", transform=axis.transAxes, ha="center", va="center", color=theme.muted, fontsize=10
        )
        return
    # The lines decide what is shown; the band of two or three runs may be many times as high.
    lines = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in axis.lines] or [np.empty(0)])
    if panel.metric == "loss" and lines.min() > 0 and lines.max() > 20 * lines.min():
        axis.set_yscale("log")
        axis.set_ylim(lines.min() / 2, lines.max() * 2)
        axis.yaxis.set_major_formatter("{x:g}")  # powers of ten would need mathematical text
        axis.yaxis.set_minor_formatter("")
        axis.tick_params(which="minor", length=0)
        return
    top = min(axis.dataLim.y1, 1.5 * lines.max()) if len(lines) else axis.dataLim.y1
    axis.set_ylim(0, top * 1.05 if top > 0 else 1)
    axis.locator_params(axis="y", nbins=5, integer=panel.metric not in ("rohe", "loss"))
    axis.yaxis.set_major_formatter(readable(top))


def readable(top: float) -> Callable[..., str]:
    """A tick formatter: 12,000 as 12k, and no digits that the axis does not need."""
    scale, suffix = (1e6, "M") if top >= 10_000_000 else (1e3, "k") if top >= 10_000 else (1, "")

    def text(value: float, position: int | None = None) -> str:
        return f"{value / scale:,.6g}{suffix if value else ''}"

    return text


def render(figure: Figure, form: str) -> bytes:
    """The figure as a file: "png" or "svg". The same figure gives the same bytes."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "tutelage", "text.parse_math": False}):
        metadata = {"Date": None} if form == "svg" else {"Software": None}
        figure.savefig(buffer, format=form, dpi=160, metadata=metadata, facecolor=figure.get_facecolor())
    return buffer.getvalue()


def save(figure: Figure, path: Path) -> Path:
    """Write the figure; the suffix (.png or .svg) says how. Returns the path."""
    write_atomic(path, render(figure, path.suffix.removeprefix(".").lower()))
    return path
