"""viser, which draws in the browser; it comes with the extra `view`, its client included."""

from typing import Any

from coopenv.errors import CoopenvError


def has_viser() -> bool:
    """Return whether the extra is installed."""
    try:
        viser_module()
    except CoopenvError:
        return False
    return True


def viser_module() -> Any:
    """Return the module.

    Raises:
        CoopenvError: it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise CoopenvError("pictures in the browser need an extra: pip install '.[view]'") from None
    import rich

    rich.get_console().quiet = True  # it would write to standard output when it stops
    return viser
