"""The closed-form update beside the one that Stable-Baselines3 differentiates itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy

import coopenv
from coopenv.api.trainers import sb3
from coopenv.api.trainers.sb3 import ActingRowsBuffer, product
from coopenv.training.settings import Ppo, Settings, TrainingPlan
from coopenv.training.trainer import Trainer
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)


class Original(Trainer):
    """The same training with SB3's own classes."""

    kinds = (PPO, ActorCriticPolicy, ActingRowsBuffer)


class Figures(Logger):
    """Keeps the last figures that were recorded."""

    def __init__(self) -> None:
        super().__init__(None, [])
        self.kept: dict[str, Any] = {}

    def record(self, key: str, value: Any, exclude: Any = None) -> None:
        self.kept[key] = value


def trained(kind: type[Trainer], updates: int, **ppo: Any) -> tuple[Trainer, dict[str, Any]]:
    """Return a training after some updates, with the figures of the last one."""
    small = {"vehicles": 16, "decisions": 16, "minibatches": 2, "epochs": 2, **ppo}
    trainer = kind(TrainingPlan(FOUR_WAY, Settings(ppo=Ppo(**small)), seed=1), coopenv.load_scenario(FOUR_WAY), 1)
    figures = Figures()
    trainer.model.set_logger(figures)
    trainer.begin()
    for _ in range(updates):
        trainer.update()
    return trainer, figures.kept


@pytest.mark.parametrize(
    "ppo",
    [
        {},
        {"hidden": (32,), "entropy": 0.02, "value_weight": 0.7},
        {"hidden": (24, 16, 8), "clip": 0.001, "max_gradient": 0.01},  # most ratios and all gradients are clipped
        {"minibatches": 256},  # of a row or two
    ],
)
def test_an_update_is_that_of_sb3(ppo: dict[str, Any]) -> None:
    """From the same seed, weights, moments of Adam, rollout and logged figures are the same after two updates."""
    (lean, found), (original, expected) = trained(Trainer, 2, **ppo), trained(Original, 2, **ppo)
    start = trained(Original, 0, **ppo)[0].model.policy.state_dict()
    assert type(lean.model) is not type(original.model)
    for name in ("actions", "values", "log_probs", "advantages"):
        ours, theirs = (getattr(trainer.model.rollout_buffer, name) for trainer in (lean, original))
        assert ours == pytest.approx(theirs, abs=2e-4), name
    for name, theirs in original.model.policy.state_dict().items():
        change = float((theirs - start[name]).abs().max())
        assert change > 1e-4, name
        assert lean.model.policy.state_dict()[name].numpy() == pytest.approx(theirs.numpy(), abs=0.01 * change), name
    ours, theirs = (trainer.model.policy.optimizer.state_dict()["state"] for trainer in (lean, original))
    assert ours.keys() == theirs.keys()
    for index, moments in theirs.items():
        for name, values in moments.items():
            scale = float(values.abs().max())
            assert ours[index][name].numpy() == pytest.approx(values.numpy(), abs=0.01 * scale), (index, name)
    assert found.keys() == expected.keys()
    for name in (name for name in expected if name.startswith("train/")):
        assert found[name] == pytest.approx(expected[name], rel=5e-3, abs=1e-4), name


@pytest.mark.parametrize("available", [True, False])
def test_products_are_those_of_float64(available: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of transposed views as well, with oneDNN and without."""
    if available and not (sb3.ONEDNN and torch.backends.mkldnn.is_available()):
        pytest.skip("this torch has no oneDNN")
    monkeypatch.setattr(sb3, "onednn_pays", lambda: available)
    rng = np.random.default_rng(1)
    rows, weight, bias = (torch.from_numpy(rng.normal(size=n).astype(np.float32)) for n in ((300, 40), (9, 40), 9))
    exact = rows.double() @ weight.double().t()
    assert product(rows, weight, bias).numpy() == pytest.approx((exact + bias).numpy(), abs=1e-4)
    turned = weight.t().contiguous().t(), rows.t().contiguous().t()
    assert product(turned[1], turned[0]).numpy() == pytest.approx(exact.numpy(), abs=1e-4)


@pytest.mark.parametrize(
    ("processor", "built", "pays"),
    [("AuthenticAMD", True, True), ("AuthenticAMD", False, False), ("GenuineIntel", True, False), (None, True, False)],
)
def test_onednn_multiplies_on_amd_alone(
    processor: str | None, built: bool, pays: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sb3, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(sb3, "ONEDNN", print)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: built)
    if processor is not None:
        sb3.CPUINFO.write_text(f"vendor_id\t: {processor}\n")
    sb3.onednn_pays.cache_clear()
    assert sb3.onednn_pays() is pays
    sb3.onednn_pays.cache_clear()
