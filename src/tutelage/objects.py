"""What a user names as "module:callable": found, and called with what it takes."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any

from tutelage.errors import ConfigError


def load_object(name: str, what: str) -> Callable[..., Any]:
    """The callable that "module:callable" names. `what` says in errors what it is for ("task").

    Raises:
        ConfigError: no such module, or no such callable in it.
    """
    module, _, attribute = name.partition(":")
    if not attribute:
        raise ConfigError(f"{what} {name!r}: write module:callable, such as my_package.robots:make_fleet")
    try:
        found: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, and something that it imports does not
        raise ConfigError(f"{what} {name!r}: no module {error.name!r}; install it, or run where Python finds it") from None
    except ValueError:  # an empty or relative name
        raise ConfigError(f"{what} {name!r}: write module:callable, such as my_package.robots:make_fleet") from None
    for part in attribute.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        raise ConfigError(f"{what} {name!r}: module {module!r} has no callable {attribute!r}")
    return found  # type: ignore[no-any-return]


def make_object(name: str, what: str, /, **offered: Any) -> Any:
    """What the callable that "module:callable" names returns, called without arguments but those offered that it takes.

    Raises:
        ConfigError: see `load_object`; or it needs more arguments.
    """
    make = load_object(name, what)
    given = {argument: value for argument, value in offered.items() if takes(make, argument)}
    check_call(make, f"{what} {name!r}", **given)
    return make(**given)


def takes(make: Callable[..., Any], argument: str) -> bool:
    """Whether a callable takes an argument of that name; one without a signature, such as one written in C, does not."""
    try:
        parameters = inspect.signature(make).parameters.values()
    except ValueError:
        return False
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return any(p.kind is p.VAR_KEYWORD or (p.name == argument and p.kind in by_name) for p in parameters)


def check_call(make: Callable[..., Any], name: str, /, *arguments: Any, **settings: Any) -> None:
    """Refuse arguments that a callable does not take, before it runs, so that its own TypeErrors stay its own.

    Raises:
        ConfigError: it does not take them, or needs more.
    """
    try:
        inspect.signature(make).bind(*arguments, **settings)
    except TypeError as error:
        given = f" with {sorted(settings)}" if settings else ""
        raise ConfigError(f"{name} cannot be made{given}: {error}") from None
    except ValueError:  # a callable without a signature
        return
