"""`tutelage watch`: a fleet at work, as a film (GIF, MP4) or as a sheet of one robot's moments (PNG)."""

from __future__ import annotations

import io
import math
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from tutelage.envs import experts
from tutelage.envs.registry import make_fleet
from tutelage.errors import ConfigError, MissingExtraError, TutelageError
from tutelage.experiments.run import read_config
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.seeding import derive
from tutelage.store import write_atomic

Picture = NDArray[np.uint8]

FRAMES = 150
"""Pictures of a film, at most: longer ones leave out timesteps."""
LINGER = 8
"""Timesteps for which a robot that is done or in violation is shown before it begins again."""
MOMENTS = 6
"""Pictures of a sheet, in two rows."""
GAP, DONE, VIOLATED = np.array([[255, 255, 255], [30, 160, 70], [210, 40, 40]], dtype=np.uint8)
"""Colours of the frame around a robot."""
BORDER = 3
"""Width of that frame, pixels."""


@dataclass(frozen=True)
class WatchConfig:
    """What to look at.

    Attributes:
        task: name of a task.
        out: where it goes; .gif, .mp4 (needs ffmpeg) or .png, six moments of one robot's episode; default: TASK.gif.
        run: a run folder, whose policy drives; default: the task's algorithmic human.
        robots: how many are shown side by side in a film.
        steps: timesteps of a film; default: an episode, at most 300.
        width: of the picture of a robot, pixels.
        height: likewise.
        disturbance: level; default: the task's own.
        seed: of the initial states.
    """

    task: Positional[str]
    out: Path | None = None
    run: Path | None = None
    robots: int = 9
    steps: int | None = None
    width: int = 200
    height: int = 150
    disturbance: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("robots", "steps", "width", "height"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ConfigError(f"{name} must be at least 1, got {value}")
        if self.path.suffix not in (".gif", ".mp4", ".png"):
            raise ConfigError(f"cannot write {self.path.name}: a film is .gif or .mp4, a sheet .png")

    @property
    def path(self) -> Path:
        """Where it goes."""
        return self.out or Path(f"{self.task.replace(':', '.').replace('/', '.')}.gif")


def watch(config: WatchConfig) -> Path:
    """Make the film or sheet; returns where it is.

    Raises:
        ConfigError: the fleet draws no pictures.
        TutelageError: no OpenGL, or no ffmpeg.
    """
    sheet = config.path.suffix == ".png"
    if config.run and (before := read_config(config.run)).task != config.task:
        raise ConfigError(f"{config.run} is a run of {before.task}, not of {config.task}")
    policy = EnsemblePolicy.load(config.run / "policy.safetensors")[0] if config.run else experts.load(config.task)[0]
    settings: dict[str, Any] = (
        {"observation": "images"} if isinstance(policy, EnsemblePolicy) and len(policy.obs_shape) == 3 else {}
    )
    fleet = make_fleet(config.task, 1 if sheet else config.robots, disturbance=config.disturbance, **settings)
    if not hasattr(fleet, "render_robot"):
        raise ConfigError(f"{config.task} draws no pictures")
    seed = derive(config.seed, "watch") % 2**32
    if sheet:
        _write_sheet(config, _episode(fleet, policy, config, seed))
    else:
        steps = config.steps or min(fleet.horizon, 300)
        every = math.ceil(steps / FRAMES)
        frames = _film(fleet, policy, config, steps, every, seed)
        rate = max(10, round(fleet.metadata.get("render_fps", 20) / every))
        (_write_gif if config.path.suffix == ".gif" else _write_mp4)(config.path, frames, min(rate, 50))
    fleet.close()
    return config.path


def _film(fleet: Fleet, policy: Policy, config: WatchConfig, steps: int, every: int, seed: int) -> Iterator[Picture]:
    """All robots side by side, every so many timesteps."""
    obs, info = fleet.reset(seed=seed)
    over, done = np.zeros(fleet.num_envs, dtype=np.int64), np.zeros(fleet.num_envs, dtype=bool)
    for t in range(steps):
        if t % every == 0:
            yield _tiles([_framed(p, d, v) for p, d, v in zip(_draw(fleet, config), done, info["violation"], strict=True)])
        obs, _, _, truncated, info = fleet.step(policy.act(obs))
        done |= info["success"]
        over = np.where(done | info["violation"], over + 1, 0)
        again = (over > LINGER) | (truncated & ~done & ~info["violation"])
        if again.any():
            obs, info = fleet.reset(options={"reset_mask": again})
            done &= ~again


def _episode(fleet: Fleet, policy: Policy, config: WatchConfig, seed: int) -> list[Picture]:
    """The moments of one robot's episode."""
    obs, info = fleet.reset(seed=seed)
    pictures = _draw(fleet, config)
    for _ in range(min(fleet.horizon, config.steps or fleet.horizon)):
        obs, _, _, truncated, info = fleet.step(policy.act(obs))
        pictures += _draw(fleet, config)
        if (truncated | info["success"] | info["violation"])[0]:
            break
    moments = np.rint(np.linspace(0, len(pictures) - 1, MOMENTS)).astype(int)
    return [pictures[k] for k in moments]


def _draw(fleet: Any, config: WatchConfig) -> list[Picture]:
    try:
        return [fleet.render_robot(robot, config.width, config.height) for robot in range(fleet.num_envs)]
    except TypeError:  # an environment of somebody else's, which chose the size of its pictures
        return [fleet.render_robot(robot) for robot in range(fleet.num_envs)]


def _framed(picture: Picture, done: bool, violated: bool) -> Picture:
    colour = VIOLATED if violated else DONE if done else GAP
    framed = np.empty((picture.shape[0] + 2 * BORDER, picture.shape[1] + 2 * BORDER, 3), dtype=np.uint8)
    framed[:] = colour
    framed[BORDER:-BORDER, BORDER:-BORDER] = picture
    return framed


def _tiles(pictures: list[Picture], columns: int | None = None) -> Picture:
    """Pictures of one size side by side, in rows."""
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    blank = np.full_like(pictures[0], 255)
    rows = [pictures[k : k + columns] for k in range(0, len(pictures), columns)]
    return np.concatenate([np.concatenate(row + [blank] * (columns - len(row)), axis=1) for row in rows])


def _write_sheet(config: WatchConfig, pictures: list[Picture]) -> None:
    image = pillow().fromarray(_tiles([_framed(p, False, False) for p in pictures], MOMENTS // 2))
    buffer = io.BytesIO()
    image.save(buffer, "png", optimize=True)
    write_atomic(config.path, buffer.getvalue())


def _write_gif(path: Path, frames: Iterator[Picture], rate: int) -> None:
    draw = pillow()
    first, *rest = [draw.fromarray(frame).quantize(64) for frame in frames]
    buffer = io.BytesIO()
    first.save(buffer, "gif", save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)
    write_atomic(path, buffer.getvalue())


def _write_mp4(path: Path, frames: Iterator[Picture], rate: int) -> None:
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        raise TutelageError("no ffmpeg found, which makes the MP4; install it, or write a .gif")
    first = next(frames)
    height, width = (side - side % 2 for side in first.shape[:2])  # what H.264 can do
    path.parent.mkdir(parents=True, exist_ok=True)
    command = [
        ffmpeg, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", str(rate), "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path),
    ]  # fmt: skip
    raw = b"".join(frame[:height, :width].tobytes() for frame in [first, *frames])
    result = subprocess.run(command, input=raw, capture_output=True, check=False)
    if result.returncode:
        reason = result.stderr.decode(errors="replace").strip().splitlines() or ["it did not say why"]
        raise TutelageError(f"ffmpeg could not write {path}: {reason[-1]}")


def pillow() -> Any:
    """Pillow's `Image`, or a MissingExtraError."""
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("pillow", "report") from None
    return Image
