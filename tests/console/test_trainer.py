"""The learner in its own process: it learns what people did, it may die, and the loop does not wait for it."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floor import LeaseEnded, Notice, Serving, config

from tutelage.console.audit import samples_in
from tutelage.console.packing import pack, unpack
from tutelage.console.parts import learner_in, load_learner
from tutelage.console.trainer import load_weights, weights_of
from tutelage.console.training import Training
from tutelage.errors import TutelageError
from tutelage.learning.imitation import LearnerConfig

SLOW = {"learner": LearnerConfig(every=10**6, batch=32)}
"""Nothing is due by the schedule: only what people did is learned."""


def teach(server: Serving, robot: int = 1, action: float = 0.05, n: int = 15, name: str = "ann") -> None:
    """Somebody drives a robot for n timesteps."""
    lease = server.take(name, robot)
    for seq in range(n):
        server.of.command(name, robot, lease.id, seq, [action])
        server.steps(1)
    server.of.give_back(name, robot)
    server.wait_told(LeaseEnded, lease=lease.id)


def learning(out: Path, **changes: Any) -> Any:
    run = {**SLOW, **changes.pop("run", {})}
    settings = {"learner": "process", "hz": 20.0, "swap_every": 0.1, "save_every": 0.5, "per_sample": 20.0, **changes}
    return config(out, run=run, **settings)


class TestLearning:
    def test_what_people_do_comes_back_as_a_better_policy(self, tmp_path: Path) -> None:
        with Serving(learning(tmp_path)) as server:
            obs = np.zeros((1, 4))
            before = float(server.of.engine.parts.policy.act(obs)[0, 0])
            assert before == 0.0
            teach(server, action=0.05)
            teach(server, robot=2, action=0.05)
            server.wait(lambda: server.now.policy_version > 0, 30.0, "no weights came back")
            server.wait(lambda: server.of.engine.learner.seen > 0, 10.0)  # type: ignore[union-attr]
            seen = server.of.engine.loop.obs
            server.wait(lambda: np.abs(server.of.engine.parts.policy.act(seen) - 0.05).mean() < 0.04, 20.0)
            assert server.of.healthy["swap_ms"] < 50
        assert (tmp_path / "policy.safetensors").exists()

    def test_the_version_goes_on_when_the_server_starts_again(self, tmp_path: Path) -> None:
        with Serving(learning(tmp_path)) as server:
            teach(server)
            version = server.wait(lambda: server.now.policy_version, 30.0)
        with Serving(learning(tmp_path)) as server:
            assert server.now.policy_version >= version
            learner = server.of.engine.parts.learner
            assert len(learner.dataset) == len(list(samples_in(tmp_path))), "the acting copy knows them too"


class TestDeath:
    def test_a_killed_learner_is_replaced_and_nothing_is_lost(self, tmp_path: Path) -> None:
        with Serving(learning(tmp_path)) as server:
            learner: Any = server.of.engine.learner
            server.wait(lambda: learner.alive)
            pid = learner.pid
            os.kill(pid, signal.SIGKILL)
            server.wait_told(Notice, level="warning")
            t = server.now.t
            teach(server)  # while nobody learns
            assert server.now.t > t
            server.wait(lambda: learner.alive and learner.pid != pid, 20.0)
            assert learner.restarts == 1
            server.wait(lambda: server.now.policy_version > 0, 30.0, "the new one learns")
        assert samples_known(tmp_path) == len(list(samples_in(tmp_path))) > 10

    def test_timesteps_do_not_wait_for_a_learner_that_hangs(self, tmp_path: Path) -> None:
        with Serving(learning(tmp_path, hz=100.0)) as server:
            learner: Any = server.of.engine.learner
            server.wait(lambda: learner.alive)
            os.kill(learner.pid, signal.SIGSTOP)
            try:
                began, t = time.monotonic(), server.now.t
                server.steps(250)
                assert (server.now.t - t) / (time.monotonic() - began) > 15, "on a machine that has other work too"
            finally:
                os.kill(learner.pid, signal.SIGKILL)


class TestTraining:
    """What the process does, without one."""

    def test_it_catches_up_with_the_record(self, tmp_path: Path) -> None:
        with Serving(learning(tmp_path, learner="none", run={"learner": LearnerConfig(every=10**6, batch=32)})) as server:
            teach(server)
        learner = learner_in(tmp_path)
        seen, _ = load_learner(tmp_path, learner)
        training = Training(tmp_path, learner, seen, per_sample=2.0, swap_every=0.0, save_every=1.0)
        training.read_samples()
        n = len(list(samples_in(tmp_path)))
        assert (len(learner.dataset), training.owed) == (n, 2.0 * n)
        training.read_samples()
        assert len(learner.dataset) == n, "each sample once"
        while training.owed >= 1:
            training.improve()
        news = training.weights_due(time.monotonic())
        assert news is not None
        assert news["losses"]["policy"] < 1
        training.save()
        again = learner_in(tmp_path)
        assert load_learner(tmp_path, again)[0] == training.seen
        assert len(again.dataset) == n

    def test_a_full_disk_at_the_end_is_no_traceback(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with Serving(learning(tmp_path, learner="none")) as server:
            server.steps(1)
        training = Training(tmp_path, learner_in(tmp_path), 0, per_sample=2.0, swap_every=0.0, save_every=1.0)

        def full(*_: object) -> None:
            raise TutelageError("no space left on the device")

        monkeypatch.setattr(training, "save", full)
        ours, theirs = Pipe()
        ours.send_bytes(pack({"quit": np.ones(1)}))
        training.run(theirs)  # ends; the record has all that matters

    def test_weights_travel_whole(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path, priority="C.U.R.")) as server:
            learner = server.of.engine.parts.learner
        other = learner_in(tmp_path)
        sent = unpack(pack({"weights": weights_of(learner), "losses": {}, "seen": 3}))
        assert set(sent["weights"]["critics"]) == {"risk"}
        load_weights(other, sent["weights"])
        obs = np.random.default_rng(0).normal(size=(5, 4))
        assert (other.policy.act(obs) == learner.policy.act(obs)).all()
        assert (other.critics["risk"](obs, obs[:, :1]) == learner.critics["risk"](obs, obs[:, :1])).all()


def samples_known(folder: Path) -> int:
    """How many samples the saved learner has."""
    learner = learner_in(folder)
    load_learner(folder, learner)
    return len(learner.dataset)


@pytest.mark.parametrize("tree", [{}, {"a": np.arange(3), "b": {"c": np.zeros((2, 0)), "d": "x"}, "e": [1, 2.5, None]}])
def test_trees_travel_as_bytes(tree: dict[str, Any]) -> None:
    came = unpack(pack(tree))
    assert came.keys() == tree.keys()
    if tree:
        assert (came["a"] == tree["a"]).all()
        assert came["b"]["d"] == "x"
        assert came["b"]["c"].shape == (2, 0)
        assert came["e"] == [1, 2.5, None]
