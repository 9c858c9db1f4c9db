"""Some cases of every kind, in one process."""

from __future__ import annotations

from tests.fuzz import large, mcap, mrclam, scenarios, states

KINDS = {"states": (states, 40), "scenarios": (scenarios, 20), "mrclam": (mrclam, 60), "mcap": (mcap, 40)}
"""The module of a kind and how many of its cases there are."""
CASES = [(kind, number) for kind, (_, count) in KINDS.items() for number in range(count)]
CASES += [("large", number) for number in range(len(large.CASES))]


def prepare() -> None:
    """Load and compile what the cases need."""
    for module in (*(module for module, _ in KINDS.values()), large):
        module.prepare()


def case(number: int) -> str:
    """Return the kind of a case and how it was taken."""
    kind, own = CASES[number]
    module = large if kind == "large" else KINDS[kind][0]
    return f"{kind} {module.case(own)}"
