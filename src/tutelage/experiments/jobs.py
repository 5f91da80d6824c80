"""Many runs side by side, one core each, every one continued where it was interrupted."""

from __future__ import annotations

import json
import multiprocessing
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments.config import RunConfig, to_json
from tutelage.experiments.run import Run
from tutelage.store import write_atomic


@dataclass(frozen=True)
class Job:
    """One run and its small result file.

    Attributes:
        title: what it is called in messages.
        work: a function of a module, called with `arguments` in a process of its own; returns the result, JSON values.
        arguments: its arguments.
        file: where the result is written.
        summary: one line about a result.
    """

    title: str
    work: Callable[..., dict[str, Any]]
    arguments: tuple[Any, ...]
    file: Path
    summary: Callable[[dict[str, Any]], str]


def run_jobs(jobs: Sequence[Job], workers: int) -> list[dict[str, Any]]:
    """Do all jobs, `workers` at a time; results in the order of the jobs, each written to its file once it is there.

    Raises:
        TutelageError: a job failed. It was printed with its traceback, and the others were still done and written.
    """
    results: dict[int, dict[str, Any]] = {}
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        pending = {pool.submit(job.work, *job.arguments): k for k, job in enumerate(jobs)}
        for future in as_completed(pending):
            k = pending[future]
            done = f"[{len(results) + 1}/{len(jobs)}] {jobs[k].title}"
            try:
                results[k] = future.result()
            except Exception:  # whatever stopped one must not stop the others
                print(f"{jobs[k].title} FAILED\n{traceback.format_exc()}", flush=True)
                continue
            write_atomic(jobs[k].file, (json.dumps(results[k], indent=1) + "\n").encode())
            print(f"{done}: {jobs[k].summary(results[k])}", flush=True)
    failed = [job.title for k, job in enumerate(jobs) if k not in results]
    if failed:
        raise TutelageError(
            f"{len(failed)} runs failed (see above): {', '.join(failed)}; mend them, then start again: the others are kept"
        )
    return [results[k] for k in range(len(jobs))]


def read_results(folder: Path) -> list[dict[str, Any]]:
    """The small result files below a folder, in the order of their names.

    Raises:
        RunFolderError: a damaged file.
    """
    results = []
    for path in sorted(folder.rglob("*.json")):
        try:
            results.append(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise RunFolderError(f"the result file {path} is damaged: {error}") from None
    return results


def start_or_resume(config: RunConfig) -> Run:
    """The run of a configuration: a new one, or the one in its folder.

    Raises:
        RunFolderError: the folder holds a run with other settings.
    """
    folder = config.folder
    run = Run.resume(folder) if (folder / "config.json").exists() else Run.start(config)
    _check_same(to_json(config), to_json(run.config), folder)
    return run


def resolved(run: Run) -> dict[str, Any]:
    """The configuration of a run without what changes no result."""
    config = to_json(run.config)
    return {name: value for name, value in config.items() if name not in ("out", "threads", "torch_threads", "record")}


def slug(name: str) -> str:
    """A name as part of a file name."""
    return "".join(ch for ch in name.lower().replace("(-i)", "-no-initial") if ch.isalnum() or ch == "-")


def _check_same(wanted: dict[str, Any], found: dict[str, Any], folder: Path) -> None:
    """Refuse a run of the same name with other settings; what is None in `wanted` is for the run to resolve."""
    for name, value in wanted.items():
        if isinstance(value, dict):
            _check_same(value, found[name], folder)
        elif value is not None and value != found[name]:
            raise RunFolderError(
                f"{folder} was run with {name} {found[name]}, not {value}; delete it to run it again, or choose --out"
            )
