"""Errors that a user can cause, each a `ValueError` with one clear line."""

import os
import re
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from errno import EINVAL
from functools import wraps
from inspect import signature
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

MAX_MESSAGE = 600  # characters of an error, which is to be one line that can be read

MOST_WORDS = 2_000  # valid words that a misspelt one is compared with


class CoopenvError(ValueError):
    """Base of all errors that name a mistake in the input: one line, in which control characters are escaped."""

    def __init__(self, message: str = "") -> None:
        super().__init__(shortened(printable(" ".join(message.split())), MAX_MESSAGE))


class UnknownEnvironmentError(CoopenvError):
    """The name is neither a file stem of `envs/` nor a readable TOML path."""


class ScenarioError(CoopenvError):
    """A scenario file or an override does not describe a possible world."""


class ActionError(CoopenvError):
    """An action has the wrong shape, dtype, agent or value."""


class DeviceError(CoopenvError):
    """The device or precision asked for does not exist here."""


class OutputError(CoopenvError):
    """A result cannot be written where it should go."""


class DataError(CoopenvError):
    """A recorded file is damaged or of another kind."""


class UserCodeError(CoopenvError):
    """A user's sensor or drive cannot be used, or has raised something; the message names file, class and function."""


def is_of_user(error: BaseException | None) -> bool:
    """Return whether a user's sensor or drive has caused an error."""
    return isinstance(error, UserCodeError) or (error is not None and isinstance(error.__cause__, UserCodeError))


class ScenarioWarning(UserWarning):
    """The scenario is possible but the theory's conditions may not hold."""


class AgentWarning(UserWarning):
    """A learned agent observes values beyond those of its training."""


class DataWarning(UserWarning):
    """A recorded or deployment file is of the right kind, but lacks a required part."""


def regular(path: str | Path) -> Path:
    """Return the path of a file to read. Raises OSError: a pipe or a device, which may have no end."""
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(EINVAL, "no regular file")
    return path


def check_memory(size: float, what: str, available: int | None = None) -> None:
    """Raise CoopenvError if more bytes are needed than available (None: in this machine); `what` begins the error."""
    if available is None:
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**34
    if size > available:
        raise CoopenvError(f"{what} would need {size / 2**30:.3g} GiB of memory, there are {available / 2**30:.3g}")


def escaped(problem: UnicodeError) -> tuple[str, int]:
    """Return characters that a stream cannot encode as escapes (`codecs.register_error`); bytes are decoded first."""
    assert isinstance(problem, UnicodeEncodeError)
    return ascii(_decoded(problem.object[problem.start : problem.end]))[1:-1], problem.end


def _decoded(text: str) -> str:
    """Return a text in which bytes of file names that are UTF-8 are characters, whatever the locale."""
    with_bytes = ("utf-8", "surrogateescape")
    return re.sub("[\udc80-\udcff]+", lambda found: found[0].encode(*with_bytes).decode(*with_bytes), text)


def printable(text: str) -> str:
    """Return a text whose control characters, which a terminal would obey, are escaped."""
    text = text if text.isprintable() else _decoded(text)
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shortened(text: str, length: int = 60) -> str:
    """Return a text of at most that many characters; a longer one is cut in its middle."""
    half = (length - 3) // 2
    return text if len(text) <= length else f"{text[:half]}...{text[-half:]}"


def shown(value: object) -> str:
    """Return a value as an error quotes it: as Python writes it, but short."""
    try:
        return shortened(repr(value))
    except Exception:  # numbers of thousands of digits, and classes of users
        return f"a {type(value).__name__}"


def error_text(error: BaseException) -> str:
    """Return the type and the message of any exception."""
    try:
        text = str(error)
    except Exception as another:
        text = f"no message: its text raises {type(another).__name__}"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def listed(names: Sequence[str], most: int = 20) -> str:
    """Return names with commas between; of very many the first few and how many there are."""
    few = names if len(names) <= most else [*names[:most], f"... ({len(names)} in all)"]
    return ", ".join(few)


def check_one_of(what: str, name: object, valid: Iterable[object], error: type[ValueError] = CoopenvError) -> None:
    """Refuse a name that is not valid, with the nearest and all that are; `what` begins the error."""
    allowed = [*valid]
    if name not in allowed:
        names = [str(one) for one in allowed]
        raise error(f"{what} {shown(name)}{suggest(str(name), names)}; known: {listed(names) or 'none'}")


ELSEWHERE = {
    "asdict": "model_dump",
    "config": "overrides",
    "env": "parallel_env",
    "make": "parallel_env",
    "num_envs": "num_worlds",
    "plot": "figure",
    "n_episodes": "worlds",
    "save": "to_csv",
    "seed": "reset",
    "seeds": "worlds",
    "set": "overrides",
    "to_dict": "model_dump",
    "to_json": "model_dump_json",
    "n_envs": "num_worlds",
}
"""Words of other libraries and of the shell, and their equivalents here."""


def suggest(word: str, valid: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)` for the nearest valid word, or the one that is called so elsewhere; else ''."""
    known = {name.lower(): name for name in islice(valid, MOST_WORDS)}
    same = [other for other in (ELSEWHERE.get(word, ""),) if other in known]
    near = same or get_close_matches(word[:MAX_MESSAGE].lower(), known, n=1)
    return f" (did you mean '{known[near[0]]}'?)" if near else ""


_PARTS = ("scenario", "trajectory")  # attributes with attributes that are looked for in their owner


class Explained:
    """Raises an error that lists the attributes if one is missing."""

    if not TYPE_CHECKING:  # which knows the attributes

        def __getattr__(self, name: str) -> Any:
            """Raise the error."""
            if hasattr(type(self), name):
                return object.__getattribute__(self, name)  # an error within a property
            public = [] if name.startswith("_") else [known for known in dir(self) if not known.startswith("_")]
            parts = [f"{part}.{name}" for part in _PARTS if public and hasattr(vars(self).get(part), name)]
            near = f" (did you mean '{parts[0]}'?)" if parts else suggest(name, public)
            known = f"{near}; known: {listed(public)}" if public else ""
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'{known}")


def explained(function: Callable[P, R], hint: str = "") -> Callable[P, R]:
    """Return a function or method whose errors for wrong arguments list those that there are, before a hint.

    Other libraries look for Python's own words, so the error begins with them.
    """
    parameters = signature(function).parameters
    known = [name for name in parameters if name != "self"]
    by_name = [name for name, one in parameters.items() if one.kind is one.KEYWORD_ONLY]
    keys = "; keys of a scenario are given in overrides" if "overrides" in known else ""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise  # the call was right
            words, unknown = str(error).partition(". Did you mean")[0], [name for name in kwargs if name not in known]
            there = f"; by name: {listed(by_name or known) or 'none'}"  # too many, twice, or missing
            if unknown:
                there = f"{suggest(unknown[0], known)}; known: {listed(known) or 'none'}{keys}"
            raise TypeError(f"{words}{there}{hint}") from None

    return call
