"""Runs that survive: a folder that holds everything, written as the run goes, from which it can be continued."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

import tutelage
from tutelage.errors import ConfigError, ContractError, RunFolderError
from tutelage.experiments.assemble import Assembly, assemble
from tutelage.experiments.config import FORMAT, RunConfig, from_json, to_json
from tutelage.experiments.prepare import prepare
from tutelage.experiments.recording import Recorder, lock
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step, Subscriber
from tutelage.store import load_tree, save_tree, write_atomic


class Checkpoints:
    """Saves everything needed to continue bit for bit, every so many timesteps: data first, then the checkpoint.

    A crash between the two leaves data beyond the checkpoint, which resuming cuts off.
    """

    def __init__(self, folder: Path, recorder: Recorder, assembly: Assembly) -> None:
        self.path = self.path_in(folder)
        self._folder, self._recorder, self._assembly = folder, recorder, assembly
        self._complete = self._saved = -1

    @staticmethod
    def path_in(folder: Path) -> Path:
        """The checkpoint of a run folder."""
        return folder / "checkpoint" / "state.safetensors"

    def on_start(self, loop: Loop) -> None:
        """Nothing to do: a run that starts or resumes has its checkpoint."""
        self._complete = loop.t

    def on_step(self, loop: Loop, step: Step) -> None:
        """Save when due. This subscriber is the last one: when it hears of a step, everybody has written it down."""
        self._complete = loop.t
        if loop.t % self._assembly.config.checkpoint_every == 0:
            self.save(loop)

    def on_end(self, loop: Loop) -> None:
        """Save where the run ended, if that is not saved yet.

        Unless it broke in the middle of a step: then the last checkpoint is the truth.
        """
        if not loop.in_step and self._complete == loop.t != self._saved:
            self.save(loop)

    def save(self, loop: Loop) -> None:
        """Make recordings durable, then replace the policy and the checkpoint."""
        self._recorder.commit(loop.t)
        card = {"task": self._assembly.config.task, "t": loop.t, "algorithm": self._assembly.config.algorithm}
        self._assembly.policy.save(self._folder / "policy.safetensors", card)
        # The checkpoint last: a run that it calls complete has its last policy.
        save_tree(self.path, {"format": FORMAT, "loop": loop.state_dict(), "recorder": self._recorder.state_dict()})
        self._saved = loop.t

    def load(self, loop: Loop) -> None:
        """Continue from the checkpoint: restore the state, cut the recordings back to it."""
        state = load_tree(self.path)
        found = state.get("format")
        if found != FORMAT:
            raise RunFolderError(
                f"{self.path} has format {found}, this version reads {FORMAT}; use the version that wrote it"
            )
        try:
            if (len(state["loop"]["mode"]), len(state["loop"]["robot_of"])) != (loop.fleet.num_envs, len(loop.team)):
                raise ValueError
            loop.load_state_dict(state["loop"])
            self._recorder.load_state_dict(state["recorder"])
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ContractError):
            raise RunFolderError(
                f"{self.path} does not fit {self._folder / 'config.json'}: one of them is damaged or was changed; restore it"
            ) from None
        self._recorder.cut(loop.t)


class Run:
    """A run in its folder: `Run.start(config)` makes a new one, `Run.resume(folder)` continues one; then `.run()`."""

    def __init__(self, folder: Path, assembly: Assembly, claim: TextIO) -> None:
        self.folder, self.assembly, self.config, self._claim = folder, assembly, assembly.config, claim
        c = self.config
        self.recorder = Recorder(folder, c.robots, c.humans, c.steps, c.metrics_every, c.record)
        self.loop = assembly.loop()
        self.checkpoints = Checkpoints(folder, self.recorder, assembly)

    @classmethod
    def start(cls, config: RunConfig, report: Any = lambda what, done: None) -> Run:
        """Prepare a new run.

        Raises:
            RunFolderError: the folder already holds a run.
            ConfigError: see `assemble`; or the fleet cannot be checkpointed.
        """
        folder = config.folder
        _check_vacant(folder)
        assembly = assemble(config)
        assembly.loop()  # what cannot work is refused here, before minutes are spent on preparing
        if not assembly.fleet.can_checkpoint:
            raise ConfigError(f"{config.task} cannot be checkpointed, and a run must be; use it in a Loop of your own")
        claim = lock(folder)
        _check_vacant(folder)  # another process may have made and left a run while this one assembled
        assembly = prepare(assembly, report)
        run = cls(folder, assembly, claim)
        run.recorder.cut(0)  # what began here and was given up before its first metrics
        run.checkpoints.save(run.loop)
        write_atomic(folder / "environment.txt", environment().encode())
        # Written last: a folder with a configuration is one that can be continued.
        content = {
            "format": FORMAT,
            "version": tutelage.__version__,
            "algorithm": config.algorithm,
            **to_json(assembly.config),
        }
        write_atomic(folder / "config.json", json.dumps(content, indent=2).encode())
        return run

    @classmethod
    def resume(cls, folder: Path) -> Run:
        """Continue a run from its last checkpoint, as if it had never stopped.

        Raises:
            RunFolderError: no run there, of another version, or in use.
        """
        config = dataclasses.replace(read_config(folder), out=folder)
        claim = lock(folder)
        run = cls(folder, assemble(config), claim)
        run.checkpoints.load(run.loop)
        return run

    def run(self, subscribers: Sequence[Subscriber] = ()) -> dict[str, float]:
        """Run to the end; returns the final metrics. An interruption leaves a folder that can be continued."""
        self.loop.subscribers = [self.recorder, *subscribers, self.checkpoints]
        try:
            self.loop.run(self.config.steps)
        finally:
            self.recorder.close()
            self._claim.close()
        return self.recorder.tally.summary()


def _check_vacant(folder: Path) -> None:
    if (folder / "config.json").exists():
        raise RunFolderError(f"{folder} already holds a run; continue it with: tutelage resume {folder}, or choose --out")
    metrics = folder / "metrics.jsonl"
    if metrics.is_file() and metrics.stat().st_size:
        raise RunFolderError(
            f"{folder} holds the recordings of a run without its config.json; restore that, or choose --out"
        )


def read_config(folder: Path) -> RunConfig:
    """The resolved configuration of a run.

    Raises:
        RunFolderError: no run there, or one of another version.
    """
    path = folder / "config.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        found = values.pop("format")
    except (FileNotFoundError, NotADirectoryError):
        raise RunFolderError(f"{folder} holds no run (no config.json); start one with: tutelage run") from None
    except PermissionError as error:
        raise RunFolderError(f"cannot read {path}: {error.strerror}") from None
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError):
        raise RunFolderError(f"{path} is damaged; restore it, or start a new run in another folder") from None
    if found != FORMAT:
        raise RunFolderError(f"{folder} has format {found}, this version reads {FORMAT}; use the version that wrote it")
    values.pop("version", None)
    values.pop("algorithm", None)
    return from_json(RunConfig, values)  # type: ignore[no-any-return]


def loop_state(folder: Path) -> dict[str, Any]:
    """The state of a run's loop at its last checkpoint: what its learner and its priority had learned, and all else.

    Raises:
        RunFolderError: a damaged checkpoint, or one of another version.
    """
    path = Checkpoints.path_in(folder)
    state = load_tree(path)
    if state.get("format") != FORMAT:
        raise RunFolderError(
            f"{path} has format {state.get('format')}, this version reads {FORMAT}; use the version that wrote it"
        )
    try:
        return dict(state["loop"])
    except (LookupError, TypeError):
        raise RunFolderError(f"{path} is damaged; restore it") from None


def environment() -> str:
    """What the run was made with: Python, machine, versions of the packages that matter."""
    lines = [f"python {platform.python_version()}", f"machine {platform.platform()}", f"processor {platform.machine()}"]
    for package in ("tutelage", "numpy", "torch", "gymnasium", "mujoco", "numba", "safetensors"):
        try:
            lines.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            lines.append(f"{package} not installed")
    return "\n".join(lines) + "\n"
