"""Figures are drawn without a warning, most of them of one run."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from coopenv.estimation.trajectory import Trajectory
from tests.helpers.synthetic import make_trajectory


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """Turn warnings into errors, except those of Matplotlib's own code and of scenes with blind vehicles."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="matplotlib|pyparsing")
        warnings.filterwarnings("ignore", "vehicle_.* fewer than three neighbours")  # in some shipped environments
        yield


@pytest.fixture(scope="module")
def run() -> Trajectory:
    return make_trajectory(noise=0.02)


@pytest.fixture
def unwritten(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Lay figures out without rendering them where they are saved, and return them."""
    drawn: list[Figure] = []

    def save(figure: Figure, path: Path, **_: object) -> None:
        figure.draw_without_rendering()
        drawn.append(figure)
        path.touch()

    monkeypatch.setattr(Figure, "savefig", save)
    return drawn
