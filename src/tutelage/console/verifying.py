"""Verification of a record in a process of its own, as a long one would take the interpreter from the robots' loop."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

from tutelage.console.chain import Verdict
from tutelage.console.records import RecordError, verify_folder
from tutelage.errors import TutelageError

LONGEST = 600.0
"""Seconds after which it is given up."""


def verify_apart(folder: Path) -> Verdict:
    """As `audit.verify_folder`. Waits for it.

    Raises:
        RecordError: the record cannot be read, or not in time.
    """
    command = [sys.executable, "-m", __name__, str(folder.absolute())]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LONGEST, stdin=subprocess.DEVNULL)
        return Verdict(**json.loads(done.stdout))
    except subprocess.CalledProcessError as error:
        why = (error.stderr.strip().splitlines() or ["it was killed"])[-1]
        raise RecordError(f"the record cannot be verified: {why}") from None
    except (OSError, ValueError, TypeError, subprocess.TimeoutExpired) as error:
        raise RecordError(f"the record cannot be verified: {error}") from None


def main() -> None:
    """Verify the folder named on the command line; print the verdict as JSON."""
    os.nice(10)
    try:
        print(json.dumps(dataclasses.asdict(verify_folder(Path(sys.argv[1])))))
    except TutelageError as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
