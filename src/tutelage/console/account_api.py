"""HTTP: logging in and out, one's own account, everybody's accounts."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field

from tutelage.console.accounts import SESSION_SECONDS, LoginError, Role, Session, TooManyAttemptsError
from tutelage.console.context import address_of, at_least, context_of, local, session_of
from tutelage.console.security import COOKIE

router = APIRouter(prefix="/api")
Admin = Annotated[Session, Depends(at_least(Role.ADMIN))]
Anybody = Annotated[Session, Depends(session_of)]
Text = Annotated[str, Field(max_length=1024)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Login(_Body):
    """Name and password."""

    name: Text
    password: Text


class SetUp(_Body):
    """The first admin."""

    token: Text
    name: Text
    password: Text


class NewPassword(_Body):
    """One's own password."""

    old: Text
    new: Text


class NewAccount(_Body):
    """An account."""

    name: Text
    role: Text
    password: Text


class Change(_Body):
    """What changes of an account."""

    role: Text | None = None
    password: Text | None = None


@router.post("/login")
async def login(request: Request, body: Login) -> Response:
    """Begin a session."""
    c, address = context_of(request), address_of(request)

    def attempt() -> tuple[str, Session]:
        name = body.name.strip().lower()[:64]
        try:
            token, session = c.accounts.login(name, body.password, address, request.cookies.get(COOKIE))
        except LoginError as error:
            # What was typed as a name may be a password: only names that exist are written down.
            known = any(account.name == name for account in c.accounts.all())
            limited = isinstance(error, TooManyAttemptsError)
            if not limited:
                c.audit.write("login_failed", name if known else "", address=address)
            raise
        try:
            c.audit.write_now("login", session.name, address=address)
        except BaseException:
            c.accounts.logout(token)
            raise
        return token, session

    try:
        token, session = await c.logins.run(attempt)
    except LoginError as error:
        wait = round(error.retry_after + 0.5)
        content: dict[str, Any] = {"error": str(error)} | ({"retry_after": wait} if wait else {})
        headers = {"retry-after": str(wait)} if wait else None
        return JSONResponse(content, 429 if wait else 401, headers)
    return _welcome(request, token, session)


@router.post("/setup")
async def set_up(request: Request, body: SetUp) -> Response:
    """Make the first admin by the link that the server printed, from this machine only."""
    c = context_of(request)
    if not local(request):
        raise HTTPException(403, "open the link on the machine of the server")

    def make() -> tuple[str, Session]:
        account = c.accounts.set_up(body.token, body.name.strip().lower(), body.password)
        c.audit.write_now("account", account.name, action="set_up", account=account.name, role=account.role.name.lower())
        return c.accounts.begin(account.name, request.cookies.get(COOKIE))

    try:
        token, session = await c.logins.run(make)
    except LoginError as error:
        raise HTTPException(401, str(error)) from None
    return _welcome(request, token, session)


@router.post("/logout")
def logout(request: Request, who: Anybody) -> Response:
    """End this session."""
    c = context_of(request)
    c.accounts.logout(request.cookies[COOKIE])
    c.audit.write_now("logout", who.name)
    response = JSONResponse({})
    response.delete_cookie(COOKIE, path="/", secure=c.site.secure, httponly=True, samesite="strict")
    return response


@router.get("/me")
def me(request: Request, who: Anybody) -> dict[str, Any]:
    """Who one is."""
    return {"name": who.name, "role": who.role.name.lower(), "seat": request.app.state.hub.seats.get(who.name)}


@router.post("/password")
async def password(request: Request, who: Anybody, body: NewPassword) -> dict[str, Any]:
    """Change one's own password; other sessions end."""
    c = context_of(request)

    def change() -> None:
        c.accounts.confirm(who.name, body.old, address_of(request))
        c.accounts.set_password(who.name, body.new, keep=who.key)
        c.audit.write_now("account", who.name, action="password", account=who.name)

    try:
        await c.logins.run(change)
    except LoginError as error:
        raise HTTPException(429 if error.retry_after else 403, str(error)) from None
    return {}


@router.get("/accounts")
def accounts(request: Request, who: Admin) -> dict[str, Any]:
    """Everybody."""
    rows = context_of(request).accounts.all()
    return {"rows": [vars(account) | {"role": account.role.name.lower()} for account in rows]}


@router.post("/accounts")
async def add(request: Request, who: Admin, body: NewAccount) -> dict[str, Any]:
    """A new account."""
    c = context_of(request)

    def make() -> None:
        account = c.accounts.add(body.name.strip().lower(), Role.of(body.role), body.password)
        c.audit.write_now("account", who.name, action="add", account=account.name, role=account.role.name.lower())

    await c.logins.run(make)
    return {}


@router.patch("/accounts/{name}")
async def change(request: Request, who: Admin, name: str, body: Change) -> dict[str, Any]:
    """Another role or password."""
    c = context_of(request)

    def apply() -> None:
        if body.password is not None:
            c.accounts.passwords.judge(body.password, name)  # before anything is changed: all of it is done, or nothing
        if body.role is not None:
            role = Role.of(body.role)
            c.accounts.set_role(name, role)
            c.audit.write_now("account", who.name, action="role", account=name, role=role.name.lower())
        if body.password is not None:
            c.accounts.set_password(name, body.password, keep=who.key if name == who.name else None)
            c.audit.write_now("account", who.name, action="password", account=name)

    await c.logins.run(apply)
    return {}


@router.delete("/accounts/{name}")
def remove(request: Request, who: Admin, name: str) -> dict[str, Any]:
    """End an account and its sessions."""
    c = context_of(request)
    c.accounts.remove(name)
    c.audit.write_now("account", who.name, action="remove", account=name)
    return {}


def _welcome(request: Request, token: str, session: Session) -> Response:
    response = JSONResponse({"name": session.name, "role": session.role.name.lower()})
    response.set_cookie(
        COOKIE, token, max_age=SESSION_SECONDS, path="/", httponly=True, samesite="strict",
        secure=context_of(request).site.secure,
    )  # fmt: skip
    return response
