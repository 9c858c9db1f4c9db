"""`python -m benchmarks.receipt`: what it replaces is there, and what it prints."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import receipt


def test_what_is_left_out_is_part_of_the_observer() -> None:
    found = receipt.parts()
    assert not found["nothing"] and len(found) > 10
    assert all(hasattr(module, name) for changes in found.values() for module, name, _ in changes)
    assert {name for changes in found.values() for _, name, _ in changes if name.isupper()} <= {*receipt.numbers()}


class Source(dict[str, np.ndarray]):
    """Records of two sources."""

    def __len__(self) -> int:
        return 2


def test_exclusions_are_noted_with_their_time_and_target() -> None:
    source = Source(exclusions=np.zeros(2, int), target=np.array([-1, 7]))

    def update(tick: SimpleNamespace) -> float:
        source["exclusions"][1] = tick.time >= 2.0
        return float(tick.time)

    setup = SimpleNamespace(targets=np.array([3, 7]))
    watched = receipt.Watched(SimpleNamespace(memory=SimpleNamespace(source=source), setup=setup, update=update))
    assert [watched.update(SimpleNamespace(time=t)) for t in (1.0, 2.0, 3.0)] == [1.0, 2.0, 3.0]
    assert watched.times == [(2.0, 7)] and watched.sees(7) and not watched.sees(4)


def test_unknown_constants_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert receipt.main(["--constants", "FAULT_GAT"]) == 2
    error = capsys.readouterr().err
    assert "FAULT_GAT" in error and "FAULT_GATE" in error and error.count("\n") == 1
