"""Runs numbered cases in a process of their own, so that a crash or hang is a failure of one case and no more.

A module of cases has a function `case(number)` that returns how the input was taken ("accepted", "refused", ...) and
raises when anything is wrong, and may have `prepare()`.
"""

from __future__ import annotations

import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from coopenv import CoopenvError
from coopenv.base.sections import TOO_DEEP

HANG_S = 10.0
"""Without a word from a case."""
START_S = 900.0
"""Without a word from the preparation: kernels may have to be compiled."""


@dataclass
class Outcome:
    """What came of some cases."""

    taken: Counter[str] = field(default_factory=Counter)
    """How often which word was returned."""
    failures: dict[int, str] = field(default_factory=dict)
    """Case to what went wrong."""
    longest_s: float = 0.0
    """Of one case that came to an end."""


def run_cases(module: str, numbers: Sequence[int], hang_s: float | None = None) -> Outcome:
    """Run cases of a module, beginning anew after each one that takes the process along."""
    outcome, left, spawn = Outcome(), [*numbers], get_context("spawn")
    while left:
        words, sender = spawn.Pipe(duplex=False)
        child = spawn.Process(target=_run, args=(module, left, sender), daemon=True)
        child.start()
        sender.close()
        try:
            assert words.poll(START_S) and words.recv() == "ready", f"{module}: cannot be prepared"
            while left:
                number, begin = left.pop(0), time.monotonic()
                if not words.poll(HANG_S if hang_s is None else hang_s):
                    outcome.failures[number] = "hangs"
                    break
                try:
                    word, failure = words.recv()
                except EOFError:
                    child.join()
                    outcome.failures[number] = f"ended the process ({child.exitcode})"
                    break
                if failure:
                    outcome.failures[number] = failure
                else:
                    outcome.taken[word] += 1
                    outcome.longest_s = max(outcome.longest_s, time.monotonic() - begin)
        finally:
            child.kill()
    return outcome


def _run(module: str, numbers: Sequence[int], words: Connection) -> None:
    """Send "ready", and then of each case how it was taken and what went wrong."""
    cases = import_module(module)
    getattr(cases, "prepare", lambda: None)()
    words.send("ready")
    for number in numbers:
        try:
            words.send((cases.case(number), ""))
        except Exception:
            words.send(("", traceback.format_exc(limit=-6)))


def taken(read: Callable[[], Any], use: Callable[[Any], None], most: int = 600) -> str:
    """Return how input is taken: refused in one line of at most so many characters, or else used."""
    try:
        made = read()
    except CoopenvError as error:
        message = str(error)
        assert message.isprintable() and len(message) <= 600, message
        assert len(message) <= most or "known:" in message or TOO_DEEP in message, message
        return "refused"
    try:
        use(made)
    except CoopenvError as error:
        return "failed: " + str(error)[:60]
    return "accepted"


def go_through(env: Any, steps: int = 10**6, seed: int | None = None) -> None:
    """Step an environment after its reset, with actions of zero or drawn by a seed; nothing may be NaN."""
    draw = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed or 0)
    for _ in range(steps):
        assert all(np.isfinite(row).all() for row in observations.values()) and np.isfinite(env.state()).all()
        if not env.agents:
            return
        largest = 0.0 if seed is None else 1.0
        actions = {agent: draw.uniform(-largest, largest, 2).astype(np.float32) for agent in env.agents}
        observations, rewards, *_ = env.step(actions)
        assert np.isfinite(list(rewards.values())).all(), rewards
