"""A hundred thousand bad messages: none is accepted, none raises, nothing grows."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from random import Random

from coopenv.cars.gate.core import GateMode, Reason
from coopenv.cars.profile import NEUTRAL
from tests.cars.link.gate.bench import OTHER, STATION, Bench
from tests.cars.link.gate.hostile import messages_of_strangers

WARM, MEASURED, ALL = 80_000, 90_000, 100_000
GROWTH = 4096  # bytes, of what the interpreter keeps for itself


def test_no_bad_message_is_accepted_or_kept() -> None:
    bench = Bench()
    assert bench.arm() is None
    bench.drive(10)
    bad = messages_of_strangers(Random(5), STATION, OTHER, "s1", bench.sequence, lambda: bench.wall)
    reasons: Counter[Reason | None] = Counter()
    used = 0
    for i in range(ALL):
        reasons[bench.gate.arrive(*next(bad))] += 1
        if i == WARM:
            tracemalloc.start()
        elif i == MEASURED:
            used = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - used
    tracemalloc.stop()
    assert None not in reasons
    assert set(reasons) == set(Reason) - {Reason.NOT_ARMED}  # each kind of them has been there
    status = bench.status()
    counts = dict(zip(status.rejections, status.counts.tolist(), strict=True))
    assert counts == {**{str(reason): reasons[reason] for reason in Reason}}
    assert (status.accepted, status.last_sequence) == (10, 10)
    assert grown < GROWTH
    # Not a number in a genuine command has closed it at the first; the station's next command goes on.
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.TIMED_OUT
    assert bench.drive(1).speed > 0.0
