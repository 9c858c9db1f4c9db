"""Options of the commands."""

import argparse
from collections.abc import Callable


def at_least(low: float) -> Callable[[str], float]:
    """Return a reader of an option: a finite number, a whole one if the bound is an int, that is at least `low`."""
    kind = type(low)

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value < float("inf"):
            word = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(f"expected a {word} of at least {low:g}, got {text}")
        return value

    return read
