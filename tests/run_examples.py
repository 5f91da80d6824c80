"""Runs what the documentation shows: marked code blocks of README.md and docs/, and examples/, each in a temporary folder.

    python tests/run_examples.py                 # all of it; exits with 1 if something fails
    python tests/run_examples.py README 02_      # what has one of these in its name
    python tests/run_examples.py --write         # also put the output of the commands into the pages

A block runs if the line before its fence is one of

    <!-- run -->            it must exit with 0
    <!-- run: output -->    (console blocks) and print what the page says
    <!-- file: NAME -->     it is not run, but written to a file, for the blocks after it

`python` blocks are programs, `console` blocks are lines of "$ command" and output, `sh` blocks are scripts. The blocks of
one page share a folder and run in their order.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"^<!-- (?:run(?P<output>: output)?|file: (?P<file>[\w.-]+)) -->\n```(?P<kind>\w+)\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
OTHERWISE = "prints something else; run: python tests/run_examples.py --write"
LIMIT = 300  # seconds; a hanging command must not hang the build


@dataclass
class Outcome:
    """What became of a command."""

    code: int
    output: str
    seconds: float


def environment() -> dict[str, str]:
    """That of a terminal without colours, in which `tutelage` and `python` are those of this interpreter."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    modules = os.pathsep.join([".", *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "PATH": path, "NO_COLOR": "1", "TERM": "dumb", "PYTHONPATH": modules}


def execute(command: list[str], folder: Path) -> Outcome:
    """Run a command in a folder, without input."""
    began = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=LIMIT, check=False,
        )  # fmt: skip
        code, output = done.returncode, done.stdout
    except subprocess.TimeoutExpired:
        code, output = 124, f"not done after {LIMIT} s\n"
    return Outcome(code, output, time.monotonic() - began)


def tidy(text: str) -> str:
    """Output as a page shows it: no spaces at the ends of lines, no empty lines around."""
    return "\n".join(line.rstrip() for line in text.strip("\n").splitlines())


def run_block(kind: str, body: str, folder: Path) -> tuple[Outcome, str]:
    """Run a block; also returns it with the output that its commands had now."""
    if kind == "python":
        return execute([sys.executable, "-c", body], folder), body
    if kind == "sh":
        return execute(["bash", "-euo", "pipefail", "-c", body], folder), body
    code, said, seconds, shown = 0, "", 0.0, ""
    for command in re.findall(r"^\$ (.*)$", body, re.MULTILINE):
        outcome = execute(["bash", "-euo", "pipefail", "-c", command], folder)
        shown += f"$ {command}\n" + (tidy(outcome.output) + "\n" if outcome.output.strip() else "")
        code, said, seconds = outcome.code, said + outcome.output, seconds + outcome.seconds
        if code:
            break
    return Outcome(code, said, seconds), shown


def run_page(path: Path, write: bool) -> int:
    """Run the marked blocks of a page; returns how many failed."""
    text = path.read_text(encoding="utf-8")
    failures, pieces, end = 0, [], 0
    with tempfile.TemporaryDirectory() as folder:
        for block in BLOCK.finditer(text):
            kind, body = block["kind"], block["body"]
            if block["file"]:
                (Path(folder) / block["file"]).write_text(body, encoding="utf-8")
                continue
            outcome, shown = run_block(kind, body, Path(folder))
            stale = bool(block["output"]) and outcome.code == 0 and tidy(shown) != tidy(body)
            line = text.count("\n", 0, block.start()) + 3
            name = f"{path.relative_to(ROOT)}:{line} {kind}"
            if write and stale:
                print(f"      {name}: renewed")
            report(name, outcome, OTHERWISE if stale and not write else "")
            if stale and not write:
                print(f"--- now it prints\n{shown}---")
            failures += outcome.code != 0 or (stale and not write)
            pieces += [text[end : block.start("body")], shown if stale and write else body]
            end = block.end("body")
    if write and pieces:
        path.write_text("".join([*pieces, text[end:]]), encoding="utf-8")
    return failures


def run_example(path: Path) -> int:
    """Run a program of examples/; returns 1 if it failed."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = execute([sys.executable, str(path)], Path(folder))
    report(str(path.relative_to(ROOT)), outcome)
    return int(outcome.code != 0)


def report(name: str, outcome: Outcome, complaint: str = "") -> None:
    """One line; what a failed command said below it."""
    verdict = "FAIL" if outcome.code or complaint else "ok"
    print(f"{verdict:4}  {name:44} {outcome.seconds:6.1f} s  {complaint}".rstrip(), flush=True)
    if outcome.code:
        print(f"--- exit {outcome.code}\n{outcome.output}---", flush=True)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("only", nargs="*", help="parts of names; default: everything")
    parser.add_argument("--write", action="store_true", help="put the output of commands into the pages")
    options = parser.parse_args()
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    examples = sorted((ROOT / "examples").glob("*.py"))
    chosen = [p for p in [*pages, *examples] if not options.only or any(part in str(p) for part in options.only)]
    failures = sum(run_page(p, options.write) if p.suffix == ".md" else run_example(p) for p in chosen)
    print(f"{failures} failed" if failures else "all of it runs")
    raise SystemExit(failures > 0)


if __name__ == "__main__":
    main()
