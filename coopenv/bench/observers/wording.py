"""Words that tables share."""

FAILED = "failed"

_NAMED = 16  # characters of an observer's name on one line


def short_name(name: str) -> str:
    """Return an observer's name, on two lines if it is long."""
    cut = name.rfind("_", 0, _NAMED) + 1 if len(name) > _NAMED else 0
    return f"{name[:cut]}\n{name[cut:]}" if cut else name
