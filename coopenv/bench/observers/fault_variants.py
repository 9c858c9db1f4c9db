"""Variants with faults that have parameters: what `--fault` asks for, checked against an environment."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.bench.observers.fault_grammar import Part, parts_of
from coopenv.bench.observers.fault_knobs import knob_of
from coopenv.bench.observers.faults import Lie
from coopenv.observers.recording import Recording
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.topology import neighbour_sets, processing_order


@dataclass(frozen=True)
class FaultVariant:
    """One variant: as it is written, and what it does; small enough to travel to a worker."""

    name: str
    parts: tuple[Part, ...]
    scenario: Scenario | None = None
    """The world with those faults that are keys of a scenario; None: there are none."""

    @property
    def summary(self) -> str:
        """What it is, in words."""
        return "; ".join(_in_words(part) for part in self.parts)

    @property
    def lies(self) -> bool:
        """Whether it needs somebody who is listened to."""
        return any(knob_of(part).lie is not None for part in self.parts)

    def applied(self, recording: Recording, seed: int) -> tuple[Recording, Lie | None]:
        """Return the changed record, and the lie for `runner.run`; `recording` is of the variant's scenario."""
        lie = None
        for part in self.parts:
            knob = knob_of(part)
            if knob.change is not None:
                recording = knob.change(recording, part, seed)
            if knob.lie is not None:
                lie = knob.lie(recording, part)
        return recording, lie


def variants_with(faults: Iterable[str]) -> tuple[FaultVariant, ...]:
    """Read faults, one variant each.

    Raises:
        CoopenvError: one is not written as it has to be, or there is no such fault.
    """
    made = tuple(FaultVariant(text.strip(), parts_of(text)) for text in dict.fromkeys(faults))
    for variant in made:
        if sum(knob_of(part).lie is not None for part in variant.parts) > 1:
            raise CoopenvError(f"--fault {variant.name}: one lying_neighbour at most; `lie=jump` may be of several")
    return made


def with_world(variant: FaultVariant, text: str, scenario: Scenario, overrides: Mapping[str, Any]) -> FaultVariant:
    """Return a variant with the world that has its faults, where any is of the world.

    Args:
        variant: which one.
        text: name or file of the environment.
        scenario: the environment with its overrides.
        overrides: these.

    Raises:
        CoopenvError: as for `overrides_of`, or a value is not possible.
    """
    keys = overrides_of(variant, scenario)
    return replace(variant, scenario=load_scenario(text, {**overrides, **keys})) if keys else variant


def overrides_of(variant: FaultVariant, scenario: Scenario) -> dict[str, Any]:
    """Return the dotted keys of a scenario that realise a variant's faults.

    Raises:
        CoopenvError: no such vehicle, or nobody to lie to, or errors of sensors without noise.
    """
    found: dict[str, Any] = {}
    for part in variant.parts:
        keys = knob_of(part).keys
        check_vehicles(part, scenario.vehicle_names)
        for section, values in ({} if keys is None else keys(part)).items():
            for name in _who(part, scenario):
                if section.partition(".")[0] in ("noise", "camera") and not _noisy(scenario, name):
                    raise CoopenvError(f"{part.where}: {part.name} needs noise.enabled = true, which is off")
                found |= {f"vehicles.{name}.{section}.{key}": value for key, value in values.items()}
    return found


def check_vehicles(part: Part, names: list[str]) -> None:
    """Refuse vehicles that there are not. Raises CoopenvError: one that names those that there are."""
    for name in part.who:
        if name not in names:
            raise CoopenvError(
                f"{part.where}: unknown vehicle '{name}'{suggest(name, names)}; there are {listed(names)}"
            )


def check_recorded(variant: FaultVariant, recording: Recording) -> None:
    """Refuse what a record that is already there cannot have. Raises CoopenvError."""
    for part in variant.parts:
        if knob_of(part).keys is not None:
            raise CoopenvError(f"{part.where}: {part.name} is a fault of a simulated world, this one is recorded")
        check_vehicles(part, [setup.name for setup in recording.setups])


def _who(part: Part, scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the vehicles that have a fault."""
    names = scenario.vehicle_names
    if part.who or not knob_of(part).of_one:
        return part.who or tuple(names)
    sets, L = neighbour_sets(scenario), len(scenario.landmarks)
    leaders = [i for i in processing_order(scenario, sets) if any(L + i in targets for targets in sets)]
    if not leaders:
        raise CoopenvError(f"{part.where}: no vehicle has another one as its neighbour; name one, {part.name}=...@NAME")
    return (names[leaders[min(1, len(leaders) - 1)]],)


def _noisy(scenario: Scenario, name: str) -> bool:
    return scenario.noises[scenario.vehicle_names.index(name)].enabled


def _in_words(part: Part) -> str:
    knob = knob_of(part)
    whose = f" ({', '.join(part.who)})" if part.who else ""
    more = "".join(f", {key} {value:g}" for key, value in part.options.items())
    return f"{part.name} {part.value}{more}: {knob.value.lower()} {knob.about}{whose}"
