"""Progress: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import io
from pathlib import Path
from time import sleep

import pytest
from rich.console import Console

from coopenv.estimation import compiled
from coopenv.runs import console as module
from coopenv.runs.console import Progress, compile_notice
from coopenv.world import launch


@pytest.fixture
def text(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    monkeypatch.setattr(module, "LINE_PERIOD", 0.01)
    return io.StringIO()


def wait_for(text: io.StringIO, words: str) -> None:
    """Wait until a line says so; the line is written by another thread."""
    while words not in text.getvalue():
        sleep(0.005)


def test_lines_where_there_is_no_terminal(text: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([100.0])
    monkeypatch.setattr(module, "monotonic", lambda: next(clock, 120.0))
    with Progress(Console(file=text, width=20), "simulating a long name", total=4) as progress:
        wait_for(text, "simulating a long name: 20 s\n")
        progress.update(1)
        wait_for(text, "simulating a long name: 25 % after 20 s, about 60 s left\n")
        progress.advance("drawing")
        wait_for(text, "drawing: 50 % after 20 s, about 20 s left\n")


def test_time_left_is_not_told_before_there_is_enough_to_go_by(
    text: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(module, "monotonic", lambda: clock[0])
    monkeypatch.setattr(module, "HINT_FROM", 20.0)
    progress = Progress(Console(file=text), "simulating", total=400)
    progress.__enter__()
    clock[0] = 103.0  # until it begins
    progress.update(0)
    clock[0] = 103.5
    progress.update(1)
    assert progress.line() == "simulating: 0 % after 0 s"
    monkeypatch.setattr(module, "LINE_PERIOD", 10.0)
    clock[0] = 104.8  # of a slow beginning
    assert progress.line() == "simulating: 0 % after 2 s"
    clock[0] = 105.0
    progress.update(20)
    progress.__exit__()
    assert "simulating: 5 % after 2 s, about 38 s left\n" in text.getvalue()
    assert "535" not in text.getvalue() and "199" not in text.getvalue()


def test_in_real_time_the_time_left_is_known(text: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "monotonic", lambda: 100.0)
    with Progress(Console(file=text), "running", total=480, rate=60.0) as progress:
        progress.update(0)
        progress.update(3)
        assert progress.line() == "running: 1 % after 0 s, about 8 s left"


def test_tracked_items_are_counted(text: io.StringIO) -> None:
    with Progress(Console(file=text), "episodes") as progress:
        assert list(progress.track(range(5))) == [0, 1, 2, 3, 4]
        assert progress.line().startswith("episodes: 100 % after ")
        assert list(progress.track(iter("ab"))) == ["a", "b"]


def test_quick_work_says_nothing_where_there_is_no_terminal() -> None:
    text = io.StringIO()
    with Progress(Console(file=text), "quick", total=1) as progress:
        progress.update(1)
    assert text.getvalue() == ""


def test_a_terminal_has_a_bar_that_vanishes(text: io.StringIO) -> None:
    with Progress(Console(file=text, force_terminal=True, width=80), "simulating", total=2) as progress:
        progress.update(1)
        wait_for(text, "simulating")
    assert " % after" not in text.getvalue()
    assert text.getvalue().endswith("\x1b[2K")


def test_an_error_ends_the_lines(text: io.StringIO) -> None:
    with pytest.raises(KeyboardInterrupt), Progress(Console(file=text), "work") as progress:
        raise KeyboardInterrupt
    progress._lines.join(5.0)
    assert not progress._lines.is_alive()


@pytest.fixture
def looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[set[str]]:
    """Let kernels be kept in a folder of their own, with one in it, and return a list of what is found there."""
    looked: list[set[str]] = []
    modules = launch.modules

    def look() -> set[str]:
        looked.append(modules())
        return looked[-1]

    monkeypatch.setattr(module, "COMPILE_NOTICE_AFTER", 0.001)
    monkeypatch.setattr(launch, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(launch, "modules", look)
    (tmp_path / "wp_known_0123456").mkdir()
    return looked


def test_compiling_is_told_once(looks: list[set[str]], tmp_path: Path) -> None:
    text = io.StringIO()
    with compile_notice(Console(file=text)):
        (tmp_path / "wp_new_0123456_p1_t2").mkdir()
        wait_for(text, "compiling kernels (once per machine) ...\n")
        (tmp_path / "wp_newer_0123456").mkdir()
    assert text.getvalue().count("compiling") == 1


def test_loading_what_is_in_the_cache_is_not_compiling(looks: list[set[str]]) -> None:
    text = io.StringIO()
    with compile_notice(Console(file=text)):
        while len(looks) < 10:
            sleep(0.001)
    assert text.getvalue() == ""


def test_functions_of_observers_on_the_host_are_compiled_as_well(
    looks: list[set[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    text, fresh = io.StringIO(), ["found_before"]
    monkeypatch.setattr(compiled, "fresh", fresh)
    with compile_notice(Console(file=text)):
        while len(looks) < 10:
            sleep(0.001)
        assert text.getvalue() == ""
        fresh.append("new")
        wait_for(text, "compiling kernels (once per machine) ...\n")
