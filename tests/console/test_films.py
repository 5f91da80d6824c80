"""Interventions as films: what was done in each frame, and what it looked like."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floor import LeaseEnded, Serving, config
from test_frames import pushing


def intervene(server: Serving, name: str = "ann", robot: int = 1, n: int = 8) -> str:
    lease = server.take(name, robot)
    for seq in range(n):
        server.of.command(name, robot, lease.id, seq, [0.05, 0.0])
        server.steps(1)
    server.of.give_back(name, robot)
    server.wait_told(LeaseEnded, lease=lease.id)
    return str(lease.id)


def test_an_intervention_becomes_a_film(tmp_path: Path) -> None:
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        server.steps(5)
        intervene(server)
        server.wait(server.of.episodes, 5.0)
        (row,) = server.of.episodes()
        assert (row["robot"], row["operator"], row["outcome"], row["reason"]) == (1, "ann", "given_back", "asked")
        assert 0.2 < row["seconds"] < 5
        film = server.of.episode(row["id"])
        assert film is not None
        frames = film["frames"]
        assert len(frames) == row["frames"] > 15, "with what was before and after"
        ts = [frame["t"] for frame in frames]
        assert ts == list(range(ts[0], ts[0] + len(ts)))
        taught = [frame for frame in frames if frame["wanted"][0] is not None]
        assert 5 <= len(taught) <= 9
        assert taught[0]["wanted"] == pytest.approx([0.05, 0.0])
        picture = server.of.episode_frame(row["id"], len(frames) - 1, 80, 45)
        assert picture is not None
        assert picture.rgb.shape == (45, 80, 3)
        first = server.of.episode_frame(row["id"], 0, 80, 45)
        assert first is not None
        assert (first.rgb != picture.rgb).any(), "the block moved"
        assert server.of.episode_frame(row["id"], len(frames), 80, 45) is None
        assert server.of.episode_frame(row["id"], -1, 80, 45) is None
        assert server.of.episode(99) is None


def test_a_film_shows_what_was_seen_then(tmp_path: Path) -> None:
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        lease = server.take("ann", 1)
        fleet: Any = server.of.engine.parts.fleet.inner
        server.steps(3)  # the robot holds
        then = fleet.render_robot(1, 80, 45)
        server.steps(2)
        server.of.give_back("ann", 1)
        server.wait_told(LeaseEnded, lease=lease.id)
        server.wait(server.of.episodes, 5.0)
        (row,) = server.of.episodes()
        film = server.of.episode(row["id"])
        assert film is not None
        held = [k for k, frame in enumerate(film["frames"]) if frame["mode"] == 2]
        picture = server.of.episode_frame(row["id"], held[-2], 80, 45)
        assert picture is not None
        assert np.array_equal(picture.rgb, then)


def test_films_are_there_after_the_server_started_again(tmp_path: Path) -> None:
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        intervene(server)
        intervene(server, robot=2)
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        assert [row["robot"] for row in server.of.episodes()] == [2, 1]
        intervene(server, robot=0)
        server.wait(lambda: len(server.of.episodes()) == 3, 5.0)
        assert len({row["id"] for row in server.of.episodes()}) == 3
        assert [row["robot"] for row in server.of.episodes(limit=1)] == [0]


def test_a_film_that_was_being_made_when_the_server_was_killed(tmp_path: Path) -> None:
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        intervene(server)
    with closing(sqlite3.connect(tmp_path / "films.sqlite")) as films:
        films.execute("UPDATE film SET outcome = NULL, seconds = NULL, frames = NULL")
        films.commit()
    with Serving(pushing(tmp_path, hz=20.0)) as server:
        (row,) = server.of.episodes()
        assert row["outcome"] == "lost"
        assert row["frames"] >= 5
        assert row["seconds"] == pytest.approx(row["frames"] / 20.0)


def test_no_films_where_nobody_wants_them(tmp_path: Path) -> None:
    with Serving(pushing(tmp_path, replay=False)) as server:
        intervene(server)
        assert server.of.episodes() == []
        assert server.of.episode(1) is None
        assert server.of.episode_frame(1, 0) is None


def test_robots_with_cameras_are_filmed_as_they_sent_it(tmp_path: Path) -> None:
    with Serving(config(tmp_path, fleet="sim:floor:filmed", hz=20.0)) as server:
        assert server.of.jpeg(0, 0) is not None
        assert server.of.jpeg(9, 0) is server.of.jpeg(0, 5) is None
        frame = server.of.frame(2, 0, 320, 180)
        assert frame is not None
        assert frame.rgb.shape == (18, 32, 3)
        lease = server.take("ann", 1)
        for seq in range(20):
            server.of.command("ann", 1, lease.id, seq, [0.3])
            server.steps(1)
        server.of.give_back("ann", 1)
        server.wait(server.of.episodes, 5.0)
        (row,) = server.of.episodes()
        assert 4 <= row["frames"] <= 14, "a few a second"
        first, last = (server.of.episode_frame(row["id"], k, 64, 36) for k in (0, row["frames"] - 1))
        assert first is not None
        assert last is not None
        assert last.rgb.shape == (36, 64, 3)
        assert last.rgb.mean() > first.rgb.mean() + 5, "it went to the right"
