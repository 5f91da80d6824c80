"""Table 3.2 of a study with people, and what they answered (figure B.1, right)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tutelage.console.study_parts import read_result
from tutelage.errors import ConfigError
from tutelage.experiments import table_3_2
from tutelage.experiments.user_study.protocol import CONDITIONS, QUESTIONS, SCALE

THRIFTY = "ThriftyDAgger"


def study_table(folder: Path) -> str:
    """Markdown. Only participants who went through all conditions count.

    Raises:
        ConfigError: there is none, or a result is damaged.
    """
    by_participant: dict[int, list[dict[str, Any]]] = {}
    for path in sorted((folder / "results").glob("*.json")):
        result = read_result(path)
        by_participant.setdefault(int(result["seed"]), []).append(result)
    complete = {p: results for p, results in by_participant.items() if len(results) == len(CONDITIONS)}
    if not folder.is_dir():
        raise ConfigError(f"there is no folder {folder}; give the one that `tutelage study run` wrote (--out)")
    if not complete:
        raise ConfigError(f"no participant of {folder} went through all conditions yet: tutelage study run --help")
    results = [result for p in sorted(complete) for result in complete[p]]
    text = table_3_2.table(results, "participants")
    answered = [p for p in sorted(complete) if all("answers" in result for result in complete[p])]
    return text + ("\n" + _answers([r for p in answered for r in complete[p]], len(answered)) if answered else "")


def _answers(results: list[dict[str, Any]], people: int) -> str:
    of = {a: {int(r["seed"]): r["answers"] for r in results if r["algorithm"] == a} for a in CONDITIONS}
    lines = [
        f"NASA-TLX, {people} participants, from {SCALE[0]} (very low) to {SCALE[1]} (very high). Mean ± standard deviation; "
        f"p of the exact sign-flip test against {THRIFTY}.",
        "",
        f"| Algorithm | {' | '.join(name.replace('_', ' ').capitalize() for name in QUESTIONS)} |",
        "| --- |" + " ---: |" * len(QUESTIONS),
    ]
    for algorithm, answers in of.items():
        cells = []
        for name in QUESTIONS:
            values = np.array([answers[p][name] for p in sorted(answers)], dtype=np.float64)
            spread = values.std(ddof=1) if len(values) > 1 else 0.0
            cell = f"{values.mean():.1f} ± {spread:.1f}"
            if algorithm != THRIFTY:
                thrifty = np.array([of[THRIFTY][p][name] for p in sorted(answers)], dtype=np.float64)
                cell += f" (p = {table_3_2.sign_flip_test(values - thrifty):.3f})"
            cells.append(cell)
        lines.append(f"| {algorithm} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
