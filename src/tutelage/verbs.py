"""From the arguments of a command to the function that does it: tyro's parser, its complaints as one line.

An option whose default is None or nothing at all may be left out: help says "(optional)", and its text what happens then.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import inspect
import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from tutelage.errors import ConfigError

OPTIONAL = tyro.conf.arg(help_behavior_hint="(optional)")


class _Options(ConstructorRegistry):
    """tyro's rules, with fields of configurations that may be left out."""

    def __init__(self) -> None:
        super().__init__()
        self._asking = False
        self.struct_rule(self._rule)

    def _rule(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        if self._asking or not dataclasses.is_dataclass(info.type):
            return None
        self._asking = True  # what tyro's own rules say
        try:
            spec = self.get_struct_spec(info)
        finally:
            self._asking = False
        if not isinstance(spec, StructConstructorSpec):
            return None
        fields = (dataclasses.replace(field, type=_optional(field.type, field.default)) for field in spec.fields)
        return dataclasses.replace(spec, fields=tuple(fields))


def _optional(kind: Any, default: Any) -> Any:
    """The annotation of an option; one that may be left out says so, where tyro would show the default None."""
    return Annotated[kind, OPTIONAL] if default is None or default == () else kind


def parse_verb(
    verbs: Mapping[str, Any],
    arguments: list[str],
    prog: str = "tutelage",
    description: str = "Supervised autonomy for robot fleets.",
) -> Callable[[], None]:
    """The call that the arguments ask for. The parser's boxes become one line, like every other error.

    verbs: functions, or modules with `VERBS` of their own.
    """
    if not arguments or not (arguments[0] in verbs or arguments[0].startswith("-")):
        close = difflib.get_close_matches(arguments[0], verbs, n=1) if arguments else []
        problem = f"unknown command {arguments[0]!r}{_meant(close)}" if arguments else "no command given"
        raise ConfigError(f"{problem}; commands: {', '.join(verbs)} (see {prog} --help)")
    group = verbs.get(arguments[0])
    if isinstance(group, ModuleType):
        return parse_verb(group.VERBS, arguments[1:], f"{prog} {arguments[0]}", group.__doc__ or "")

    def later(verb: Any) -> Callable[..., Callable[[], None]]:
        if isinstance(verb, ModuleType):  # here for the help only

            def named() -> Callable[[], None]:
                raise AssertionError(f"{verb.__name__} is parsed above")

            named.__doc__ = verb.__doc__
            return named

        @functools.wraps(verb)
        def call(*args: Any, **kwargs: Any) -> Callable[[], None]:
            return functools.partial(verb, *args, **kwargs)

        del call.__wrapped__  # else the verb's own annotations would count
        signature, hints = inspect.signature(verb), get_type_hints(verb, include_extras=True)
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.__annotations__ = {
            name: _optional(hints[name], parameter.default) for name, parameter in signature.parameters.items()
        }
        return call

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            chosen: Callable[[], None] = tyro.extras.subcommand_cli_from_dict(
                {name: later(verb) for name, verb in verbs.items()},
                prog=prog,
                args=arguments,
                description=description,
                config=(tyro.conf.DisallowNone,),
                registry=_Options(),
            )
        return chosen
    except SystemExit as stop:
        if stop.code != 2:
            raise
    verb = f" {arguments[0]}" if arguments[0] in verbs else ""
    raise ConfigError(f"{_problem(said.getvalue(), f'{prog}{verb} --help')} (see {prog}{verb} --help)")


def _problem(box: str, place: str) -> str:
    """What the parser's box says is wrong, as one line; of what it suggests, the option of this place that is closest.

    Args:
        box: its text.
        place: the help of the verb, such as "tutelage run --help".
    """
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()[1:]]
    while lines and not lines[0].strip("─-"):  # some terminals have a rule below the title
        lines.pop(0)
    first = itertools.takewhile(lambda line: not re.fullmatch("[─-]+", line), lines)
    told = re.sub(r" \(applied to [^)]*\)| Arguments are applied to the .* matter\.", "", " ".join(first))
    told = " ".join(told.replace(" or misplaced", "").split()).rstrip(".")
    given = found[0] if (found := re.search(r"(?<=: )--[\w.-]+", told)) else ""
    option, here = "", list[str]()
    for line in lines:
        option = found[0] if (found := re.match(r"--[\w.-]+", line)) else option
        if option and line == f"in {place}":
            here.append(option)

    def close(name: str) -> tuple[bool, float]:
        return name.startswith(given), difflib.SequenceMatcher(None, name, given).ratio()

    return told + _meant(sorted(here, key=close, reverse=True))


def _meant(close: Sequence[str]) -> str:
    return f" (did you mean {close[0]}?)" if close else ""
