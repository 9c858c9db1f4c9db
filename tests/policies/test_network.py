"""Learned policies without torch: what they compute, and what they refuse."""

from __future__ import annotations

import warnings
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

import coopenv
from coopenv.api.terms.layout import observation_layout, settings_of_meaning
from coopenv.base.errors import AgentWarning
from coopenv.policies import find_agent, load_agent
from coopenv.policies.loader import NetworkCard
from coopenv.policies.network import Network, layout_hash, layout_tables
from tests.helpers.four_way import FOUR_WAY

ENV = FOUR_WAY
Tensors = dict[str, np.ndarray]


def tensors_for(inputs: int, outputs: int = 2) -> Tensors:
    rng = np.random.default_rng(0)
    sizes = [inputs, 8, 8, outputs]
    tensors: Tensors = {"observation.mean": rng.normal(size=inputs), "observation.std": rng.uniform(0.1, 1.0, inputs)}
    for i, (before, after) in enumerate(pairwise(sizes)):
        tensors[f"layers.{i}.weight"] = rng.normal(size=(after, before)) / before**0.5
        tensors[f"layers.{i}.bias"] = rng.normal(size=after)
    tensors["log_std"] = np.zeros(outputs)
    return {name: values.astype(np.float32) for name, values in tensors.items()}


def write(folder: Path, tensors: Tensors, overrides: dict[str, Any] | None = None, **changes: Any) -> NetworkCard:
    """Write weights and return a card for an environment's layout."""
    scenario = coopenv.load_scenario(ENV, overrides)
    observation, action = layout_tables(observation_layout(scenario))
    settings = settings_of_meaning(scenario, observation)
    data = save(tensors)
    (folder / "weights.safetensors").write_bytes(data)
    values = {"sha256": sha256(data).hexdigest(), "layout": layout_hash(observation, action, settings), **changes}
    fields: dict[str, Any] = {"observation": observation, "action": action, "settings": settings}
    return NetworkCard(weights="weights.safetensors", clip=5.0, **{**fields, **values})


def test_is_a_multilayer_perceptron_of_normalised_observations(tmp_path: Path) -> None:
    scenario, tensors = coopenv.load_scenario(ENV), tensors_for(132)
    policy = Network(scenario, folder=tmp_path, network=write(tmp_path, tensors))
    observations = np.random.default_rng(1).uniform(-1, 1, (7, 132)).astype(np.float32)
    t = {name: values.astype(np.float64) for name, values in tensors.items()}
    for observation, action in zip(observations, policy(observations), strict=True):
        x = np.clip((observation - t["observation.mean"]) / t["observation.std"], -5.0, 5.0)
        for i in range(2):
            x = np.tanh(t[f"layers.{i}.weight"] @ x + t[f"layers.{i}.bias"])
        x = np.clip(t["layers.2.weight"] @ x + t["layers.2.bias"], -1.0, 1.0)
        assert action == pytest.approx(x, abs=1e-5)


def test_warns_once_beyond_what_training_has_seen(tmp_path: Path) -> None:
    scenario, tensors = coopenv.load_scenario(ENV), tensors_for(132)
    seen = {"goal": (-0.5, 0.5), "velocity": (-1.0, 1.0)}
    card = write(tmp_path, tensors).model_copy(update={"seen": seen})
    rows = np.full((60, 132), 0.2, np.float32)
    with warnings.catch_warnings(action="error"):
        policy = Network(scenario, folder=tmp_path, network=card)
        for _ in range(5):
            policy(rows)
            policy(np.zeros_like(rows))  # of vehicles that have ended
    with pytest.warns(AgentWarning, match=r"agent \w+: 50% of the entries of 'goal' are beyond those of its training"):
        policy = Network(scenario, folder=tmp_path, network=card)
        for values in (rows, 3.0 * rows, rows, 3.0 * rows):
            policy(values)


def test_drives_where_there_is_more_to_see(tmp_path: Path) -> None:
    """Fields are found by name: one trained without bearings gives the same actions where bearings are shown."""
    few = {"observation.include": ["goal", "odometry"]}
    small, large = coopenv.load_scenario(ENV, few), coopenv.load_scenario(ENV)
    card = write(tmp_path, tensors_for(observation_layout(small).size), few)
    narrow, wide = (Network(scenario, folder=tmp_path, network=card) for scenario in (small, large))
    shown = coopenv.parallel_env(ENV).reset(seed=0)[0]
    hidden = coopenv.parallel_env(ENV, overrides=few).reset(seed=0)[0]
    assert np.array_equal(wide(np.stack(list(shown.values()))), narrow(np.stack(list(hidden.values()))))


def test_reads_larger_scales_as_those_of_its_training(tmp_path: Path) -> None:
    """What lies beyond the training's scale was clipped there, and is clipped now."""
    scenario, tensors = coopenv.load_scenario(ENV), tensors_for(132)
    card, goal = write(tmp_path, tensors), observation_layout(scenario)["goal"]
    wider = coopenv.load_scenario(ENV, {"observation.scales.goal": 3.0 * goal.scale})
    here, there = (Network(s, folder=tmp_path, network=card) for s in (scenario, wider))
    rows = np.random.default_rng(2).uniform(-1, 1, (7, 132)).astype(np.float32)
    clipped = rows.copy()
    clipped[:, goal.start : goal.stop] = np.clip(3.0 * rows[:, goal.start : goal.stop], -1.0, 1.0)
    assert there(rows) == pytest.approx(here(clipped), abs=1e-5)
    assert np.abs(there(rows) - here(rows)).max() > 1e-3


WHOLE = {"observation.include": ["route", "clearance", "uncertainty", "messages", "quality"]}
SLOW = {**WHOLE, "action.longitudinal": "acceleration"}


@pytest.mark.parametrize(
    ("common", "overrides", "message"),
    [
        ({}, {"observation.position_scale": 7.0}, r"another observation: 'estimate_position' had scale 8\.0"),
        ({}, {"observation.include": ["odometry", "goal"]}, r"'estimate_position' is not in this environment"),
        ({}, {"dynamics.max_speed": 1.5}, r"another action: 'speed' had high 1\.0 and has 1\.5 here"),
        ({}, {"action.longitudinal": "acceleration"}, r"another action: 'speed' is not in this environment"),
        (WHOLE, {"observation.centers.route_offset": 0.8}, r"'route_offset' had center 0\.0 and has 0\.8 here"),
        (WHOLE, {"observation.route_step": 1.0}, r"another observation\.route_step, 0\.5, and it is 1\.0 here"),
        (WHOLE, {"observer.gramian_window": 2.0}, r"another observer\.gramian_window, 1\.0, and it is 2\.0 here"),
        (WHOLE, {"observer.gramian_distance": 3.0}, r"another observer\.gramian_distance, None, and it is 3\.0 here"),
        (WHOLE, {"reward.observability_floor": 1e-4}, r"another reward\.observability_floor, 1e-05, and it is 0\.0001"),
        (WHOLE, {"rates.decision": 5.0}, r"another rates\.decision, 10\.0, and it is 5\.0 here"),
        (SLOW, {"dynamics.max_speed": 1.5}, r"another dynamics\.max_speed, 1\.0"),
    ],
)
def test_settings_that_change_the_meaning_of_entries_are_refused_with_both_values(
    common: dict[str, Any], overrides: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """The size of the observation may be the same: without this an agent would drive by what it misreads."""
    scenario = coopenv.load_scenario(ENV, common)
    card = write(tmp_path, tensors_for(observation_layout(scenario).size), common)
    Network(scenario, folder=tmp_path, network=card)
    with pytest.raises(coopenv.CoopenvError, match=message):
        Network(coopenv.load_scenario(ENV, {**common, **overrides}), folder=tmp_path, network=card)


def test_settings_of_fields_that_it_does_not_read_may_differ(tmp_path: Path) -> None:
    few = {"observation.include": ["goal", "odometry"]}
    card = write(tmp_path, tensors_for(observation_layout(coopenv.load_scenario(ENV, few)).size), few)
    other = {"observation.include": ["goal", "odometry", "route"], "observation.route_step": 1.0}
    Network(coopenv.load_scenario(ENV, other), folder=tmp_path, network=card)


def without(tensors: Tensors, name: str) -> Tensors:
    return {key: values for key, values in tensors.items() if key != name}


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        (without(tensors_for(132), "layers.1.bias"), "not the weights of a policy"),
        (tensors_for(131), "shapes do not fit 132 observations and 2 entries"),
        (tensors_for(132, 3), "shapes do not fit 132 observations and 2 entries"),
        ({**tensors_for(132), "layers.0.bias": np.full(8, np.nan, np.float32)}, "not finite numbers in float32"),
        ({**tensors_for(132), "observation.std": np.zeros(132, np.float32)}, "shapes do not fit|std"),
    ],
)
def test_bad_weights_are_refused(tensors: Tensors, message: str, tmp_path: Path) -> None:
    card = write(tmp_path, tensors)
    with pytest.raises(coopenv.CoopenvError, match=message):
        Network(coopenv.load_scenario(ENV), folder=tmp_path, network=card)


def test_damaged_foreign_and_missing_files(tmp_path: Path) -> None:
    scenario, card = coopenv.load_scenario(ENV), write(tmp_path, tensors_for(132))
    path = tmp_path / "weights.safetensors"
    data = path.read_bytes()
    for damaged in (data[:1000], b"", b"\x00" * 64, data[:-4]):
        path.write_bytes(damaged)
        with pytest.raises(coopenv.CoopenvError, match=r"weights\.safetensors: damaged, or no weights"):
            Network(scenario, folder=tmp_path, network=card)
    path.write_bytes(data[:-4] + b"\x00\x00\x00\x01")
    with pytest.raises(coopenv.CoopenvError, match=r"not the weights that agent\.toml was written with"):
        Network(scenario, folder=tmp_path, network=card)
    path.unlink()
    with pytest.raises(coopenv.CoopenvError, match=r"weights\.safetensors: cannot be read: No such file"):
        Network(scenario, folder=tmp_path, network=card)
    write(tmp_path, tensors_for(132))
    with pytest.raises(coopenv.CoopenvError, match="layout is not the hash of its tables"):
        Network(scenario, folder=tmp_path, network=card.model_copy(update={"layout": "0" * 16}))


def test_an_incomplete_card_names_the_field(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(
        'title = "x"\ndescription = "y"\nenvironments = []\nentry = "coopenv.policies.network:Network"\n'
        '[network]\nweights = "w"\nsha256 = ""\nlayout = ""\nclip = "far"\nobservation = {}\naction = {}\n'
    )
    with pytest.raises(coopenv.CoopenvError, match=r"agent\.toml: network\.clip: Input should be a valid number"):
        load_agent(tmp_path, coopenv.load_scenario(ENV))


OLD = """
title = "Old"
description = "Of an earlier version."
kind = "learned"
entry = "coopenv.policies.network:Network"
environments = ["{environment}"]
[network]
weights = "weights.safetensors"
sha256 = "0"
layout = "0"
clip = 6.0
{network}
[training]
{training}
"""
NO_CENTER = """settings = {}
observation = { goal = {start = 0, stop = 2, low = -1.0, high = 1.0, scale = 8.0, unit = "m"} }
action = {}"""
NO_SETTINGS = "observation = {}\naction = {}"


@pytest.mark.parametrize(
    ("network", "training", "command"),
    [
        (NO_CENTER, 'environment = "facade"\nseed = 3', "facade --settings old/train.toml --seed 3 --out old --force"),
        (NO_SETTINGS, 'environment = "my.toml"', "old/my.toml --settings old/train.toml --out old --force"),
        (NO_SETTINGS, "", "ENV --settings old/train.toml --out old --force"),
    ],
)
def test_the_error_of_an_earlier_version_names_the_command_of_training(
    network: str, training: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "train.toml").write_text("")
    (tmp_path / "old" / "agent.toml").write_text(OLD.format(environment="facade", network=network, training=training))
    with pytest.raises(coopenv.CoopenvError) as error:
        find_agent("old")
    expected = "old/agent.toml: saved by an earlier version of coopenv; train it anew: coopenv train"
    assert str(error.value) == f"{expected} {command}"


def test_a_card_names_who_drives_alone(tmp_path: Path) -> None:
    scenario, tensors = coopenv.load_scenario(ENV), tensors_for(132)
    plain, careful = (
        Network(scenario, folder=tmp_path, network=write(tmp_path, tensors, **alone))
        for alone in ({}, {"alone": "constant_speed"})
    )
    seen = np.random.default_rng(2).uniform(-1, 1, (len(scenario.vehicles), 132)).astype(np.float32)
    place = observation_layout(scenario)["message_mask"]
    seen[:, place.start : place.stop] = 0.0
    for _ in range(round(scenario.rates.decision)):
        np.testing.assert_array_equal(careful(seen), plain(seen))
    np.testing.assert_allclose(careful(seen), load_agent("constant_speed", scenario)(seen))
    careful.reset(np.ones(len(seen), dtype=bool))
    np.testing.assert_array_equal(careful(seen), plain(seen))
