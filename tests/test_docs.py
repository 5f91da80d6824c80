"""The documentation is held against the code: layout, links, commands, the table of modes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

from tutelage.cli import main
from tutelage.console.commands import accounts, audit, study
from tutelage.envs.tasks import TASKS, MujocoTask
from tutelage.experiments.config import RunConfig
from tutelage.fleet.modes import INVALID, TABLE, Event, Mode
from tutelage.fleet.priority import TERMS
from tutelage.learning.critic import CriticConfig
from tutelage.policies.networks import hidden_layers
from tutelage.policies.vision import HEAD
from tutelage.remote import commands as fleet
from tutelage.sgc.commands import keys, proxy

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "results").glob("*.md")],
)
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
GROUPS = {"keys": keys, "proxy": proxy, "fleet": fleet, "accounts": accounts, "audit": audit, "study": study}
GENERATED = {"runs", "site", "dist"}


def name(page: Path) -> str:
    """Of a page, in the names of tests."""
    return str(page.relative_to(ROOT))


# -- layout ---------------------------------------------------------------------------------------------------------------


def layout() -> list[str]:
    """The paths of the README's layout."""
    block = re.search(r"^## Layout\n\n```text\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    assert block, "the README has no layout"
    paths, parent = [], ""
    for line in block[1].splitlines():
        entry = line.split()[0]
        if line.startswith(" "):
            paths.append(parent + entry)
        else:
            parent = entry
            paths.append(entry)
    return paths


@pytest.mark.parametrize("path", layout())
def test_the_readme_shows_what_exists(path: str) -> None:
    found = ROOT / path
    assert found.is_dir() if path.endswith("/") else found.is_file()


def test_the_readme_shows_every_folder_of_the_project() -> None:
    folders = {f"{path.name}/" for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith(".")}
    shown = {path.split("/")[0] + "/" for path in layout()}
    assert folders - {f"{folder}/" for folder in GENERATED} <= shown


def test_the_readme_shows_every_part_of_the_package() -> None:
    package = ROOT / "src" / "tutelage"
    parts = {f"{path.name}/" for path in package.iterdir() if (path / "__init__.py").exists()}
    parts |= {path.name for path in package.glob("*.py") if path.name != "__init__.py"}
    assert {f"src/tutelage/{part}" for part in parts} <= set(layout())


# -- links ----------------------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link} leads nowhere"
        assert not anchor or anchor in anchors(target), f"{link}: no such heading"


def test_pages_of_the_site_link_to_nothing_outside_of_it() -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        assert "](../" not in page.read_text(encoding="utf-8"), name(page)


# -- tables ---------------------------------------------------------------------------------------------------------------


def test_the_tables_of_speed_are_those_of_the_results() -> None:
    command = [sys.executable, "-m", "benchmarks.pages", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# -- commands -------------------------------------------------------------------------------------------------------------


@cache
def manual(verb: str) -> str | None:
    """What `tutelage VERB --help` prints; None: there is no such verb. Of a group, the verb is two words: "keys init"."""
    import io
    from contextlib import redirect_stderr, redirect_stdout

    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out), pytest.raises(SystemExit) as end:
        main([*verb.split(), "--help"])
    return None if end.value.code else out.getvalue()


def commands(page: Path) -> list[str]:
    """The command lines of a page that begin with `tutelage`, in code blocks and in code spans."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"(?:^|[`$ ])tutelage (?=[a-z])([^`\n]*)", text, re.MULTILINE)
    in_code = re.findall(r"```.*?```|`[^`\n]+`", text, re.DOTALL)
    return [command for command in found if any(f"tutelage {command}" in code for code in in_code)]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_and_their_options_exist(page: Path) -> None:
    for command in commands(page):
        verb, *words = command.partition("  #")[0].split()
        if words and verb in GROUPS:
            verb = f"{verb} {words.pop(0)}"
        text = manual(verb)
        assert text is not None, f"tutelage {command}: no such verb"
        for option in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert option in text, f"tutelage {command}: {verb} has no option {option}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_options_in_code_spans_exist(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    own = {"--check", "--write", "--strict", "--seeds", "--ablations", "--again"}  # of modules that are no verbs
    verbs = ["run", "evaluate", "report", "reproduce", "train-expert", "check", "watch", "serve", "robot"]
    verbs += [f"{group} {verb}" for group, module in GROUPS.items() for verb in module.VERBS]
    known = "".join(filter(None, map(manual, verbs)))
    for option in set(re.findall(r"`(--[a-z][\w.-]*)", text)) - own:
        assert option in known, f"no verb has {option}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_modules_that_are_run_exist(page: Path) -> None:
    for module in re.findall(r"python -m (tutelage[\w.]*)", page.read_text(encoding="utf-8")):
        assert (ROOT / "src" / Path(*module.split("."))).with_suffix(".py").exists(), module


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_files_and_modules_in_code_spans_exist(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for path in re.findall(r"`((?:src|examples|tests|docs)/[\w./-]*)`", text):
        assert (ROOT / path).exists(), path
    for module in re.findall(r"`(tutelage(?:\.[a-z_]\w*)+)`", text):
        at = ROOT / "src" / Path(*module.split("."))
        inside = at.parent.with_suffix(".py")
        holds = inside.exists() and re.search(rf"\b{at.name}\b", inside.read_text(encoding="utf-8"))
        assert at.with_suffix(".py").exists() or at.is_dir() or holds or module == "tutelage.tasks", module


def test_make_targets_in_the_pages_exist() -> None:
    targets = set(re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        asked = set(re.findall(r"^make ([a-z0-9]+)", text, re.MULTILINE)) | set(re.findall(r"`make ([a-z0-9]+)`", text))
        assert asked <= targets, name(page)


@pytest.mark.parametrize("page", ["README.md", "docs/quickstart.md"])
def test_the_extras_of_the_package_are_listed(page: str) -> None:
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    table = re.search(r"\| extra \| for \|\n\|---\|---\|\n((?:\|.*\n)+)", (ROOT / page).read_text())
    assert table
    assert {name for row in table[1].splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])} == extras


def test_ci_runs_the_tests_first() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert re.findall(r"^step (\w+)", script.read_text(), re.MULTILINE) == ["test", "lint", "examples", "docs"]


# -- tables that repeat the code --------------------------------------------------------------------------------------------


def modes_table() -> str:
    """The table of modes and events as Markdown."""
    from tutelage.experiments.tables import markdown

    rows = [
        [f"**{mode.name}**", *("" if TABLE[mode, event] == INVALID else Mode(TABLE[mode, event]).name for event in Event)]
        for mode in Mode
    ]
    return markdown(["from \\ event", *(f"{event.name}" for event in Event)], rows).replace("---:", "---")


def test_the_table_of_modes_is_that_of_the_code() -> None:
    page = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    between = re.search(r"<!-- begin: modes -->(.*?)<!-- end: modes -->", page, re.DOTALL)
    assert between
    assert between[1].strip() == modes_table().strip(), "run: python tests/test_docs.py"


def test_every_term_of_a_priority_is_documented() -> None:
    page = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    listed = re.search(r"\$ tutelage info priorities\n(.*?)```", page, re.DOTALL)
    assert listed
    assert set(TERMS) <= {line.split()[0] for line in listed[1].splitlines() if line.strip()}


def test_the_numbers_of_the_algorithms_are_the_defaults() -> None:
    page = re.sub(r"\s+", " ", (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8"))
    run, critic, hidden = RunConfig("Walker2d"), CriticConfig(), hidden_layers(17, None)
    periods = {task.initial_period for task in TASKS.values() if task.name not in ("Humanoid", "AllegroHand")}
    assert len(periods) == 1
    for said in (
        f"the {run.thresholds.uncertainty_quantile} quantile of its uncertainty",
        f"the {run.thresholds.risk_quantile} quantile of its risk",
        f"(`--calibration-steps`, {run.calibration_steps})",
        f"t_I is {TASKS['Humanoid'].initial_period:,} for Humanoid, {TASKS['AllegroHand'].initial_period:,} for AllegroHand "
        f"and {periods.pop()} for the other tasks",
        f"({critic.pretrain:,} gradient steps, a quarter of each batch violations)",
        f"discount is {critic.gamma} and their target moves by {critic.tau} a gradient step",
        f"updated every {critic.every} timesteps",
        f"an ensemble of {run.members} networks ({len(hidden)} × {hidden[0]} ReLU",
        f"then fully connected layers of {', '.join(map(str, HEAD[:-1]))} and {HEAD[-1]}",
        f"| offline pairs | {MujocoTask.offline_pairs:,}, but {TASKS['Ant'].offline_pairs} for Ant;",
        f"| gradient steps before the run | {run.learner.pretrain:,} |",
        f"| gradient steps a timestep | {run.learner.gradient_steps}, of {run.learner.batch} pairs a member |",
    ):
        assert said in page, said
    assert critic.positives == 0.25
    chapter_5 = {name: task for name, task in TASKS.items() if not task.goal}
    assert {name for name, task in chapter_5.items() if task.offline_pairs != MujocoTask.offline_pairs} == {"Ant"}


def test_the_first_example_is_the_program_of_the_readme() -> None:
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert program
    assert (ROOT / "examples" / "01_first_run.py").read_text().endswith(program[1])


if __name__ == "__main__":
    from tutelage.experiments.tables import insert

    concepts = ROOT / "docs" / "concepts.md"
    concepts.write_text(insert(concepts.read_text(encoding="utf-8"), "modes", modes_table()), encoding="utf-8")
    sys.stdout.write(f"written: {concepts}\n")
