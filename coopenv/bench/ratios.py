"""coopenv against its peers, like with like: the same number of worlds, float32, infos included."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from coopenv.bench.cases import BATCH, COOPENV, SINGLE
from coopenv.bench.measure import Result
from coopenv.bench.peers import VMAS


@dataclass(frozen=True)
class Ratio:
    """coopenv's rate over a peer's."""

    peer: str
    worlds: int
    ours: str
    threads: int
    """Of coopenv; peers have one."""
    env_steps: float
    agent_steps: float
    vehicle_ticks: float
    counted_for_peer: str

    def row(self) -> dict[str, object]:
        """Return the figures as plain data."""
        return asdict(self)


def ratios(results: list[Result]) -> list[Ratio]:
    """Return a ratio for every peer and every number of threads that coopenv was measured with."""
    measured = [r for r in results if not r.problem]
    return [
        Ratio(
            peer.case.name,
            peer.case.worlds,
            ours.case.name,
            ours.case.threads,
            ours.env_steps_per_s / peer.env_steps_per_s,
            ours.agent_steps_per_s / peer.agent_steps_per_s,
            ours.vehicle_ticks_per_s / peer.vehicle_ticks_per_s,
            peer.case.tick,
        )
        for peer in measured
        if peer.case.library != COOPENV.name
        for ours in measured
        if _comparable(ours, peer)
    ]


def _comparable(ours: Result, peer: Result) -> bool:
    """Batches stand against batches, one world with dictionaries or tuples of agents against its like."""
    case = ours.case
    face = BATCH if peer.case.library == VMAS.name else SINGLE
    return (
        case.library == COOPENV.name
        and case.name == face
        and case.worlds == peer.case.worlds
        and case.dtype == "float32"
        and case.infos
    )
