"""The tables and figures of docs/results.md, made from the small result files that `tutelage.experiments.study` wrote.

    python -m tutelage.experiments.tables results/fleet            # print, rewrite the page, draw docs/images/
    python -m tutelage.experiments.tables results/fleet --check    # exit 1 if the page does not say what the files say

Only what stands between `<!-- begin: NAME -->` and `<!-- end: NAME -->` is rewritten: `tables` in results.md, and `levels`
in tasks.md from results/levels.json, and each of results/single/ in results-single.md under the name of its folder.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import Positional

from tutelage.envs.tasks import TASKS
from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments import (
    figure_2_3,
    figure_5_5,
    figure_a_1,
    gates_table,
    plots,
    sweeps,
    table_3,
    table_3_2,
    table_8_3,
)
from tutelage.experiments.figures import figure, figure_name
from tutelage.experiments.jobs import read_results
from tutelage.experiments.levels import suits
from tutelage.experiments.relations import Relation, ablation_relations, relations
from tutelage.experiments.results import FROZEN, ONLINE, OURS, Column, Groups, in_order, read
from tutelage.store import write_atomic

PUBLISHED: dict[str, dict[str, tuple[str, str, str]]] = {
    "Humanoid": {
        "C. (BC)": ("0.0 ± 0.0", "11,925.3 ± 118.8", "62,473.7 ± 869.1"),
        "Random": ("746.3 ± 40.5", "340.0 ± 59.2", "1,700.0 ± 296.1"),
        "U.C.": ("617.7 ± 66.3", "570.3 ± 139.0", "2,851.7 ± 694.8"),
        "C.U.R.": ("771.0 ± 25.5", "289.3 ± 21.1", "1,446.7 ± 105.3"),
        "Expert": ("894", "115", "575"),
    },
    "Anymal": {
        "C. (BC)": ("32.7 ± 0.5", "1,134.3 ± 33.9", "5,669.7 ± 170.0"),
        "Random": ("207.3 ± 27.2", "232.3 ± 89.6", "1,162.3 ± 449.1"),
        "U.C.": ("257.3 ± 1.2", "109.0 ± 16.9", "545.0 ± 84.4"),
        "C.U.R.": ("257.0 ± 8.8", "64.3 ± 8.6", "321.7 ± 42.9"),
        "Expert": ("293", "1", "5"),
    },
    "AllegroHand": {
        "C. (BC)": ("70.0 ± 5.0", "523.0 ± 9.4", "2,614.3 ± 46.4"),
        "Random": ("7,360.3 ± 231.0", "2,954.3 ± 131.0", "14,767.7 ± 653.2"),
        "U.C.": ("3,032.0 ± 191.2", "1,764.7 ± 225.4", "8,818.0 ± 1,129.7"),
        "U.G.C.": ("4,296.3 ± 161.7", "1,397.7 ± 112.6", "6,988.0 ± 562.9"),
        "C.U.R.": ("6,032.7 ± 236.2", "2,343.7 ± 82.5", "11,715.0 ± 411.9"),
        "Expert": ("21,609", "1,202", "6,013"),
    },
}
"""Table C.2 of the dissertation: successes, hard resets and idle time of the frozen policies."""
SINGLE: dict[str, Callable[[list[dict[str, Any]]], str]] = {
    "figure-2.3": figure_2_3.table,
    "figure-A.1": figure_a_1.table,
    **{name: functools.partial(table_3.table, name) for name in table_3.SETTINGS},
    "gates": gates_table.table,
    **{name: functools.partial(sweeps.table, name) for name in sweeps.SWEEPS},
}
"""What results/single/ holds and docs/results-single.md shows, and how."""
PEOPLE: dict[str, Callable[[list[dict[str, Any]]], str]] = {
    "table-3.2": table_3_2.table,
    "figure-5.5-remote": figure_5_5.table,
    "table-8.3": table_8_3.table,
}
"""Likewise docs/results-people.md."""


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


# -- the pages --------------------------------------------------------------------------------------------------------------


NOTE = """Mean ± one standard deviation over seeds (of the seeds themselves, divided by n, as in the dissertation); bold is \
the best mean of a column, which alone does not make it significant. Times are timesteps; idle time is summed over robots, \
human time over humans. ROHE is equation 5.2 with human time in hundreds of timesteps.
"""
MORE_DATA = """Behaviour cloning was given as many more offline pairs as C.U.R. solicited human timesteps on average; they \
do not count as its human time.
"""
DIFFERS = {
    "Humanoid": """The published numbers are from another simulator: Isaac Gym's Humanoid, 108 observations, 21 actions, no \
disturbances. Ours is Gymnasium's Humanoid-v5 on MuJoCo, 348 observations, 17 actions, with disturbances. Compare the order \
of the algorithms, not the numbers.
""",
    "Anymal": """The published numbers are from another simulator: Isaac Gym's Anymal, under a policy trained by PPO, \
without disturbances. Ours is a model of our own on MuJoCo, under a program that trots, with disturbances; see [what \
differs](tasks.md#anymal). Compare the order of the algorithms, not the numbers.
""",
    "AllegroHand": """The published numbers are from another simulator: Isaac Gym's AllegroHand with goals turned any \
way, under a policy trained by PPO, without disturbances. Ours is a model of our own on MuJoCo with goals about the \
vertical, see [what differs](tasks.md#allegro-hand). Compare the order of the algorithms, not the numbers.
""",
}
"""Why they are not to be compared number by number."""


def tables(results: Path) -> str:
    """What stands between the markers of docs/results.md."""
    comparison, ablations = read(results, "comparison"), read(results, "ablations")
    if not comparison and not ablations:
        return f"No results are in `{results.as_posix()}` yet.\n"
    return "\n".join(section for section in _sections(comparison, ablations) if section)


def _sections(comparison: dict[str, Groups], ablations: dict[str, Groups]) -> Iterator[str]:
    found = {
        task: relations(comparison.get(task, {})) + ablation_relations(ablations.get(task, {}))
        for task in in_order({*comparison, *ablations}, TASKS)
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
            if task in DIFFERS:
                yield DIFFERS[task]
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
        rows = [_level(task, level) for task in in_order(found, TASKS) for level in found[task]]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise RunFolderError(f"{path} is damaged: {error!r}") from None
    head = ["Task", "Level", "Offline pairs", "Expert succeeds", "Behaviour cloning succeeds", "Episodes", "Fits the rule"]
    return markdown(head, rows) + "\nBold: the level of the task, where others were measured too.\n"


def _level(task: str, level: dict[str, Any]) -> list[str]:
    expert, cloned = float(level["expert_success"]), float(level["bc_success"])
    fits = "yes" if suits(expert, cloned) else "no"
    name = f"**{level['level']}**" if level.get("chosen") else str(level["level"])
    pairs = f"{level['offline_pairs']:,}" if "offline_pairs" in level else ""
    task = f"{task}, from images" if level.get("observation") == "images" else task
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
    found = {name: read_results(config.results.parent / "single" / name) for name in (*SINGLE, *PEOPLE)}
    pages: dict[str, dict[str, str]] = {
        "results.md": {"tables": tables(config.results)},
        "tasks.md": {"levels": levels(config.results.parent / "levels.json")},
        "results-single.md": {name: make(found[name]) for name, make in SINGLE.items() if found[name]},
        "results-people.md": {name: make(found[name]) for name, make in PEOPLE.items() if found[name]},
    }
    stale = []
    for file, parts in pages.items():
        path = config.docs / file
        if not parts:
            continue
        page = path.read_text(encoding="utf-8")
        wanted = functools.reduce(lambda text, part: insert(text, *part), parts.items(), page)
        if wanted != page:
            stale.append(path)
            if not config.check:
                write_atomic(path, wanted.encode())
    draw = {
        figure_name(task, kind): functools.partial(figure, task, groups)
        for kind in ("comparison", "ablations")
        for task, groups in read(config.results, kind).items()
    }
    for name, paint in (("figure-2.3", figure_2_3.figure), ("figure-A.1", figure_a_1.figure)):
        if found[name]:
            draw[f"{name}.png"] = functools.partial(paint, found[name])
    for name, make in draw.items():
        path = config.docs / "images" / name
        if not config.check:
            plots.save(make(), path)
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
