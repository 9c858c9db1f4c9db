"""A judge lets everybody drive once and keeps figures, of episodes those of one environment."""

from __future__ import annotations

import gc
from typing import Any
from weakref import ref

import pytest

from coopenv.bench.study import Judge
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, score

AGENTS = ("constant_speed", "route_follower")


def test_figures_stay_and_episodes_go(monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[Any] = []

    def watched(*arguments: Any) -> Episodes:
        episodes = drive(*arguments)
        driven.append(ref(episodes))
        return episodes

    monkeypatch.setattr("coopenv.bench.study.drive", watched)
    judge = Judge(2)

    def told(environment: str) -> tuple[list[Result], list[Difference]]:
        return judge.results(environment, AGENTS[0]), judge.against(environment, *AGENTS)

    square = told("open_square")
    expected = score(driven[0]()), compare_paired(driven[0](), driven[1]())
    assert repr(square) == repr(expected)  # some figures are no numbers, and equal all the same
    facade = told("facade")
    gc.collect()
    assert [episodes() is None for episodes in driven] == [True, True, False, False]
    assert (told("open_square"), told("facade")) == (square, facade)
    assert len(driven) == 4
    judge.results("facade", AGENTS[0], {"horizon": 5.0})
    assert len(driven) == 5
