"""Without its extra, a trainer's face says in one line what to install."""

from __future__ import annotations

import importlib
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "needed", "extra"),
    [
        ("coopenv.api.trainers.sb3", "stable_baselines3.common.vec_env", "train"),
        ("coopenv.api.trainers.rllib", "ray.rllib.env.multi_agent_env", "rllib"),
        ("coopenv.api.trainers.torchrl", "torchrl.envs", "torchrl"),
        ("coopenv.api.trainers.benchmarl", "benchmarl.environments.pettingzoo.common", "benchmarl"),
    ],
)
def test_missing_extra(module: str, needed: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, needed, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(ImportError, match=rf"^{module} needs .+: pip install '\.\[{extra}\]'$"):
        importlib.import_module(module)
