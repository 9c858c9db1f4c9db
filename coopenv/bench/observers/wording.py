"""Words that tables share."""

from coopenv.base.format import in_parentheses, number

FAILED = "failed"

_NAMED = 16  # characters of an observer's name on one line


def short_name(name: str) -> str:
    """Return an observer's name, on two lines if it is long."""
    cut = name.rfind("_", 0, _NAMED) + 1 if len(name) > _NAMED else 0
    return f"{name[:cut]}\n{name[cut:]}" if cut else name


def compact(value: float, error: float) -> str:
    """Return a number with its standard error in parentheses; without it where so many digits would not fit."""
    return in_parentheses(value, error) if 1e-3 <= abs(value) < 1e4 else number(value, 2)
