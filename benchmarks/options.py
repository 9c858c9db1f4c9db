"""Options and exit status of the commands."""

import argparse
import sys
from collections.abc import Callable

from coopenv.base.errors import CoopenvError


def status_of(work: Callable[[argparse.Namespace], None], asked: argparse.Namespace) -> int:
    """Do the work that is asked for; return the exit status: 0, or 2 after a mistake in the input, in one line."""
    try:
        work(asked)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


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
