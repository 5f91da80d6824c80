"""Pictures: of the right robot, in the size that was asked for, drawn only while somebody looks, never during a step."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floor import Serving, config

from tutelage.console.frames import ArrayPainter, Frames, MujocoPainter, SeenPainter, fitted, painter_of
from tutelage.envs.registry import make_fleet


def pushing(out: Path, **changes: Any) -> Any:
    return config(
        out, fleet="sim:ObstaclePushing", run={"expert": None, "disturbance": "none", **changes.pop("run", {})}, **changes
    )


def look(server: Serving, robot: int, width: int = 64, height: int = 48) -> Any:
    return server.wait(lambda: server.of.frame(robot, 0, width, height), 5.0, "no picture")


class TestWatching:
    def test_a_picture_shows_the_robot_as_it_is(self, tmp_path: Path) -> None:
        with Serving(pushing(tmp_path)) as server:
            fleet: Any = server.of.engine.parts.fleet.inner
            server.of.estop("ann", None)  # so that all stand still
            server.steps(3)
            time.sleep(0.1)
            for robot in range(3):
                server.steps(2)
                frame = look(server, robot)
                assert frame.rgb.shape == (48, 64, 3)
                server.steps(3)
                assert (look(server, robot).rgb == fleet.render_robot(robot, 64, 48)).all()

    def test_it_is_new_in_every_timestep(self, tmp_path: Path) -> None:
        with Serving(pushing(tmp_path)) as server:
            first = look(server, 0)
            server.wait(lambda: look(server, 0).time > first.time)
            assert abs(look(server, 0).time - time.time()) < 1.0

    def test_also_while_the_simulation_waits_for_people(self, tmp_path: Path) -> None:
        with Serving(pushing(tmp_path, lockstep=True)) as server:
            server.of.join("ann")
            server.of.take("ann", 2)
            server.wait(lambda: 2 in server.now.leases)
            t = server.now.t
            assert look(server, 2).rgb.shape == (48, 64, 3)
            assert server.now.t <= t + 1

    def test_several_sizes_at_once(self, tmp_path: Path) -> None:
        with Serving(pushing(tmp_path)) as server:
            assert look(server, 0, 32, 24).rgb.shape == (24, 32, 3)
            assert look(server, 0, 320, 180).rgb.shape == (180, 320, 3)

    def test_nothing_is_drawn_that_nobody_looks_at(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("tutelage.console.frames.WATCHED", 0.2)
        with Serving(pushing(tmp_path)) as server:
            look(server, 0)
            frames = server.of._frames
            server.wait(lambda: not frames._watched and not frames._frames)

    @pytest.mark.parametrize(
        ("robot", "camera", "width", "height"), [(9, 0, 8, 8), (0, 3, 8, 8), (0, 0, 0, 8), (0, 0, 9999, 8), (-1, 0, 8, 8)]
    )
    def test_what_there_is_no_picture_of(self, tmp_path: Path, robot: int, camera: int, width: int, height: int) -> None:
        with Serving(pushing(tmp_path)) as server:
            for _ in range(3):
                assert server.of.frame(robot, camera, width, height) is None
                server.steps(1)

    def test_robots_that_nobody_can_draw(self, tmp_path: Path) -> None:
        with Serving(config(tmp_path)) as server:
            server.steps(2)
            assert server.of.frame(0, 0, 64, 48) is None


class TestPainters:
    def test_arrays(self) -> None:
        fleet: Any = make_fleet("Navigation", 3)
        fleet.reset(seed=0)
        painter = painter_of(fleet)
        assert isinstance(painter, ArrayPainter)
        assert (painter.draw(painter.copy(np.array([1]))[0], 50, 30) == fleet.render_robot(1, 50, 30)).all()

    def test_what_robots_see(self) -> None:
        fleet: Any = make_fleet("ObstaclePushing", 2, observation="images")
        obs, _ = fleet.reset(seed=0)
        painter = painter_of(fleet)
        assert isinstance(painter, ArrayPainter), "drawn in any size where that is possible"
        seen = SeenPainter()
        seen.obs = obs
        assert seen.draw(seen.copy(np.array([1]))[0], 128, 96).shape == (96, 96, 3)

    @pytest.mark.render
    def test_mujoco_is_drawn_beside_the_physics(self) -> None:
        """In another thread, and while the simulation goes on: what was copied is what is drawn."""
        fleet: Any = make_fleet("BallBalance", 3, threads=1)
        fleet.reset(seed=0)
        for _ in range(5):
            fleet.step(np.zeros((3, 3), dtype=np.float32))
        painter = painter_of(fleet)
        assert isinstance(painter, MujocoPainter)
        frames = Frames(fleet, 10.0)
        state = painter.copy(np.array([2]))[0]
        frames.start()
        stop = threading.Event()

        def go_on() -> None:
            while not stop.is_set():
                fleet.step(np.zeros((3, 3), dtype=np.float32))

        stepping = threading.Thread(target=go_on)
        stepping.start()
        try:
            pictures = [frames.draw(state, 96, 64) for _ in range(3)]
        finally:
            stop.set()
            stepping.join()
            frames.close()
            fleet.close()
        assert pictures[0] is not None
        assert pictures[0].std() > 5, "it is a picture of something"
        for picture in pictures[1:]:
            assert (picture == pictures[0]).all()


class TestFitting:
    @pytest.mark.parametrize(
        ("shape", "size", "becomes"),
        [((64, 64, 3), (160, 90), (90, 90, 3)), ((10, 40, 3), (20, 20), (5, 20, 3)), ((1, 1, 3), (7, 5), (5, 5, 3))],
    )
    def test_pictures_keep_their_shape(
        self, shape: tuple[int, ...], size: tuple[int, int], becomes: tuple[int, ...]
    ) -> None:
        """Nothing is put around them: people point at the picture, wherever its edges are."""
        assert fitted(np.full(shape, 200, dtype=np.uint8), *size).shape == becomes
