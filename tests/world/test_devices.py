"""The same seeds give the same worlds on every device, up to rounding; on CUDA these tests run where a GPU is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import coopenv
from coopenv.backends.simulated import Simulated
from coopenv.world.launch import start_warp
from tests.helpers.four_way import FOUR_WAY

start_warp()
CUDA = pytest.param("cuda:0", marks=pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device"))
OVERRIDES: dict[str, Any] = {"horizon": 3.0}


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("name", ["busy_intersection", FOUR_WAY])
def test_worlds_agree_with_the_cpu(name: str, device: str) -> None:
    scenario = coopenv.load_scenario(name, OVERRIDES)
    worlds = [Simulated(scenario).world(5, "float64", where, None) for where in ("cpu", device)]
    actions = np.random.default_rng(0).uniform(-1, 1, (5, len(scenario.vehicles), 2))
    for world in worlds:
        world.reset(range(5))
        world.actions.assign(actions)
        for _ in range(10):
            world.advance(scenario.ticks_per_decision)
    here, there = (world.get_state() for world in worlds)
    for name_of, value in here.items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(there[name_of], value, rtol=1e-7, atol=1e-8, err_msg=name_of)
        else:
            np.testing.assert_array_equal(there[name_of], value, err_msg=name_of)


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_tensors_share_memory_and_agree_with_numpy(device: str, autoreset: str) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra 'train'")
    options: dict[str, Any] = {"num_worlds": 4, "autoreset": autoreset, "overrides": OVERRIDES}
    tensors = coopenv.make_vec(FOUR_WAY, device=device, arrays="torch", **options)
    arrays = coopenv.make_vec(FOUR_WAY, **options)
    seen, _ = tensors.reset(seed=3)
    assert str(seen.device) == device and seen.dtype == torch.float32
    np.testing.assert_allclose(seen.cpu().numpy(), arrays.reset(seed=3)[0], atol=1e-4)
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = rng.uniform(-1, 1, (16, 2)).astype(np.float32)
        given = tensors.step(torch.as_tensor(actions, device=device))
        expected = arrays.step(actions)
        assert given[0].data_ptr() == seen.data_ptr()
        assert given[2].cpu().numpy().tolist() == expected[2].tolist()
        assert given[3].cpu().numpy().tolist() == expected[3].tolist()
        np.testing.assert_allclose(given[0].cpu().numpy(), expected[0], atol=2e-3)
        np.testing.assert_allclose(given[1].cpu().numpy(), expected[1], atol=2e-3)
