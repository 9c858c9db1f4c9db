"""Arguments that are one of a few words."""

from typing import Any

from gymnasium.vector import AutoresetMode

from coopenv.base.errors import CoopenvError, suggest


def check_choice(what: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Make sure that an argument is one of those allowed.

    Raises:
        CoopenvError: it is not.
    """
    if value not in allowed:
        names = [str(a) for a in allowed]
        raise CoopenvError(f"unknown {what} '{value}'{suggest(str(value), names)}; known: {', '.join(names)}")


def checked_autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    """Return a member of Gymnasium's enumeration for it, its name or its value.

    Raises:
        CoopenvError: no such mode.
    """
    known = {word.lower(): m for m in AutoresetMode for word in (m.name, m.value)}
    word = str(getattr(mode, "name", mode)).lower().replace("-", "_")
    if word not in known:
        names = [m.name.lower() for m in AutoresetMode]
        raise CoopenvError(f"unknown autoreset '{mode}'{suggest(word, names)}; known: {', '.join(names)}")
    return known[word]
