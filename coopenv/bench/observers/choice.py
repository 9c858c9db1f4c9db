"""What is asked for on the command line: which source, and which of its variants."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coopenv.backends.sources import Kind, is_bag, kind_of
from coopenv.base.errors import CoopenvError, suggest
from coopenv.bench.observers.fault_knobs import KNOBS
from coopenv.bench.observers.fault_variants import variants_with, with_world
from coopenv.bench.observers.sources import Bags, LogFile, Robots, Simulated, Source
from coopenv.policies import load_policy
from coopenv.scenario import Scenario, load_scenario

ALL = "all"  # asks for every variant that the source can have


def variant_rows() -> list[dict[str, str]]:
    """Return what `list variants` says of every variant."""
    faults = {f"{name}={knob.value}": knob.about for name, knob in KNOBS.items()}
    kinds = {"environments, logs": Source.named, "recorded robots": Robots.named, "--fault": faults}
    return [{"name": n, "of": of, "about": text} for of, variants in kinds.items() for n, text in variants.items()]


def find_source(
    text: str,
    overrides: Mapping[str, Any] | None = None,
    data: Path | None = None,
    topics: Path | None = None,
    faults: Sequence[str] = (),
    policy: str | None = None,
) -> Source:
    """Return the source of an environment's name, a scenario file, a sub-dataset's name, a log file or a ROS bag.

    Args:
        text: which one.
        overrides: dotted keys of its scenario.
        data: folder of recorded data sets.
        topics: what the topics of a ROS bag are.
        faults: variants with parameters, see `coopenv.bench.observers.fault_grammar`.
        policy: who drives in a simulated environment; None: action zero.

    Raises:
        CoopenvError: there is none of that name, or an option for what is no such source.
    """
    kind, added = kind_of(text), variants_with(faults)
    if kind is Kind.ENVIRONMENT and not is_bag(text, topics) and topics is None and data is None:
        scenario = load_scenario(text, overrides)
        worlds = tuple(with_world(made, text, scenario, overrides or {}) for made in added)
        return Simulated(Path(text).stem, scenario, _checked_policy(policy, scenario), added=worlds)
    if policy is not None:
        raise CoopenvError(f"--policy {policy}: {text} is recorded, nobody can drive in it")
    if faults and kind is Kind.DATASET:
        raise CoopenvError(
            f"--fault {faults[0]}: recorded robots have variants of their own, {', '.join(Robots.named)}"
        )
    return replace(_recorded(text, kind, overrides, data, topics), added=added)


def _checked_policy(policy: str | None, scenario: Scenario) -> str:
    if policy is None:
        return "zero"
    if not scenario.driven:
        raise CoopenvError(f"--policy {policy}: no vehicle of this environment is driven")
    load_policy(policy, scenario, 0)
    return policy


def _recorded(
    text: str, kind: Kind, overrides: Mapping[str, Any] | None, data: Path | None, topics: Path | None
) -> Source:
    if data is not None and kind is not Kind.DATASET:
        raise CoopenvError(f"--data {data}: {text} is not one of the recorded robots, mrclam_1 .. mrclam_9")
    if is_bag(text, topics):
        return Bags(Path(text).stem, Path(text), topics, dict(overrides or {}))
    if topics is not None:
        raise CoopenvError(f"--map {topics}: is for ROS bags, {text} is none")
    if overrides:
        raise CoopenvError(f"--set {next(iter(overrides))}: {text} is recorded, it has no scenario to change")
    if kind is Kind.LOG:
        if not Path(text).is_file():
            raise CoopenvError(f"no such log file: {text}")
        return LogFile(Path(text).stem, Path(text))
    return Robots(text, data)


def variants_of(source: Source, asked: str | None) -> tuple[str, ...]:
    """Return the variants to run: names with commas between, `all` that there can be, or None for the usual ones.

    Raises:
        CoopenvError: there is none of that name, or the source cannot have it.
    """
    added = tuple(variant.name for variant in source.added)
    if asked is None:
        return (*source.usual, *(name for name in added if _can_have(source, name)))
    names = tuple(dict.fromkeys(name.strip() for name in asked.split(",")))
    if names == (ALL,):
        return tuple(name for name in source.variants if not source.obstacle(name))
    names = tuple(dict.fromkeys((*names, *added)))
    for name in names:
        if name not in source.variants:
            known = ", ".join((*source.variants, ALL))
            raise CoopenvError(f"unknown variant '{name}'{suggest(name, list(source.variants))}; known: {known}")
        _can_have(source, name)
    return names


def _can_have(source: Source, variant: str) -> bool:
    """Return that a source can have a variant, or raise a CoopenvError."""
    if reason := source.obstacle(variant):
        raise CoopenvError(f"variant '{variant}': {reason}")
    return True
