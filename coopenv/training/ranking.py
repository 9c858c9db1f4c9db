"""The rank of a policy among other drivers in the same held-out worlds, and what it lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

from coopenv.evaluation import Result, ranking_key

Figures = dict[str, float]
"""Figures of a driver by the names of `METRICS`."""
ENOUGH = 0.98
"""Share of arrivals from which on none are named as missing."""


def figures_of(results: Sequence[Result]) -> Figures:
    """Return the figures of a driver."""
    return {result.metric: result.mean for result in results}


@dataclass(frozen=True)
class Ranking:
    """A trained policy among other drivers in the same held-out worlds."""

    own: str
    """Name of the policy."""
    drivers: dict[str, Figures]
    """Figures of all drivers by name, the policy among them."""
    notes: tuple[str, ...] = ()
    """Further remarks on the training."""

    @property
    def order(self) -> list[str]:
        """The names, the best driver first."""
        return sorted(self.drivers, key=lambda name: (*ranking_key(self.drivers[name]), name != self.own))

    @property
    def missing(self) -> list[str]:
        """Shortcomings of the trained policy beside the drivers that rank before it, or of its arrivals."""
        own, found = self.drivers[self.own], list[str]()
        for name in self.order[: self.order.index(self.own)]:
            other, metric, unit = self.drivers[name], "e95_m", "cm e95"
            if ranking_key(own)[0] > ranking_key(other)[0]:
                fewer = own["arrival_rate"] < other["arrival_rate"]
                metric, unit = ("arrival_rate", "% arrive") if fewer else ("collision_rate", "% collide")
            found.append(f"worse than {name}: {100 * own[metric]:.3g} against {100 * other[metric]:.3g} {unit}")
        if not found and own["arrival_rate"] < ENOUGH:
            found.append(f"{100 * own['arrival_rate']:.3g} % arrive, {100 * ENOUGH:g} % should")
        return found

    @property
    def line(self) -> str:
        """The ranking, and what is missing, on one line."""
        drivers = ", ".join(
            f"{name} ({100 * self.drivers[name]['arrival_rate']:.3g} % arrive, e95 "
            f"{100 * self.drivers[name]['e95_m']:.3g} cm)"
            for name in self.order
        )
        place = f"Rank {1 + self.order.index(self.own)} of {len(self.drivers)} in held-out worlds: {drivers}"
        return f"{place}. {'; '.join(self.missing)}; more steps (--from)" if self.missing else place
