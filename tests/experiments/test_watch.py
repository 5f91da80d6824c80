"""Films and sheets: of the asked-for size, with the robots at work in them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tutelage.envs.array_fleet import ArrayFleet
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments import watch
from tutelage.experiments.watch import DONE, VIOLATED, WatchConfig

Image = pytest.importorskip("PIL.Image")


def test_a_film_shows_all_robots_side_by_side(tmp_path: Path) -> None:
    config = WatchConfig("Navigation", tmp_path / "new" / "film.gif", robots=3, steps=20, width=60, height=40)
    film = Image.open(watch.watch(config))
    assert film.n_frames == 20
    assert film.size == (2 * 66, 2 * 46)
    first = np.asarray(film.convert("RGB")).astype(int)
    film.seek(19)
    last = np.asarray(film.convert("RGB")).astype(int)
    changed = np.abs(last - first).sum(axis=2) > 60
    tiles = changed[:46, :66], changed[:46, 66:], changed[46:, :66], changed[46:, 66:]
    assert [bool(tile.any()) for tile in tiles] == [True, True, True, False], "three robots move, the fourth place is empty"


def test_long_films_leave_out_timesteps(tmp_path: Path) -> None:
    config = WatchConfig("Navigation", tmp_path / "film.gif", robots=4, steps=300, width=200, height=122)
    frames = Image.open(watch.watch(config)).n_frames
    assert 0.9 * watch.FRAMES <= frames <= watch.FRAMES, "frames that are alike are one"


def test_who_is_done_or_in_violation_has_a_frame_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Straight:
        def act(self, obs: np.ndarray) -> np.ndarray:
            return np.tile(np.float32([1, 0]), (len(obs), 1))

    fleet = ArrayFleet("Navigation", 1)
    config = WatchConfig("Navigation", width=20, height=20)
    corners = [frame[0, 0] for frame in watch._film(fleet, Straight(), config, 60, 1, seed=0)]
    violated = [bool((corner == VIOLATED).all()) for corner in corners]
    first = violated.index(True)
    assert violated[first : first + watch.LINGER] == [True] * watch.LINGER
    assert not all(violated[first:]), "then it is reset"
    monkeypatch.setattr(fleet.task, "success", lambda state: np.ones(1, dtype=bool), raising=False)
    corners = [frame[0, 0] for frame in watch._film(fleet, Straight(), config, 3, 1, seed=0)]
    assert (corners[2] == DONE).all()


def test_a_sheet_shows_six_moments_of_an_episode(tmp_path: Path) -> None:
    sheet = np.asarray(Image.open(watch.watch(WatchConfig("Navigation", tmp_path / "sheet.png", width=60, height=40))))
    assert sheet.shape == (2 * 46, 3 * 66, 3)
    moments = [sheet[row * 46 : row * 46 + 46, column * 66 : column * 66 + 66] for row in (0, 1) for column in (0, 1, 2)]
    assert len({moment.tobytes() for moment in moments}) == 6


@pytest.mark.render
def test_a_film_of_a_simulated_robot(tmp_path: Path) -> None:
    try:
        path = watch.watch(WatchConfig("Walker2d", tmp_path / "film.gif", robots=2, steps=3, width=32, height=24))
    except TutelageError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    assert Image.open(path).n_frames == 3


def test_an_mp4_needs_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = WatchConfig("Navigation", tmp_path / "film.mp4", robots=2, steps=10, width=21, height=21)
    if shutil.which("ffmpeg"):
        assert watch.watch(config).stat().st_size > 500
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(TutelageError, match="no ffmpeg found"):
        watch.watch(config)


def test_a_fleet_that_draws_nothing_cannot_be_watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch.experts, "load", lambda task: (None, {}))
    with pytest.raises(ConfigError, match="fakes:PointFleet draws no pictures"):
        watch.watch(WatchConfig("fakes:PointFleet", tmp_path / "film.gif"))
