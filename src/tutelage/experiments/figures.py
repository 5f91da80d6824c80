"""The figures of docs/results.md: the algorithms of a task over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tutelage.errors import MissingExtraError
from tutelage.experiments import plots
from tutelage.experiments.results import OURS, Groups

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = tuple(panel for panel in plots.PANELS if panel.metric in ("successes", "rohe", "hard_resets", "idle_time"))


def figure(task: str, groups: Groups) -> Figure:
    """Successes, ROHE, hard resets and idle time over time in 2 x 2 panels: mean and one standard deviation.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
        from matplotlib.lines import Line2D
    except ImportError:
        raise MissingExtraError("matplotlib", "report") from None
    theme = plots.LIGHT
    # C.U.R. has the first colour in every figure, and is drawn last, on top.
    order = sorted(groups, key=lambda name: name != OURS)
    look = {name: plots.style(theme, k) for k, name in enumerate(order)}
    end = max(float(r["curves"]["t"][-1]) for g in groups.values() for r in g.results)
    with rc_context({"font.family": "sans-serif", "font.size": 9, "text.parse_math": False}):
        layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08, wspace=0.03, hspace=0.05)
        picture = Figure(figsize=(9.2, 7.2), layout=layout, facecolor=theme.background)
        for panel, axis in zip(PANELS, picture.subplots(2, 2).flat, strict=True):
            for name in reversed(order):
                plots.line(axis, groups[name].band(panel.metric), **look[name])
            plots.dress(axis, panel, theme, end, plots.readable(end))
        c = next(iter(groups.values())).config
        picture.suptitle(
            f"{task}, {c['robots']} robots, {c['humans']} humans", x=0.012, ha="left", fontsize=14, fontweight="bold",
            color=theme.text,
        )  # fmt: skip
        entries = [(groups[name].title, Line2D([], [], linewidth=2.4, **look[name])) for name in order]
        columns = min(len(entries), 4)
        names, handles = zip(*plots.by_column(entries, columns), strict=True)
        picture.legend(
            handles, names, loc="outside lower left", ncols=columns, frameon=False, fontsize=9.5,
            labelcolor=theme.text, handlelength=2.2, columnspacing=2,
        )  # fmt: skip
    return picture


def figure_name(task: str, kind: str) -> str:
    """The file of a figure in docs/images/."""
    return f"results-{kind}-{task}.png"
