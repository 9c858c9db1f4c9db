"""Faults change what they name and nothing else; their rates are those that are announced."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binom

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.bench.observers.faults import (
    FAULTS,
    Lie,
    liar,
    with_delay,
    with_loss,
    with_wrong_association,
    without_landmarks,
)
from coopenv.observers import Message, Recording, run
from coopenv.observers.contract import Setup
from coopenv.observers.error_state_filters import MekfCovariance
from coopenv.runs.recorder import record


@cache
def made(**overrides: float) -> Recording:
    options = {key.replace("__", "."): value for key, value in overrides.items()}
    return record(coopenv.load_scenario("busy_intersection", {"horizon": 5.0, **options}), 0)


def changed(before: Recording, after: Recording) -> set[str]:
    arrays = [f.name for f in fields(Recording) if isinstance(getattr(before, f.name), np.ndarray)]
    return {a for a in arrays if not np.array_equal(getattr(before, a), getattr(after, a), equal_nan=True)}


@pytest.mark.parametrize(
    ("name", "arrays"),
    [
        ("nominal", set()),
        ("v2x_loss", {"inbox_tick"}),
        ("v2x_delay", {"inbox_tick"}),
        ("wrong_association", {"bearings"}),
        ("lying_neighbour", set()),
        ("landmarks_lost", {"bearings", "visible"}),
    ],
)
def test_a_fault_changes_what_it_names(name: str, arrays: set[str]) -> None:
    after, lie = FAULTS[name].applied(made(), 3)
    again, _ = FAULTS[name].applied(made(), 3)
    assert changed(made(), after) == arrays and not changed(after, again)
    assert (lie is not None) == (name == "lying_neighbour")
    assert after.truth is made().truth


def test_the_delay_is_the_radio_s() -> None:
    """The recorded world with the same delay in its radio delivers at the same ticks."""
    leaders_first = made(v2x__delay=12)
    for receiver, setup in enumerate(made().setups):
        for target in setup.targets[setup.targets >= setup.landmarks]:
            sender = int(target) - setup.landmarks
            assert_array_equal(
                with_delay(made(), 0.2).inbox_tick[:, receiver, sender], leaders_first.inbox_tick[:, receiver, sender]
            )
    assert (with_delay(made(), 100.0).inbox_tick == -1).all()


def test_messages_are_lost_independently() -> None:
    sent, heard = made().inbox_tick[:, 1, 0], with_loss(made(), 0.3, 1).inbox_tick[:, 1, 0]
    arrived = np.diff(heard, prepend=-1) > 0
    low, high = binom.ppf([0.001, 0.999], len(sent), 0.7)
    assert low <= arrived.sum() <= high
    assert_array_equal(heard[arrived], sent[arrived])  # those that arrive are the ones of that tick
    assert_array_equal(with_loss(made(), 0.0).inbox_tick, made().inbox_tick)
    assert (with_loss(made(), 1.0).inbox_tick == -1).all()


def test_bearings_are_swapped_within_their_frame() -> None:
    after = with_wrong_association(made(), 0.05, 1)
    wrong = (after.bearings != made().bearings).any(axis=-1) & made().visible
    n = int(made().visible.sum())
    assert abs(wrong.sum() / n - 0.05) < 4 * np.sqrt(2 * 0.05 / n) + 0.002  # they come in pairs
    for k, i in np.argwhere(wrong.any(axis=-1)):
        seen = made().visible[k, i]
        before, now = (sorted(map(tuple, r.bearings[k, i, seen])) for r in (made(), after))
        assert before == now


def test_a_single_bearing_keeps_its_identity() -> None:
    alone = np.zeros_like(made().visible)
    alone[:, :, 0] = made().visible[:, :, 0]
    lonely = replace(made(), visible=alone, bearings=np.where(alone[..., None], made().bearings, np.nan))
    assert not changed(lonely, with_wrong_association(lonely, 1.0))


def test_landmarks_are_lost_for_a_while() -> None:
    after = without_landmarks(made(), 1.0, 2.0)
    during = (made().t >= 1.0) & (made().t < 3.0)
    assert during.sum() == 120
    assert not after.visible[during, :, :3].any() and np.isnan(after.bearings[during, :, :3]).all()
    assert_array_equal(after.visible[:, :, 3:], made().visible[:, :, 3:])
    assert_array_equal(after.visible[~during], made().visible[~during])
    assert changed(without_landmarks(made()), made()) == {"bearings", "visible"}


class Listens(MekfCovariance):
    """Keeps what vehicle 3 hears of vehicle 2."""

    heard: list

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.me = setup.vehicle

    def update(self, tick):
        if self.me == 2 and 4 in tick.messages:
            Listens.heard.append((tick.time - tick.messages[4].age, tick.messages[4].message))
        return super().update(tick)


def told(lie: Lie | None) -> list[tuple[float, Message]]:
    Listens.heard = []
    run(Listens, made(), lie)
    return Listens.heard


def test_followers_hear_the_lie_and_the_liar_does_not_change() -> None:
    assert liar(made()) == 1
    lie = Lie(1, 2.0)
    for (time, honest), (_, said) in zip(told(None), told(lie), strict=True):
        assert honest.position is not None and said.position is not None and said.covariance is not None
        offset = np.array(lie.offset) if time >= 2.0 - 1e-9 else np.zeros(3)
        assert_allclose(said.position - honest.position, offset, atol=1e-12)
        if time >= 2.0 - 1e-9:
            assert_array_equal(said.covariance, lie.std**2 * np.eye(3))
    assert np.linalg.norm(lie.offset) == pytest.approx(5.0) and lie.offset[2] == 0.0
    honest, lied = run(MekfCovariance, made()), run(MekfCovariance, made(), lie)
    assert_array_equal(lied.position[:, :2], honest.position[:, :2])
    assert (lied.position[-1, 2:] != honest.position[-1, 2:]).any(axis=-1).all()
    assert_array_equal(lied.bytes_per_second, honest.bytes_per_second)


def test_an_observer_may_lie_in_its_own_words() -> None:
    class Own:
        def tampered(self, message: Message) -> Message:
            return replace(message, extra={"twice": 2.0 * message.position})

    assert_array_equal(Lie(0, 0.0).broadcast(Own(), Message(position=np.ones(3))).extra["twice"], [8.0, 10.0, 2.0])
    bare = Lie(0, 0.0).broadcast(object(), Message(position=np.ones(3), covariance=np.eye(6, dtype=np.float32)))
    assert bare.covariance is not None and bare.covariance.shape == (6, 6) and bare.rotation is None
    assert bare.covariance.dtype == np.float32  # a lie takes no more bytes


def test_nobody_to_lie_to() -> None:
    lonely = replace(made(), setups=tuple(replace(s, targets=np.arange(3)) for s in made().setups))
    with pytest.raises(CoopenvError, match="none can lie"):
        liar(lonely)
