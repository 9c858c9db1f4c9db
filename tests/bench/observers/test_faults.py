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
    DIRECTION,
    VARIANTS,
    usual_sender,
    variant_of,
    with_delay,
    with_loss,
    with_wrong_association,
    without_landmarks,
)
from coopenv.observers import Message, Recording, run
from coopenv.observers.contract import Setup
from coopenv.observers.error_state_filters import MekfCovariance
from coopenv.observers.interference import Interference, altered
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
    after, again = (VARIANTS[name].applied(made(), 3) for _ in range(2))
    assert changed(made(), after) == arrays and not changed(after, again)
    assert (after.interference is not None) == (name == "lying_neighbour")
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
    assert changed(after, made()) == {"bearings", "visible"}


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


def received(recording: Recording) -> list[tuple[float, Message]]:
    Listens.heard = []
    run(Listens, recording)
    return Listens.heard


def test_followers_receive_the_lie_and_the_sender_does_not_change() -> None:
    assert usual_sender(made()) == 1
    lying = variant_of("vehicle_2:lie=jump:5@2,std=0.01").applied(made(), 0)
    for (time, honest), (_, false) in zip(received(made()), received(lying), strict=True):
        assert honest.position is not None and false.position is not None and false.covariance is not None
        offset = 5.0 * DIRECTION if time >= 2.0 - 1e-9 else np.zeros(3)
        assert_allclose(false.position - honest.position, offset, atol=1e-12)
        if time >= 2.0 - 1e-9:
            assert_array_equal(false.covariance, 0.01**2 * np.eye(3))
    honest, lied = run(MekfCovariance, made()), run(MekfCovariance, lying)
    assert_array_equal(lied.position[:, :2], honest.position[:, :2])
    assert (lied.position[-1, 2:] != honest.position[-1, 2:]).any(axis=-1).all()
    assert_array_equal(lied.bytes_per_second, honest.bytes_per_second)


@pytest.mark.parametrize(
    ("word", "keys"),
    [
        ("jump:3", {"kind": "jump", "offset": 3.0}),
        ("drift:0.5", {"kind": "drift", "speed": 0.5}),
        ("replay:0.3", {"kind": "replay", "age": 0.3}),
    ],
)
def test_lies_on_a_recording_are_those_of_a_scenario(word: str, keys: dict[str, float | str]) -> None:
    lie = {**keys, "start": 0.33, "std": 0.1, "direction": list(DIRECTION)}
    overrides = {"horizon": 1.0, "vehicles.vehicle_3.faults": {"lie": lie}}
    expected = record(coopenv.load_scenario("busy_intersection", overrides), 0).interference
    found = variant_of(f"vehicle_3:lie={word}@33%,std=0.1").applied(made(horizon=1.0), 0).interference
    for field in fields(Interference):
        assert_allclose(getattr(found, field.name), getattr(expected, field.name), atol=1e-6, err_msg=field.name)


def test_an_observer_adapts_its_own_entries_to_a_lie() -> None:
    class Own:
        def tampered(self, message: Message) -> Message:
            return replace(message, extra={"twice": 2.0 * message.position})

    shift = np.array([3.0, 4.0, 0.0])
    assert_array_equal(altered(Own(), Message(position=np.ones(3)), shift).extra["twice"], [8.0, 10.0, 2.0])
    bare = Message(position=np.ones(3), covariance=np.eye(6, dtype=np.float32))
    bare = altered(object(), bare, shift, std=0.01)
    assert bare.covariance is not None and bare.covariance.shape == (6, 6) and bare.rotation is None
    assert bare.covariance.dtype == np.float32  # a lie takes no more bytes


def test_nobody_to_lie_to() -> None:
    lonely = replace(made(), setups=tuple(replace(s, targets=np.arange(3)) for s in made().setups))
    with pytest.raises(CoopenvError, match="no vehicle has another one"):
        usual_sender(lonely)
