"""HTTP: a participant's session of the user study (see `console.study`)."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, HTTPException, Request
from pydantic import BaseModel, ConfigDict, Field

from tutelage.console.accounts import Role, Session
from tutelage.console.context import at_least, context_of, log
from tutelage.console.study import Study
from tutelage.console.study_parts import OutOfOrderError

router = APIRouter(prefix="/api/study")
Operator = Annotated[Session, Depends(at_least(Role.OPERATOR))]
Key = Annotated[str, Field(max_length=32)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Turn(_Body):
    """A card."""

    card: Annotated[int, Field(ge=0, lt=1000)]


class Answers(_Body):
    """By label, by question."""

    answers: Annotated[dict[Key, Annotated[dict[Key, int], Field(max_length=10)]], Field(max_length=10)]


def _study(request: Request) -> Study:
    study = context_of(request).study
    assert study is not None
    return study


@router.get("")
def state(request: Request, who: Operator) -> dict[str, Any]:
    """What is shown now."""
    return _study(request).state()


@router.post("/next")
async def following(request: Request, who: Operator) -> dict[str, Any]:
    """Begin, or go on. Where the next part has other robots, all sockets end, and come back to them."""
    c, study, hub = context_of(request), _study(request), request.app.state.hub
    before = study.supervision
    try:
        await c.control.run(study.next, who.name)
    except OutOfOrderError as error:
        raise HTTPException(409, str(error)) from None
    if study.supervision is not before and c.supervision is before:
        hub.switch(study.supervision)
        try:
            await c.slow.run(study.retire, before)
        except Exception:
            log.exception("robots of the part before did not end well")
    return study.state()


@router.post("/turn")
def turn(request: Request, who: Operator, body: Turn) -> dict[str, Any]:
    """Turn a card over."""
    try:
        return _study(request).turn(body.card)
    except OutOfOrderError as error:
        raise HTTPException(409, str(error)) from None


@router.post("/answers")
async def answers(request: Request, who: Operator, body: Answers) -> dict[str, Any]:
    """The survey at the end."""
    study = _study(request)
    try:
        await context_of(request).control.run(study.answer, who.name, body.answers)
    except OutOfOrderError as error:
        raise HTTPException(409, str(error)) from None
    return study.state()
