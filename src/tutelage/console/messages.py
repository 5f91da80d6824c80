"""What the page may say on its sockets: checked here, and nowhere else. What is not exactly of these forms is malformed."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

T = TypeVar("T")

LONGEST = 65536
"""Bytes of the longest message."""

Robot = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0, lt=2**53)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=64)]
Ref = Annotated[int, Field(ge=0, lt=2**53)] | Annotated[str, Field(max_length=64)] | None
Action = Annotated[list[Number], Field(max_length=64)]


class Message(BaseModel):
    """One message. ref: what its acknowledgement or refusal names."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    ref: Ref = None


class OnRobot(Message):
    """accept, decline: an offer; take: an unheld robot; give_back, reset: the robot one holds."""

    type: Literal["accept", "decline", "take", "give_back", "reset"]
    robot: Robot


class HandOver(Message):
    """Offer one's robot to a certain person."""

    type: Literal["hand_over"]
    robot: Robot
    to: Name


class Available(Message):
    """Whether one wants offers."""

    type: Literal["available"]
    yes: bool


class Stop(Message):
    """Emergency stop of a robot or of all (null), or its end."""

    type: Literal["estop", "estop_clear"]
    robot: Robot | None


class Command(Message):
    """What a robot is to do. sent: the page's clock, ms; push: (x0, y0, x1, y1) on the task's plane."""

    type: Literal["command"]
    robot: Robot
    lease: Name
    seq: Count
    sent: Number = 0.0
    action: Action | None = None
    assist: bool = False
    push: tuple[Number, Number, Number, Number] | None = None


class Renew(Message):
    """Heartbeat of a lease."""

    type: Literal["renew"]
    lease: Name


class Ping(Message):
    """Sign of life; `time` comes back as it is."""

    type: Literal["ping"]
    n: Count = 0
    time: Number = 0.0


Live = Annotated[OnRobot | HandOver | Available | Stop | Command | Renew | Ping, Field(discriminator="type")]


class Stream(BaseModel):
    """A picture that is watched."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    robot: Robot
    camera: Annotated[int, Field(ge=0, lt=2**16)] = 0
    width: Annotated[int, Field(ge=16, le=1920)] = 320
    height: Annotated[int, Field(ge=16, le=1080)] = 180
    fps: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 10.0


class Watch(Message):
    """The streams that are watched from now on, all of them."""

    type: Literal["watch"]
    streams: Annotated[list[Stream], Field(max_length=30)]


class Got(Message):
    """A picture arrived."""

    type: Literal["got"]
    sequence: Annotated[int, Field(ge=0, lt=2**32)]


VideoMessage = Annotated[Watch | Got | Ping, Field(discriminator="type")]

LIVE: TypeAdapter[Live] = TypeAdapter(Live)
VIDEO: TypeAdapter[VideoMessage] = TypeAdapter(VideoMessage)


class MalformedError(Exception):
    """A message that is not of these forms; `text` says where, and repeats nothing of it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text


def parse_live(text: str) -> Live:
    """A message on /api/live. Raises MalformedError."""
    return _parse(LIVE, text)


def parse_video(text: str) -> VideoMessage:
    """A message on /api/video. Raises MalformedError."""
    return _parse(VIDEO, text)


def _parse(form: TypeAdapter[T], text: str) -> T:
    try:
        return form.validate_json(text)
    except ValidationError as error:
        raise MalformedError(problem(error.errors(include_url=False, include_input=False)[0])) from None
    except (ValueError, UnicodeError, RecursionError):
        raise MalformedError("not a message") from None


def problem(first: ErrorDetails | dict[str, Any]) -> str:
    """One line for the first problem that was found, without a word of what was sent."""
    if first["type"] == "extra_forbidden":
        return "an unknown field"
    if first["type"].startswith("union_tag"):
        return "unknown type of message"
    where = ".".join(str(part) for part in first["loc"])
    return (f"{where}: {first['msg']}" if where else first["msg"])[:200]
