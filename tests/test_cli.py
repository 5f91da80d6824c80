"""The command line: every verb works and documents itself; every mistake is one clear line and exit code 2."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from small import FLAGS, Worry, assert_same, points, walker

import tutelage
from tutelage import cli
from tutelage.envs.registry import ON_EXTRAS
from tutelage.envs.tasks import TASKS
from tutelage.experiments.config import RunConfig
from tutelage.experiments.recording import lock
from tutelage.experiments.run import Run
from tutelage.experiments.train_expert import ExpertConfig
from tutelage.fleet.gates import GATES
from tutelage.policies.expert import GaussianActor

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")

VERBS = ("run", "resume", "evaluate", "report", "reproduce", "train-expert", "watch", "check", "info")
POINTS = [*FLAGS[FLAGS.index("--steps") :], "--robots", "6", "--humans", "2", "--expert", "small:Homing"]
POINTS[POINTS.index("--threads") : POINTS.index("--threads") + 2] = []
POINTS[POINTS.index("--offline-pairs") + 1] = "100"


class Said(Exception):
    """What the command line said, and its exit code."""

    def __init__(self, code: Any, out: str, err: str) -> None:
        super().__init__(err)
        self.code, self.out, self.err = code, out, err


@pytest.fixture
def tut(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Said]:
    """Run the command line here."""
    monkeypatch.setenv("COLUMNS", "90")  # of help: one column of boxes
    capsys.readouterr()

    def call(*args: Any) -> Said:
        code: Any = 0
        try:
            cli.main([str(arg) for arg in args])
        except SystemExit as end:
            code = end.code
        return Said(code, *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that ended."""
    run = Run.start(walker(tmp_path_factory.mktemp("run") / "run"))
    run.run()
    return run.folder


# -- it works -------------------------------------------------------------------------------------------------------


def test_run_from_another_process_is_the_run_from_python(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    command = [sys.executable, "-c", "from tutelage.cli import main; main()", "run", "Walker2d", *FLAGS]
    done = subprocess.run(
        [*command, "--out", "again"],
        cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    while lines[0].startswith("preparing: "):
        lines.pop(0)
    assert done.stdout.startswith("preparing: recording demonstrations\n")
    assert re.fullmatch(
        r"Walker2d C\.U\.R\.  3/30  \d+ steps/s  successes 0  ROHE 0\.00  falls \d+  humans busy \d/2", lines[0]
    )
    assert lines[-1] == "run folder: again   plots: again/plots"
    assert re.search(r"^ human_time +\d+ *$", done.stdout, re.MULTILINE)
    assert_same(folder, tmp_path / "again")
    assert (tmp_path / "again" / "plots" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_with_a_fleet_of_ones_own(tut: Callable[..., Said], tmp_path: Path) -> None:
    said = tut("run", "small:point_fleet", *POINTS, "--out", tmp_path / "run", "--label", "mine [a]")
    assert (said.code, said.err) == (0, "")
    assert "mine [a]  30/30" in said.out
    said = tut("resume", tmp_path / "run")
    assert said.out == f"{tmp_path / 'run'} is complete at timestep 30; nothing to do\n"


def test_a_run_with_threads_for_a_fleet_that_takes_none(tut: Callable[..., Said], tmp_path: Path) -> None:
    said = tut("run", "small:point_fleet", *POINTS, "--threads", 2, "--out", tmp_path / "run")
    assert (said.code, said.err) == (0, "")


def test_a_run_with_a_priority_of_ones_own(tut: Callable[..., Said], tmp_path: Path) -> None:
    said = tut("run", "small:point_fleet", *POINTS, "--priority", "small:Worry", "--out", tmp_path / "run")
    assert (said.code, said.err) == (0, "")
    assert "small:Worry  30/30" in said.out
    said = tut("evaluate", tmp_path / "run", "--steps", 20, "--priority", "small:Worry")
    assert (said.code, said.err) == (0, "")
    pytest.importorskip("matplotlib")
    assert "small:Worry" in tut("report", tmp_path / "run").out


def test_evaluate(tut: Callable[..., Said], folder: Path) -> None:
    said = tut("evaluate", folder, "--steps", 20)
    assert (said.code, said.err) == (0, "")
    assert "evaluating run  20/20" in said.out
    assert re.search(r"^ policy +run *$", said.out, re.MULTILINE)
    assert json.loads((folder / "evaluation.json").read_text())["steps"] == 20
    said = tut("evaluate", folder, "--steps", 20, "--expert")
    assert re.search(r"^ policy +expert *$", said.out, re.MULTILINE)


def test_report(tut: Callable[..., Said], folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    said = tut("report", folder, "--out", tmp_path)
    assert (said.code, said.err) == (0, "")
    assert said.out.splitlines()[-1] == f"report: {tmp_path / 'report.html'}"
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")
    assert "C.U.R." in said.out


def test_a_report_on_all_that_is_there(tut: Callable[..., Said], folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    shutil.copytree(folder, tmp_path / "runs" / "a")
    shutil.copytree(folder, tmp_path / "runs" / "b")
    first = tut("report", *(tmp_path / "runs").iterdir())
    assert first.out.splitlines()[-1] == f"report: {tmp_path / 'runs' / 'report.html'}"
    again = tut("report", *sorted((tmp_path / "runs").iterdir()))  # with the plots and the page of the first one
    assert again.out == first.out
    whole = tut("report", tmp_path / "runs", "--out", tmp_path / "elsewhere")
    assert whole.out.splitlines()[:-1] == first.out.splitlines()[:-1]
    assert whole.out.splitlines()[-1] == f"report: {tmp_path / 'elsewhere' / 'report.html'}"


def test_a_film_of_a_policy_for_another_task_is_refused(tut: Callable[..., Said], folder: Path) -> None:
    assert refused(tut("watch", "Navigation", "--run", folder)) == f"{folder} is a run of Walker2d, not of Navigation"


def test_info(tut: Callable[..., Said], monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = tut("info").out
    assert tasks == tut("info", "tasks").out
    assert re.search(r"^ Walker2d +17 +6 +1000 +moderate +expert +\d+ \(published 3492\) +\d+% of 100 ", tasks, re.MULTILINE)
    *listed, robosuite, envpool = tasks.splitlines()[1:]
    assert [line.split()[0] for line in listed] == [*TASKS]
    assert robosuite == "with the extra robosuite: NutAssemblyRound"
    assert envpool == "with the extra envpool: Go1Joystick, SpotJoystick, LeapCubeReorient, PandaPickCube"
    monkeypatch.setattr(cli, "_speed", lambda task: "12,345")
    measured = tut("info", "tasks", "--speed").out
    assert re.search(r"steps/s here +what *$", measured.splitlines()[0])
    assert all(" 12,345 " in line for line in measured.splitlines() if line.split()[0] in TASKS)
    levels = tut("info", "levels").out
    assert [line.split()[0] for line in levels.splitlines()] == [
        "level", "none", "mild", "light", "moderate", "strong", "severe", "extreme",
    ]  # fmt: skip
    priorities = tut("info", "priorities").out
    assert [line.split()[0] for line in priorities.splitlines()] == ["term", "C", "U", "R", "G", "Random", "U.G", *GATES]
    assert "1 for robots in violation, 0 for the others" in priorities
    version = tut("info", "version").out
    assert f"tutelage {tutelage.__version__}" in version
    assert re.search(r"^mujoco \d", version, re.MULTILINE)


def test_version(tut: Callable[..., Said]) -> None:
    said = tut("--version")
    assert (said.code, said.out, said.err) == (0, f"tutelage {tutelage.__version__}\n", "")


class Undecided:
    """Neither a policy nor a supervisor."""


class Curious(Worry):
    needs = ("risk", "gossip")  # type: ignore[assignment]


class Teacher:
    def act(self, obs: Any, robots: Any) -> Any:
        return np.zeros((len(obs), 6), dtype=np.float32)


class Standing:
    def act(self, obs: Any) -> Any:
        return np.zeros((len(obs), 6), dtype=np.float32)


@pytest.mark.parametrize(
    ("kind", "name", "out"),
    [
        ("env", "Walker2d", "Walker2d keeps the contract of an env\n"),
        ("priority", "C.U.R.", "C.U.R. keeps the contract of a priority\n"),
        ("priority", "small:Worry", "small:Worry keeps the contract of a priority\n"),
        ("policy", "test_cli:Standing", "test_cli:Standing keeps the contract of a policy\n"),
        ("supervisor", "test_cli:Teacher", "test_cli:Teacher keeps the contract of a supervisor\n"),
    ],
)
def test_check_of_what_keeps_its_contract(tut: Callable[..., Said], kind: str, name: str, out: str) -> None:
    said = tut("check", kind, name)
    assert (said.code, said.out, said.err) == (0, out, "")


# -- help -----------------------------------------------------------------------------------------------------------


def flags(cls: Any, prefix: str = "") -> set[str]:
    names = set()
    for field in dataclasses.fields(cls):
        default = field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default
        if dataclasses.is_dataclass(default):
            names |= flags(type(default), f"{prefix}{field.name}.")
        elif field.name != "task":
            names.add("--" + prefix.replace("_", "-") + field.name.replace("_", "-"))
    return names


def described(out: str) -> dict[str, str]:
    """What help says of each option, on one line."""
    parts = re.split(r"^ *(--?[a-z][\w.-]*)(?=[ ,])", re.sub(r"[│╭╰─╮╯]", " ", out), flags=re.MULTILINE)[1:]
    return {name: " ".join(body.split()) for name, body in zip(parts[::2], parts[1::2], strict=True)}


@pytest.mark.parametrize("verb", VERBS)
def test_help_says_what_every_flag_is_for(tut: Callable[..., Said], verb: str) -> None:
    said = tut(verb, "--help")
    assert (said.code, said.err) == (0, "")
    found = described(said.out)
    for name, body in found.items():
        text = re.sub(r"^(, --[\w-]+)*( ?(\{[^}]*\}\|?)?[A-Z\[\] .]*)", "", body)
        assert re.split(r"\(default:|\(optional\)", text)[0].strip() or re.match(r"INT [NM]\. ", body), (name, body)
    expected = {"run": flags(RunConfig), "train-expert": flags(ExpertConfig)}.get(verb, set())
    assert expected <= set(found), expected - set(found)


def commands(verbs: Mapping[str, Any], *before: str) -> Iterator[tuple[str, ...]]:
    """Every command, with those of groups."""
    for name, verb in verbs.items():
        if isinstance(verb, ModuleType):
            yield from commands(verb.VERBS, *before, name)
        else:
            yield *before, name


@pytest.mark.parametrize("command", [*commands(dict.fromkeys(VERBS) | cli.LIGHT)], ids=" ".join)
def test_no_help_shows_a_default_that_is_none_or_nothing(tut: Callable[..., Said], command: tuple[str, ...]) -> None:
    said = tut(*command, "--help")
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("usage: tutelage " + " ".join(command))
    assert "None" not in said.out
    assert not [name for name, body in described(said.out).items() if "(default: )" in body]


def test_an_option_that_may_be_left_out_says_so_and_what_happens_then(tut: Callable[..., Said]) -> None:
    run, report = described(tut("run", "--help").out), described(tut("report", "--help").out)
    assert run["--thresholds.risk"] == "FLOAT r-hat, likewise; default: from `risk_quantile`, or from `missed`. (optional)"
    assert run["--threads"].endswith("default: one a core. (optional)")
    assert run["--robots"] == "INT N. (default: 100)"
    assert report["--out"].endswith("in the folder that holds them all. (optional)")


def test_help_of_the_whole_lists_the_verbs_with_a_line_each(tut: Callable[..., Said]) -> None:
    out = re.sub(r"[│╭╰─╮╯]", " ", tut("--help").out)
    for verb in VERBS:
        assert re.search(rf"^ *• {verb} +\w+.* \w+", out, re.MULTILINE), verb


# -- mistakes -------------------------------------------------------------------------------------------------------


def refused(said: Said) -> str:
    """The one line that a mistake gives."""
    assert said.code == 2
    assert "Traceback" not in said.err
    assert said.err.startswith("tutelage: ")
    assert said.err.count("\n") == 1
    return said.err.removeprefix("tutelage: ").rstrip("\n")


@pytest.mark.parametrize(
    ("args", "needle"),
    [
        (["run", "Walker2d", "--bogus", "3"], "Unrecognized options: --bogus"),
        (["run", "Walker2d", "--robot", "3"], "Unrecognized options: --robot, 3 (did you mean --robots?)"),
        (["run", "Walker2d", "--step", "3"], "(did you mean --steps?)"),
        (["run", "Walker2d", "--seeds", "3"], "Unrecognized options: --seeds 3 (did you mean --seed?) (see"),
        (["rnu", "Walker2d"], "unknown command 'rnu' (did you mean run?); commands: run, resume, evaluate, "),
        (["keys", "reveal"], "unknown command 'reveal' (did you mean revoke?); commands: init, issue, renew, "),
        ([], "no command given; commands: run, resume, evaluate, report, reproduce, train-expert, watch, check, info"),
        (["run"], "name of a task (see `tutelage info tasks`)"),
        (["resume"], "the run folder. (required)"),
        (["run", "Walker2d", "--steps", "many"], "Error parsing --steps: invalid literal for int() with base 10: 'many'"),
        (["run", "Walker2d", "--threads", "None"], "Error parsing --threads: "),
        (["run", "Walker2d", "--learner.schedule", "weekly"], "--learner.schedule"),
        (["info", "bogus"], "Expected one of ('tasks', 'levels', 'priorities', 'version')"),
        (["check", "robot", "x"], "Expected one of ('env', 'policy', 'priority', 'supervisor', 'driver')"),
    ],
)
def test_what_cannot_be_parsed_is_one_line_that_names_it(
    tut: Callable[..., Said], args: list[str], needle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = tut(*args)
    assert said.out == ""
    line = refused(said)
    assert needle in line
    assert re.search(r"see tutelage( \w+)? --help", line)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (
            ["run", "Walkr2d"],
            f"unknown task 'Walkr2d' (did you mean Walker2d?); tasks: {', '.join([*TASKS, *ON_EXTRAS])}, "
            "or your own as module:callable",
        ),
        (
            ["run", "Pendulum-v1"],
            "unknown task 'Pendulum-v1', which looks like an environment of Gymnasium: see `GymnasiumFleet` in "
            "docs/extending.md; tasks: *",
        ),
        (
            ["run", "small:point_fleet"],
            "small:point_fleet has no expert: give what makes it an attribute `expert`, or name one: "
            "tutelage run --expert module:callable",
        ),
        (["run", "nowhere:make"], "task 'nowhere:make': no module 'nowhere'; install it, or run where Python finds it"),
        (
            ["run", "Walker2d", "--robots", "2", "--humans", "3"],
            "3 humans for 2 robots: use at most one human a robot (M <= N)",
        ),
        (["run", "Walker2d", "--t-teleop", "0"], "t_teleop must be at least 1, got 0"),
        (
            ["run", "Walker2d", "--priority", "U.G.C."],
            "U.G.C. needs a task with a goal, and Walker2d has none; use C.U.R. or U.C.",
        ),
        (["run", "Walker2d", "--thresholds.uncertainty", "nan"], "threshold uncertainty must be a finite number, got nan"),
        (["run", "Walker2d", "--thresholds.risk-quantile", "1.5"], "risk_quantile must be between 0 and 1, got 1.5"),
        (
            ["run", "Walker2d", "--priority", "C.X."],
            "cannot read the priority 'C.X.': use different terms of C, U, R, G, Random with dots, such as C.U.R., *",
        ),
        (
            ["run", "Walker2d", "--disturbance", "awful"],
            "unknown disturbance 'awful'; use one of none, mild, light, moderate, strong, severe, extreme, or name=value "
            "with names noise, push, push_seconds, push_interval, mass, friction, wind",
        ),
        (["run", "Walker2d", "--disturbance", "push=nan"], "disturbance push must be a number >= 0, got nan"),
        (["run", "Walker2d", "--hidden", "0"], "hidden layers must be at least 1 wide, got (0,)"),
        (["run", "Walker2d", "--expert", "lost"], "no expert at lost; train one with: tutelage train-expert Walker2d"),
        (["run", "Walker2d", "--expert", "ant"], "ant is a controller for Ant, not for Walker2d"),
        (
            ["run", "Walker2d", "--expert", "wide"],
            "the expert wide sees 40 numbers and gives 6 actions, but Walker2d shows 17 and takes 6; "
            "train one with: tutelage train-expert Walker2d",
        ),
        (
            ["run", "Walker2d", "--expert", "garbage"],
            "garbage is damaged or not a Tutelage file: Error while deserializing header: *",
        ),
        (["run", "Walker2d", "--expert", "empty"], "empty is damaged or not a Tutelage file: *"),
        (["run", "Walker2d", "--out", "garbage"], "cannot write to garbage: File exists; choose another folder"),
        (["resume", "lost"], "lost holds no run (no config.json); start one with: tutelage run"),
        (["resume", "."], ". holds no run (no config.json); start one with: tutelage run"),
        (["resume", "garbage"], "garbage holds no run (no config.json); start one with: tutelage run"),
        (
            ["run", "Walker2d", "--robots", "1000000000000"],
            "not enough memory: Unable to allocate *",
        ),
        (["evaluate", "lost"], "lost holds no run (no config.json); start one with: tutelage run"),
        (["report", "lost"], "lost is not a run folder: no such folder; give a folder that `tutelage run` wrote"),
        (["report", "."], ". is not a run folder: it has no config.json; give a folder that `tutelage run` wrote"),
        (["watch", "Navigation", "--run", "lost"], "lost holds no run (no config.json); start one with: tutelage run"),
        (["report"], "name at least one run folder, such as: tutelage report runs/*"),
        (["reproduce", "figure-5.3", "--tasks", "Nope"], "unknown task 'Nope'; known tasks: *"),
        (
            ["reproduce", "figure-2.3", "--tasks", "Humanoid"],
            "figure 2.3 has the tasks HalfCheetah, Walker2d, Ant; got Humanoid",
        ),
        (["reproduce", "figure-2.3", "--workers", "0"], "workers must be at least 1, got 0"),
        (["train-expert", "Nope"], f"unknown task 'Nope'; known tasks: {', '.join(TASKS)}"),
        (
            ["train-expert", "Navigation"],
            "the expert of Navigation is a program, tutelage.envs.experts.navigation:team: nothing to train",
        ),
        (["watch", "Navigation", "--out", "x.jpg"], "cannot write x.jpg: a film is .gif or .mp4, a sheet .png"),
        (["watch", "Navigation", "--robots", "0"], "robots must be at least 1, got 0"),
        (["train-expert", "Walker2d", "--steps", "0"], "steps must be at least 1, got 0"),
        (
            ["train-expert", "Walker2d", "--ppo.rollout", "0"],
            "PPO needs rollout, epochs, minibatch and hidden widths of at least 1",
        ),
        (["check", "env", "Wlker2d"], "unknown task 'Wlker2d' (did you mean Walker2d?); tasks: *"),
        (["check", "policy", "test_cli"], "policy 'test_cli': write module:callable, such as my_package.robots:make_fleet"),
        (["check", "policy", "test_cli:Undecided"], "Undecided is no policy; it needs act(obs)"),
        (["check", "supervisor", "test_cli:Undecided"], "Undecided is no supervisor; it needs act(obs, robots)"),
        (
            ["run", "Walker2d", "--priority", "nowhere:Mine"],
            "priority 'nowhere:Mine': no module 'nowhere'; install it, or run where Python finds it",
        ),
        (["run", "Walker2d", "--priority", "small:Mine"], "priority 'small:Mine': module 'small' has no callable 'Mine'"),
        (["run", "Walker2d", "--priority", "small:FLAGS"], "priority 'small:FLAGS': module 'small' has no callable 'FLAGS'"),
        (["run", "Walker2d", "--priority", "test_cli:Standing"], "priority 'test_cli:Standing' must return a priority, *"),
        (
            ["run", "Walker2d", "--priority", "test_cli:Curious"],
            "test_cli:Curious needs the signal gossip, and a run has uncertainty, risk, goal, predicted_discrepancy and "
            "judgement; others go into a Loop of yours",
        ),
        (["check", "priority", "test_cli:Undecided"], "priority 'test_cli:Undecided' must return a priority, *"),
        (["check", "policy", "small:point_fleet"], "policy 'small:point_fleet' cannot be made: missing a required *"),
        (["check", "priority", "Z."], "cannot read the priority 'Z.': use different terms of *"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_that_says_what_to_do(
    tut: Callable[..., Said], args: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    low, high = np.full(6, -1.0), np.full(6, 1.0)
    GaussianActor(10, low, high, (4,)).save(Path("ant"), {"task": "Ant"})
    GaussianActor(40, low, high, (4,)).save(Path("wide"), {"task": "Walker2d"})
    Path("garbage").write_bytes(b"\x10" + bytes(7) + b"garbage" * 9)
    Path("empty").write_bytes(b"")
    before = sorted(tmp_path.rglob("*"))
    said = refused(tut(*args, *(FLAGS if args[0] == "run" and "--robots" not in args and "--hidden" not in args else [])))
    assert said == message or (message.endswith("*") and said.startswith(message.removesuffix("*")))
    assert sorted(tmp_path.rglob("*")) == before, "no file and no folder is left behind"


def test_a_folder_that_holds_a_run_is_named(tut: Callable[..., Said], folder: Path) -> None:
    assert refused(tut("run", "Walker2d", *FLAGS, "--out", folder)) == (
        f"{folder} already holds a run; continue it with: tutelage resume {folder}, or choose --out"
    )


def test_a_folder_in_use_is_named(tut: Callable[..., Said], tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run"))
    assert refused(tut("resume", run.folder)) == (
        f"{run.folder} is in use by another process; wait for it or choose another folder"
    )
    claim = lock(tmp_path / "new")
    said = tut("run", "small:point_fleet", *POINTS, "--out", tmp_path / "new")
    assert refused(said) == f"{tmp_path / 'new'} is in use by another process; wait for it or choose another folder"
    claim.close()


def test_a_damaged_run_is_named(tut: Callable[..., Said], tmp_path: Path) -> None:
    run = Run.start(points(tmp_path / "run"))
    run.run()
    state = run.folder / "checkpoint" / "state.safetensors"
    state.write_bytes(state.read_bytes()[:500])
    assert refused(tut("resume", run.folder)).startswith(f"{state} is damaged or not a Tutelage file: ")


def test_an_error_of_a_run_is_not_hidden_by_its_end(
    tut: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("small.Homing.act", lambda self, obs: np.full((len(obs), 1), 0.0 if len(obs) > 5 else np.nan))
    said = tut("run", "small:point_fleet", *POINTS, "--metrics-every", "100", "--out", tmp_path / "run")
    assert refused(said) == "PolicySupervisor.act returned a number that is not finite"


def test_ctrl_c_while_preparing_is_no_traceback(
    tut: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tutelage.experiments.prepare.demonstrations", interrupted)
    said = tut("run", "small:point_fleet", *POINTS, "--out", tmp_path / "run")
    assert (said.code, said.err) == (130, "tutelage: interrupted\n")
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_missing_extra_says_what_to_install(
    tut: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    said = tut("run", "small:point_fleet", *POINTS, "--out", tmp_path / "run")
    assert refused(said) == "pyarrow is not installed; run: pip install 'tutelage[data]'"
