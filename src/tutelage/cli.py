"""The command line: verbs only. Each verb is a function or a configuration of the library; `--help` is its documentation."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from tutelage import __version__
from tutelage.console.commands import accounts, audit, study
from tutelage.console.commands.serve import serve
from tutelage.errors import ConfigError, TutelageError
from tutelage.remote import commands as remote
from tutelage.remote.commands import robot
from tutelage.sgc.commands import keys, proxy
from tutelage.sgc.commands.ping import ping
from tutelage.sgc.commands.router import router
from tutelage.sgc.commands.top import top
from tutelage.verbs import parse_verb

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tutelage.experiments.config import ExpertConfig, RunConfig
    from tutelage.experiments.run import Run
    from tutelage.experiments.watch import WatchConfig
    from tutelage.fleet.loop import Loop
    from tutelage.fleet.step import Subscriber

LIGHT = {
    "keys": keys, "router": router, "proxy": proxy, "ping": ping, "top": top,
    "serve": serve, "accounts": accounts, "audit": audit, "study": study, "robot": robot, "fleet": remote,
}  # fmt: skip
"""The verbs that do without the learning libraries, or load them when they run."""

console = Console(markup=False, width=None if sys.stdout.isatty() else 200)
"""Without markup, as names of folders may contain brackets; wide where there is no terminal, so that lines stay lines."""


def run(config: Annotated[RunConfig, arg(name="")], tensorboard: bool = False) -> None:
    """Interactive fleet learning with algorithmic supervisors; leaves a run folder that can be continued.

    Args:
        config: the run.
        tensorboard: write the metrics for TensorBoard too, into the run folder (extra tensorboard).
    """
    from tutelage.experiments.live import TensorBoard
    from tutelage.experiments.progress import stages
    from tutelage.experiments.run import Run

    if tensorboard:
        TensorBoard.writer()  # before minutes of preparation
    with console.status(f"preparing {config.folder}") as status:
        if console.is_terminal:
            prepared = Run.start(config, lambda what, done: status.update(f"{what} {done:.0%}" if done else what))
        else:
            prepared = Run.start(config, stages(lambda line: console.print(line, highlight=False)))
    _go(prepared, tensorboard)


def resume(folder: Positional[Path], tensorboard: bool = False) -> None:
    """Continue a run from its last checkpoint, as if it had never stopped.

    Args:
        folder: the run folder.
        tensorboard: write the metrics for TensorBoard too, into the run folder (extra tensorboard).
    """
    from tutelage.experiments.live import TensorBoard
    from tutelage.experiments.run import Run

    if tensorboard:
        TensorBoard.writer()  # before minutes of preparation
    with console.status(f"loading {folder}"):
        continued = Run.resume(folder)
    if continued.loop.t >= continued.config.steps:
        console.print(f"{folder} is complete at timestep {continued.loop.t}; nothing to do")
        return
    console.print(f"continuing at timestep {continued.loop.t} of {continued.config.steps}")
    _go(continued, tensorboard)


def evaluate(
    folder: Positional[Path],
    steps: int = 10_000,
    priority: str = "C.",
    expert: bool = False,
) -> None:
    """A frozen policy at work, alone or with help (table C.2); writes evaluation.json into the run folder.

    Args:
        folder: the run folder whose policy is evaluated.
        steps: timesteps.
        priority: who gets help: "C." gives hard resets only, "U.C." also teleoperation of uncertain robots; or
            module:callable, a priority of yours.
        expert: evaluate the algorithmic supervisor itself, for reference.
    """
    from tutelage.experiments.evaluate import evaluate_run
    from tutelage.experiments.progress import ProgressDisplay
    from tutelage.experiments.run import read_config
    from tutelage.fleet.tally import Tally

    config = read_config(folder)
    tally = Tally(config.robots, config.humans)
    display = ProgressDisplay(f"evaluating {folder.name}", steps, tally, console)
    result = evaluate_run(folder, steps, priority, expert, tally, [display])
    _print_metrics(result)


def report(runs: Positional[list[Path]], out: Path | None = None) -> None:
    """Curves, tables and one self-contained HTML page of one run, or of many with means and 95 % bands.

    Args:
        runs: run folders; or folders of run folders. Of several, those without a run are passed over.
        out: where the page goes, a file.html or a folder; default: report.html in the only run, or in the folder that holds
            them all.
    """
    from tutelage.experiments.records import load_runs, run_folders
    from tutelage.experiments.report import summary_table, write_report

    if not runs:
        raise ConfigError("name at least one run folder, such as: tutelage report runs/*")
    folders = run_folders(runs, lambda line: console.print(line, highlight=False, soft_wrap=True))
    console.print(summary_table(load_runs(folders)), highlight=False, markup=False, soft_wrap=True)
    page = write_report(folders, out or (runs[0] if len(runs) == 1 else runs[0].parent))
    console.print(f"report: {page}", highlight=False, soft_wrap=True)


def reproduce(
    what: Positional[
        Literal[
            "figure-2.3",
            "figure-A.1",
            "table-3.1",
            "table-3.2",
            "table-3.3",
            "table-8.3",
            "gates",
            "figure-5.3",
            "figure-5.5",
            "figure-5.5-remote",
            "figure-C.1",
            "figure-C.2",
            "figure-C.3",
            "figure-C.4",
        ]
    ],
    tasks: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    full: bool = False,
    workers: int = 4,
    out: Path = Path("runs/reproduce"),
    results: Path | None = None,
) -> None:
    """A figure or table of the dissertation: all algorithms and seeds in parallel, resumable, published beside ours.

    Args:
        what: figure-2.3 (LazyDAgger and its rivals), figure-A.1 (its sensitivity to its thresholds), table-3.1
            (ThriftyDAgger and its rivals on peg insertion), table-3.2 (three robots, a person and a game, with simulated
            people), table-3.3 (on cable routing from images), table-8.3 (a fleet step over the network), gates (all of
            them with 100 robots and 10 humans), figure-5.3 (Fleet-DAgger's comparison, with table C.2),
            figure-5.5 (block pushing with 4 robots and 2 humans, programs here), figure-5.5-remote (the same with scripted
            operators at consoles), figure-C.1 (the ablations of C.U.R.), figure-C.2, figure-C.3, figure-C.4 (C.U.R. with
            other M, t_T, t_R).
        tasks: which tasks; default: those of the figure.
        seeds: root seeds; default: 0 to 4 for figure-2.3, table-3.1 and gates (table-3.3: with --full), 0 to 9 for
            table-3.2, 0 for figure-A.1 and, without --full, figures C.2 to C.4, else 0 to 2.
        full: the published scale; default: one that takes less than an hour on 4 cores.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files; default: results in `out`.
    """
    from tutelage.experiments import reproduction

    text = reproduction.reproduce(what, tasks, seeds, full, workers, out / what, results or out / "results")
    console.print(text, highlight=False, soft_wrap=True)


def train_expert(config: Annotated[ExpertConfig, arg(name="")]) -> None:
    """Train an algorithmic supervisor by PPO; resumable, scored over 100 episodes."""
    from tutelage.experiments.train_expert import train

    train(config, lambda line: console.print(line, highlight=False, soft_wrap=True))


def watch(config: Annotated[WatchConfig, arg(name="")]) -> None:
    """A fleet at work, driven by its algorithmic humans or by a learned policy: a film (GIF, MP4) or a sheet (PNG)."""
    from tutelage.experiments import watch as film

    with console.status(f"drawing {config.path}"):
        path = film.watch(config)
    console.print(f"written: {path}", highlight=False, soft_wrap=True)


def check(
    kind: Positional[Literal["env", "policy", "priority", "supervisor", "driver"]],
    name: Positional[str],
    task: str = "Walker2d",
) -> None:
    """Does a class of yours keep the contract? Names the first broken clause, if any.

    Args:
        kind: what it is.
        name: module:callable that makes it; an env is made as callable(num_envs), a priority gets `thresholds` if it takes
            them, the others are made without arguments. For env also the name of a task, for priority also a string such as
            C.U.R., for driver all that `tutelage robot` takes. A driver's robot moves!
        task: the fleet on which policies, priorities and supervisors are tried.
    """
    if kind == "driver":
        from tutelage.remote.driver import check_driver, make_driver

        check_driver(make_driver(name))
        console.print(f"{name} keeps the contract of a driver", highlight=False)
        return
    from tutelage import checks
    from tutelage.envs.registry import make_fleet
    from tutelage.fleet.priority import own_priority, parse
    from tutelage.objects import make_object

    fleet = make_fleet(name if kind == "env" else task, 4)
    if kind == "env":
        checks.check_env(fleet)
    elif kind == "priority":
        checks.check_priority(own_priority(name) if ":" in name else parse(name), fleet)
    elif kind == "policy":
        checks.check_policy(make_object(name, kind), fleet)
    else:
        checks.check_supervisor(make_object(name, kind), fleet)
    fleet.close()
    console.print(f"{name} keeps the contract of {'an' if kind == 'env' else 'a'} {kind}", highlight=False)


def info(what: Positional[Literal["tasks", "levels", "priorities", "version"]] = "tasks", speed: bool = False) -> None:
    """What there is: tasks with sizes and experts, levels of disturbance, priority functions.

    Args:
        what: which list.
        speed: of the tasks, measure how many timesteps of a robot they make in a second on this machine, with 100 robots.
    """
    if what == "version":
        from tutelage.experiments.run import environment

        console.print(environment().rstrip(), highlight=False)
    elif what == "levels":
        from dataclasses import asdict

        from tutelage.envs.disturbance import LEVELS

        rows = [[name, *(f"{value:g}" for value in asdict(level).values())] for name, level in LEVELS.items()]
        _print_table(["level", *asdict(LEVELS["none"])], rows)
    elif what == "priorities":
        from tutelage.fleet.gates import GATES
        from tutelage.fleet.priority import TERMS, UncertaintyGoal

        terms = {**TERMS, "U.G": UncertaintyGoal}
        rows = [[name, (term.__doc__ or "").split(": ", 1)[-1].splitlines()[0]] for name, term in terms.items()]
        rows += [[name, (gate.__doc__ or "").splitlines()[0]] for name, gate in GATES.items()]
        _print_table(["term", "meaning"], rows)
    else:
        from tutelage.envs.registry import EXTRAS, make_fleet
        from tutelage.envs.tasks import TASKS

        rows = []
        for name, task in TASKS.items():
            fleet = make_fleet(name, 1, threads=1)
            sizes = [str(fleet.single_observation_space.shape[0]), str(len(fleet.action_low)), str(task.horizon)]  # type: ignore[index]
            fleet.close()
            rate = [_speed(name)] if speed else []
            rows.append([name, *sizes, task.disturbance, *_supervisor(name, task.disturbance), *rate, task.summary])
        head = ["task", "obs", "actions", "horizon", "level", "supervisor", "return in calm", "success at level"]
        head += ["steps/s here", "what"] if speed else ["what"]
        _print_table(head, rows)
        for extra, tasks in EXTRAS.items():
            console.print(f"with the extra {extra}: {', '.join(tasks)}")


def _speed(task: str) -> str:
    from tutelage.envs import experts
    from tutelage.envs.registry import make_fleet
    from tutelage.envs.speed import steps_a_second

    fleet = make_fleet(task, 100)
    actor = experts.load(task)[0] if experts.path_of(task).exists() else None
    rate = steps_a_second(fleet, actor)
    fleet.close()
    return f"{rate:,.0f}"


def _supervisor(task: str, level: str) -> list[str]:
    from tutelage.envs import experts

    if not experts.path_of(task).exists():
        return ["none yet", "", ""]
    card = experts.load(task)[1]
    calm, here = card["scores"]["none"], card["scores"].get(level)
    rate = f"{here['success']:.0%} of {here['episodes']}" if here else ""
    if experts.program_of(task):
        return ["program", f"{calm['mean']:.2f}", rate]
    kind = "expert" if experts.is_expert(card) else "short of expert"
    return [kind, f"{calm['mean']:.0f} (published {experts.PUBLISHED[task]:.0f})", rate]


def _go(prepared: Run, tensorboard: bool) -> None:
    """Run with a progress display and plots; Ctrl-C ends it after the present timestep, with nothing lost."""
    from tutelage.experiments.live import LivePlots, TensorBoard
    from tutelage.experiments.progress import ProgressDisplay

    c = prepared.config
    display = ProgressDisplay(f"{c.task} {c.algorithm}", c.steps, prepared.recorder.tally, console)
    listeners: list[Subscriber] = [display, LivePlots(prepared.folder)]
    if tensorboard:
        listeners.append(TensorBoard(prepared.folder, prepared.recorder))
    with _interruptible(prepared.loop):
        metrics = prepared.run(listeners)
    if prepared.loop.t < c.steps:
        console.print(
            f"stopped at timestep {prepared.loop.t}; continue with: tutelage resume {prepared.folder}", soft_wrap=True
        )
    else:
        _print_metrics(metrics)
    console.print(f"run folder: {prepared.folder}   plots: {prepared.folder / 'plots'}", highlight=False, soft_wrap=True)


@contextlib.contextmanager
def _interruptible(loop: Loop) -> Iterator[None]:
    """The first Ctrl-C asks the loop to stop, the second one insists."""

    def ask(number: int, frame: Any) -> None:
        loop.stop_requested = True
        signal.signal(number, signal.default_int_handler)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print_metrics(metrics: dict[str, Any]) -> None:
    def text(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:,.2f}" if value % 1 else f"{value:,.0f}"
        return f"{value:,}" if isinstance(value, int) else str(value)

    _print_table(["metric", "value"], [[name, text(value)] for name, value in metrics.items()])


def _print_table(head: list[str], rows: list[list[str]]) -> None:
    table = Table(box=None, header_style="bold")
    for name in head:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table, highlight=False)


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of `tutelage`: exits with 0, or with 2 and one clear line."""
    arguments = list(sys.argv[1:] if args is None else args)
    if arguments == ["--version"]:
        print(f"tutelage {__version__}")
        return
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # so that module:callable finds a file of the user's in the present folder
    try:
        verbs = LIGHT if arguments[:1] and arguments[0] in LIGHT else _learning_verbs() | LIGHT
        parse_verb(verbs, arguments)()
        sys.stdout.flush()
    except TutelageError as error:
        print(f"tutelage: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "can't allocate memory" not in str(error):  # PyTorch's own kind
            raise
        reason = (str(error).splitlines() or ["no more is left"])[0]
        print(f"tutelage: not enough memory: {reason}; choose fewer robots, smaller networks or less data", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("tutelage: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # the reader of our output, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None


def _learning_verbs() -> dict[str, Any]:
    """The verbs that need PyTorch, which takes seconds and memory that a router or robot may not have."""
    from tutelage.experiments import config
    from tutelage.experiments import watch as film

    # The parser looks up annotations among this module's names.
    globals().update(RunConfig=config.RunConfig, ExpertConfig=config.ExpertConfig, WatchConfig=film.WatchConfig)
    return {
        "run": run,
        "resume": resume,
        "evaluate": evaluate,
        "report": report,
        "reproduce": reproduce,
        "train-expert": train_expert,
        "watch": watch,
        "check": check,
        "info": info,
    }
