"""The tables and figures of docs/results.md, made from the small result files that `tutelage.experiments.study` wrote.

    python -m tutelage.experiments.tables results/fleet            # print, rewrite the page, draw docs/images/
    python -m tutelage.experiments.tables results/fleet --check    # exit 1 if the page does not say what the files say

Only what stands between `<!-- begin: NAME -->` and `<!-- end: NAME -->` is rewritten: `tables` in results.md, and `levels`
in tasks.md from results/levels.json.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from tyro.conf import Positional

from tutelage.errors import MissingExtraError, RunFolderError, TutelageError
from tutelage.experiments import plots
from tutelage.store import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[Any]

TASKS = ("HalfCheetah", "Walker2d", "Ant", "Humanoid")
ALGORITHMS = {
    "C. (BC)": "Behaviour cloning (C.)",
    "Random": "Random",
    "U.C.": "Fleet-EnsembleDAgger (U.C.)",
    "U.G.C.": "Fleet-ThriftyDAgger (U.G.C.)",
    "C.U.R.(-i)": "C.U.R.(-i)",
    "C.U.": "C.U.",
    "C.R.": "C.R.",
    "U.R.": "U.R.",
    "U.": "U.",
    "R.": "R.",
    "C.U.R.": "C.U.R.",
}
"""Algorithms in the order of their rows, and their names in tables."""
OURS = "C.U.R."


class Column(NamedTuple):
    """A column of a table: a metric, its title, whether more (+1) or less (-1) is better, decimals."""

    metric: str
    title: str
    better: int
    digits: int = 1


ONLINE = (
    Column("successes", "Successes", +1),
    Column("hard_resets", "Hard resets", -1),
    Column("idle_time", "Idle time", -1),
    Column("human_time", "Human time", -1),
    Column("rohe", "ROHE", +1, 3),
)
FROZEN = ONLINE[:3]

PUBLISHED: dict[str, dict[str, tuple[str, str, str]]] = {
    "Humanoid": {
        "C. (BC)": ("0.0 ± 0.0", "11,925.3 ± 118.8", "62,473.7 ± 869.1"),
        "Random": ("746.3 ± 40.5", "340.0 ± 59.2", "1,700.0 ± 296.1"),
        "U.C.": ("617.7 ± 66.3", "570.3 ± 139.0", "2,851.7 ± 694.8"),
        "C.U.R.": ("771.0 ± 25.5", "289.3 ± 21.1", "1,446.7 ± 105.3"),
        "Expert": ("894", "115", "575"),
    }
}
"""Table C.2 of the dissertation: successes, hard resets and idle time of the frozen policies."""

NEAR_EXPERT = 0.8
"""A frozen policy approaches the expert when it completes this fraction of the expert's tasks."""
LITTLE_IDLE = 0.01
"""Idle time counts as eliminated below this fraction of all robot time."""
RULE = 0.9, 0.2
"""A level of disturbance fits when the expert succeeds more often than the first number, the cloned policy less than the
second."""


# -- the result files -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """The runs of one algorithm on one task, by seed. At least one."""

    algorithm: str
    results: tuple[dict[str, Any], ...]

    @property
    def title(self) -> str:
        """The name in tables."""
        return ALGORITHMS.get(self.algorithm, self.algorithm)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds, in order."""
        return tuple(int(r["seed"]) for r in self.results)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration of the first run."""
        config: dict[str, Any] = self.results[0]["config"]
        return config

    def values(self, metric: str, part: str = "metrics") -> Array:
        """A number of every run that has it, (n,): `part` is metrics, evaluation or expert."""
        return np.array([float(r[part][metric]) for r in self.results if part in r])

    def mean(self, metric: str, part: str = "metrics") -> float:
        """The mean of `values`; NaN if there are none."""
        values = self.values(metric, part)
        return float(values.mean()) if len(values) else math.nan

    def text(self, column: Column, part: str = "metrics") -> str:
        """Mean and standard deviation over the runs, such as "746.3 ± 40.5"; one run has no deviation."""
        values = self.values(column.metric, part)
        if not len(values):
            return "–"  # noqa: RUF001 - an en dash
        mean = f"{values.mean():,.{column.digits}f}"
        return mean if len(values) == 1 else f"{mean} ± {values.std():,.{column.digits}f}"

    def band(self, metric: str) -> tuple[Array, Array, Array]:
        """Timesteps, mean and one standard deviation over the runs of a curve, (k,) each."""
        curves = [(np.array(r["curves"]["t"]), np.array(r["curves"][metric])) for r in self.results]
        end = min(t[-1] for t, _ in curves)
        grid = np.linspace(0.0, end, 61)  # a result file has 50 points
        values = np.array([np.interp(grid, np.append(0, t), np.append(0, v)) for t, v in curves])
        return grid, values.mean(axis=0), values.std(axis=0)


Groups = dict[str, Group]


def read(results: Path, kind: str) -> dict[str, Groups]:
    """The result files of a kind ("comparison" or "ablations"): task -> algorithm -> runs, in the order of the tables.

    Raises:
        RunFolderError: a file is damaged.
    """
    tasks: dict[str, Groups] = {}
    folders = [folder for folder in (results / kind).glob("*") if folder.is_dir()]
    for folder in sorted(folders, key=lambda f: (_position(f.name, TASKS), f.name)):
        found: dict[str, list[dict[str, Any]]] = {}
        for path in sorted(folder.glob("*.json")):
            result = _read(path)
            found.setdefault(str(result["algorithm"]), []).append(result)
        groups = [Group(name, tuple(sorted(runs, key=lambda r: int(r["seed"])))) for name, runs in found.items()]
        groups.sort(key=lambda g: (_position(g.algorithm, tuple(ALGORITHMS)), g.algorithm))
        if groups:
            tasks[folder.name] = {group.algorithm: group for group in groups}
    return tasks


def _read(path: Path) -> dict[str, Any]:
    try:
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        missing = {"algorithm", "seed", "metrics", "curves", "config"} - set(result)
    except (OSError, ValueError, TypeError) as error:
        raise RunFolderError(f"{path} is damaged: {error}") from None
    if missing:
        raise RunFolderError(f"{path} is no result of tutelage.experiments.study: it lacks {', '.join(sorted(missing))}")
    return result


def _position(name: str, known: Sequence[str]) -> int:
    return known.index(name) if name in known else len(known)


# -- tables ---------------------------------------------------------------------------------------------------------------


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table: the first column to the left, numbers to the right."""
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _arrow(column: Column) -> str:
    return f"{column.title} {'↑' if column.better > 0 else '↓'}"


def _rows(groups: Groups, columns: Sequence[Column], part: str) -> list[list[str]]:
    """A row an algorithm; the best mean of a column is bold."""
    shown = [group for group in groups.values() if len(group.values(columns[0].metric, part))]
    table = []
    for group in shown:
        cells = []
        for column in columns:
            means = [other.mean(column.metric, part) for other in shown]
            best = max(means) if column.better > 0 else min(means)
            text = group.text(column, part)
            winner = len(set(means)) > 1 and group.mean(column.metric, part) == best
            cells.append(f"**{text}**" if winner else text)
        table.append([group.title, str(len(group.values(columns[0].metric, part))), *cells])
    return table


def online_table(groups: Groups) -> str:
    """What was achieved, and what it cost, while learning (figure 5.3 at T)."""
    return markdown(["Algorithm", "Seeds", *map(_arrow, ONLINE)], _rows(groups, ONLINE, "metrics"))


def frozen_table(groups: Groups, task: str) -> str:
    """The frozen policies with hard resets only, and the expert (table C.2); beside them what was published."""
    rows = _rows(groups, FROZEN, "evaluation")
    if not rows:
        return ""
    names = [group.algorithm for group in groups.values() if len(group.values("successes", "evaluation"))]
    expert = next((g for g in groups.values() if len(g.values("successes", "expert"))), None)
    if expert:
        count = str(len(expert.values("successes", "expert")))
        rows.append(["Expert", count, *(expert.text(column, "expert") for column in FROZEN)])
        names.append("Expert")
    head = ["Algorithm", "Seeds", *map(_arrow, FROZEN)]
    if task in PUBLISHED:
        head += [f"{column.title}, published" for column in FROZEN]
        rows = [row + list(PUBLISHED[task].get(name, ("–",) * 3)) for row, name in zip(rows, names, strict=True)]  # noqa: RUF001
    return markdown(head, rows)


def setting(groups: Groups) -> str:
    """What all runs of a task have in common, in one sentence."""
    reference = groups.get(OURS) or next(iter(groups.values()))
    c, t = reference.config, reference.config["thresholds"]
    parts = [
        f"{c['robots']} robots, {c['humans']} humans, T = {c['steps']:,}, t_T = {c['t_teleop']}, t_R = {c['t_reset']}",
        f"disturbance {c['disturbance']}",
        f"{c['offline_pairs']:,} offline pairs",
    ]
    if reference.algorithm == OURS:
        parts.append(f"t_I = {t['initial']}")
        for name, symbol in (("uncertainty", "û"), ("risk", "r̂")):
            values = [r["config"]["thresholds"][name] for r in reference.results]
            if all(isinstance(v, int | float) for v in values):
                low, high = min(values), max(values)
                parts.append(f"{symbol} = {low:.3g}" + ("" if low == high else f" to {high:.3g}"))
    return "; ".join(parts) + "."


# -- the dissertation's relations -------------------------------------------------------------------------------------------


class Relation(NamedTuple):
    """A statement of the dissertation, and what our data say about it."""

    statement: str
    holds: bool
    numbers: str

    @property
    def verdict(self) -> str:
        """In capitals, for a reader who skims."""
        return "HOLDS" if self.holds else "DOES NOT HOLD"


def relations(groups: Groups) -> list[Relation]:
    """Section 5.6 and appendix C.3: those statements that the runs at hand can be asked about."""
    if OURS not in groups or len(groups) < 2:
        return []
    found = [
        _leads(groups, ONLINE[0], "C.U.R. has the most cumulative successes"),
        _leads(groups, ONLINE[4], "C.U.R. has the highest ROHE"),
        _leads(groups, ONLINE[1], "C.U.R. has fewer hard resets than the baselines"),
        *(_idle(groups, name) for name in ("U.C.", OURS) if name in groups),
    ]
    ours, expert = groups[OURS].mean("successes", "evaluation"), groups[OURS].mean("successes", "expert")
    if math.isfinite(ours) and math.isfinite(expert):
        fraction = ours / expert if expert else math.nan
        found.append(
            Relation(
                f"Frozen, C.U.R. approaches the expert (at least {NEAR_EXPERT:.0%} of its successes)",
                fraction >= NEAR_EXPERT,
                f"{ours:,.1f} of {expert:,.1f}, {fraction:.0%}",
            )
        )
    return found


def ablation_relations(groups: Groups) -> list[Relation]:
    """Appendix C.4: C.U.R. against its ablations."""
    if OURS not in groups or len(groups) < 2:
        return []
    return [
        _leads(groups, ONLINE[4], "C.U.R. has a higher ROHE than every ablation"),
        _leads(groups, ONLINE[0], "C.U.R. has more cumulative successes than every ablation"),
    ]


def _leads(groups: Groups, column: Column, statement: str) -> Relation:
    """Is the mean of C.U.R. strictly better than that of every other algorithm?"""
    ours = groups[OURS]
    others = [group for group in groups.values() if group is not ours]
    rival = max(others, key=lambda g: column.better * g.mean(column.metric))
    lead = column.better * (ours.mean(column.metric) - rival.mean(column.metric))
    numbers = f"{ours.text(column)}; best other: {rival.title} {rival.text(column)}"
    spread = float(ours.values(column.metric).std() + rival.values(column.metric).std())
    if min(len(ours.results), len(rival.results)) > 1 and abs(lead) <= spread:
        numbers += "; the standard deviations overlap"
    return Relation(statement, lead > 0, numbers)


def _idle(groups: Groups, name: str) -> Relation:
    """How much of the robots' time after the initial period of C.U.R. was spent idle?"""
    begin = groups[OURS].config["thresholds"]["initial"] or 0
    shares, waits = [], []
    for result in groups[name].results:
        curves, c = result["curves"], result["config"]
        t = np.array(curves["t"])
        k = int(np.searchsorted(t, begin))  # the first recorded timestep at or after the end of the period
        if k >= len(t) - 1:
            continue
        robot_time = c["robots"] * (t[-1] - t[k])
        idle = curves["idle_time"][-1] - curves["idle_time"][k]
        resetting = c["t_reset"] * (curves["hard_resets"][-1] - curves["hard_resets"][k])
        shares.append(idle / robot_time)
        waits.append(max(0.0, idle - resetting) / robot_time)
    share, wait = (float(np.mean(x)) if x else math.nan for x in (shares, waits))
    return Relation(
        f"{name} eliminates idle time after the initial period (below {LITTLE_IDLE:.0%} of robot time)",
        share < LITTLE_IDLE,
        f"{share:.2%} of robot time idle after timestep {begin:,}, of which {wait:.2%} waiting for a human",
    )


def overview(found: dict[str, list[Relation]]) -> str:
    """All relations of all tasks at a glance."""
    statements = list(dict.fromkeys(relation.statement for relations in found.values() for relation in relations))
    rows = []
    for statement in statements:
        verdicts = [next((r.verdict for r in relations if r.statement == statement), "") for relations in found.values()]
        rows.append([statement, *verdicts])
    return markdown(["Statement of the dissertation", *found], rows)


def details(found: Sequence[Relation]) -> str:
    """The relations of a task, with their numbers."""
    return "".join(f"- {relation.statement}: **{relation.verdict}** ({relation.numbers})\n" for relation in found)


# -- figures ----------------------------------------------------------------------------------------------------------------


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


# -- the pages --------------------------------------------------------------------------------------------------------------


NOTE = """Mean ± one standard deviation over seeds (of the seeds themselves, divided by n, as in the dissertation); bold is \
the best mean of a column, which alone does not make it significant. Times are timesteps; idle time is summed over robots, \
human time over humans. ROHE is equation 5.2 with human time in hundreds of timesteps.
"""
MORE_DATA = """Behaviour cloning was given as many more offline pairs as C.U.R. solicited human timesteps on average; they \
do not count as its human time.
"""
DIFFERS = """The published numbers are from another simulator: Isaac Gym's Humanoid, 108 observations, 21 actions, no \
disturbances. Ours is Gymnasium's Humanoid-v5 on MuJoCo, 348 observations, 17 actions, with disturbances. Compare the order \
of the algorithms, not the numbers.
"""


def tables(results: Path) -> str:
    """What stands between the markers of docs/results.md."""
    comparison, ablations = read(results, "comparison"), read(results, "ablations")
    if not comparison and not ablations:
        return f"No results are in `{results.as_posix()}` yet.\n"
    return "\n".join(section for section in _sections(comparison, ablations) if section)


def _sections(comparison: dict[str, Groups], ablations: dict[str, Groups]) -> Iterator[str]:
    tasks = list(dict.fromkeys([*comparison, *ablations]))
    found = {
        task: relations(comparison.get(task, {})) + ablation_relations(ablations.get(task, {}))
        for task in sorted(tasks, key=lambda name: _position(name, TASKS))
    }
    if any(found.values()):
        yield f"### Does it reproduce?\n\n{overview(found)}"
    yield NOTE
    if any("C. (BC)" in groups for groups in comparison.values()):
        yield MORE_DATA
    for task in found:
        if task in comparison:
            groups = comparison[task]
            yield f"### {task}\n\n{setting(groups)}\n"
            picture = figure_name(task, "comparison")
            yield f"![{task}: successes, ROHE, hard resets and idle time over time](images/{picture})\n"
            yield _incomplete(groups)
            yield f"While learning, after T timesteps:\n\n{online_table(groups)}"
            frozen = frozen_table(groups, task)
            if frozen:
                steps = next(r["evaluation"]["steps"] for g in groups.values() for r in g.results if "evaluation" in r)
                yield f"Frozen policies, {steps:,} more timesteps with hard resets only:\n\n{frozen}"
            if task in PUBLISHED:
                yield DIFFERS
            yield details(relations(groups))
        if task in ablations:
            groups = ablations[task]
            yield f"### {task}: ablations of C.U.R.\n\n{setting(groups)}\n"
            yield f"![{task}: ablations of C.U.R. over time](images/{figure_name(task, 'ablations')})\n"
            yield _incomplete(groups)
            yield online_table(groups)
            frozen = frozen_table(groups, "")
            if frozen:
                yield f"Frozen policies with hard resets only:\n\n{frozen}"
            yield details(ablation_relations(groups))


def _incomplete(groups: Groups) -> str:
    """A warning where algorithms were not run with the same seeds."""
    seeds = {group.title: group.seeds for group in groups.values()}
    if len(set(seeds.values())) == 1:
        return ""
    listed = "; ".join(f"{title}: {', '.join(map(str, numbers))}" for title, numbers in seeds.items())
    return f"**The seeds differ between algorithms** ({listed}).\n"


def levels(path: Path) -> str:
    """What stands between the markers of "How the levels were fixed" in docs/tasks.md."""
    if not path.exists():
        return f"`{path.as_posix()}` has not been written yet.\n"
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        rows = [
            _level(task, level)
            for task in sorted(found, key=lambda name: _position(name, TASKS))
            for level in (found[task] if isinstance(found[task], list) else [found[task]])
        ]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RunFolderError(f"{path} is damaged: {error!r}") from None
    head = ["Task", "Level", "Offline pairs", "Expert succeeds", "Behaviour cloning succeeds", "Episodes", "Fits the rule"]
    return markdown(head, rows) + "\nBold: the level of the task, where others were measured too.\n"


def _level(task: str, level: dict[str, Any]) -> list[str]:
    expert, cloned = float(level["expert_success"]), float(level["bc_success"])
    fits = "yes" if expert > RULE[0] and cloned < RULE[1] else "no"
    name = f"**{level['level']}**" if level.get("chosen") else str(level["level"])
    pairs = f"{level['offline_pairs']:,}" if "offline_pairs" in level else ""
    return [task, name, pairs, f"{expert:.0%}", f"{cloned:.0%}", str(level["episodes"]), fits]


def insert(page: str, name: str, content: str) -> str:
    """The page with `content` between the markers of that name.

    Raises:
        TutelageError: the page has no such markers.
    """
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if not pattern.search(page):
        raise TutelageError(f"the page has no markers {begin} and {end}; put them where the {name} shall stand")
    return pattern.sub(lambda _: f"{begin}\n\n{content.strip()}\n\n{end}", page, count=1)


@dataclass(frozen=True)
class TablesConfig:
    """Tables and figures of the documentation, from the committed result files.

    Attributes:
        results: folder of the result files; levels.json lies beside it.
        docs: folder of the documentation.
        check: write nothing; exit with 1 if a page does not say what the files say.
    """

    results: Positional[Path] = Path("results/fleet")
    docs: Path = Path("docs")
    check: bool = False


def run(config: TablesConfig) -> list[Path]:
    """Rewrite the pages and draw the figures; returns the files that were, or with `check` should be, written."""
    parts = {
        config.docs / "results.md": ("tables", tables(config.results)),
        config.docs / "tasks.md": ("levels", levels(config.results.parent / "levels.json")),
    }
    stale = []
    for path, (name, content) in parts.items():
        page = path.read_text(encoding="utf-8")
        wanted = insert(page, name, content)
        if wanted != page:
            stale.append(path)
            if not config.check:
                write_atomic(path, wanted.encode())
    for kind in ("comparison", "ablations"):
        for task, groups in read(config.results, kind).items():
            path = config.docs / "images" / figure_name(task, kind)
            if not config.check:
                plots.save(figure(task, groups), path)
                stale.append(path)
            elif not path.exists():
                stale.append(path)
    return stale


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of `python -m tutelage.experiments.tables`."""
    config = tyro.cli(TablesConfig, args=args, description=__doc__)
    try:
        if not config.check:
            print(tables(config.results))
        stale = run(config)
    except TutelageError as error:
        raise SystemExit(f"tables: {error}") from None
    for path in stale:
        print(f"stale: {path}" if config.check else f"written: {path}")
    if config.check and stale:
        raise SystemExit(f"run: python -m tutelage.experiments.tables {config.results}")


if __name__ == "__main__":
    main()
