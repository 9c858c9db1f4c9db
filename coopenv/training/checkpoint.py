"""Checkpoints: all that the next update depends on, in one file without pickle. Needs the extra `train`.

A safetensors file of arrays, whose header holds the plan, how far the training is, and its curve. It is replaced as a
whole, so that a run that is killed while writing keeps the one before.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replacing_file, writing
from coopenv.training.settings import Plan
from coopenv.training.trainer import Trainer

FORMAT = 2
HEADER = "coopenv_checkpoint"
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Outputs:
    """What a training writes besides the agent, as its command line says."""

    onnx: bool = False
    logs: Path | None = None
    """Folder for TensorBoard; None: in the agent's folder."""

    def or_else(self, kept: "Outputs") -> "Outputs":
        """Return them with those of another command line where this one says nothing."""
        return Outputs(self.onnx or kept.onnx, self.logs or kept.logs)


NONE = Outputs()


@dataclass(frozen=True)
class Checkpoint:
    """What a file holds."""

    path: Path
    plan: Plan
    scenario: str
    """JSON of the scenario, to find out whether it is still the same."""
    progress: dict[str, Any]
    curve: list[dict[str, float]]
    arrays: Arrays
    outputs: Outputs


def save(path: Path, trainer: Trainer, curve: list[dict[str, float]], outputs: Outputs = NONE) -> None:
    """Write a checkpoint in the place of the one before.

    Raises:
        OutputError: it cannot be written; the one before is whole.
    """
    header = {
        "format": FORMAT,
        "plan": trainer.plan.document(),
        "scenario": trainer.scenario.model_dump_json(),
        "progress": trainer.progress(),
        "curve": curve,
        "onnx": outputs.onnx,
        "logs": None if outputs.logs is None else str(outputs.logs.absolute()),
    }
    with replacing_file(path) as new, writing(path):
        try:
            save_file(_arrays(trainer), new, metadata={HEADER: json.dumps(header)})
        except SafetensorError as error:  # what the system says of a full disk comes as one of these
            raise OSError(str(error)) from None


def read(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        CoopenvError: there is none, it is damaged, or of another version.
    """
    if not path.is_file():
        raise CoopenvError(f"nothing to resume: there is no {path}")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})[HEADER])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if header["format"] != FORMAT:
            raise CoopenvError(f"{path}: a checkpoint of format {header['format']}, expected {FORMAT}")
        plan = Plan.of_document(header["plan"])
        counts = header["progress"]
        progress = {"steps": int(counts["steps"]), **{name: float(counts[name]) for name in ("seconds", "cpu_seconds")}}
        logs = header.get("logs")  # checkpoints of before there was such an entry go on without
        outputs = Outputs(bool(header.get("onnx")), None if logs is None else Path(logs))
        return Checkpoint(path, plan, header["scenario"], progress, header["curve"], arrays, outputs)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, CoopenvError):
            raise
        raise CoopenvError(f"{path}: damaged, or not a checkpoint ({error}); remove it to start anew") from None


def restore(checkpoint: Checkpoint, trainer: Trainer) -> None:
    """Let a trainer of the same plan go on from a checkpoint.

    Raises:
        CoopenvError: it does not fit: the environment has changed since, or the file has been edited.
    """
    if checkpoint.scenario != trainer.scenario.model_dump_json():
        name = trainer.plan.environment
        raise CoopenvError(f"{checkpoint.path}: {name} has changed since; remove the file to start anew")
    try:
        _restore(checkpoint, trainer)
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise CoopenvError(f"{checkpoint.path}: does not fit: {error}; remove it to start anew") from None
    trainer.continue_at(**checkpoint.progress)


def _arrays(trainer: Trainer) -> Arrays:
    policy, statistics = trainer.model.policy, trainer.env.statistics
    arrays = {f"policy/{name}": values.numpy() for name, values in policy.state_dict().items()}
    for index, moments in policy.optimizer.state_dict()["state"].items():
        arrays |= {f"optimiser/{index}/{name}": values.numpy() for name, values in moments.items()}
    arrays |= {
        "statistics/mean": statistics.mean,
        "statistics/var": statistics.var,
        "statistics/count": np.array(statistics.count),
    }
    _, key, position, *_ = np.random.get_state()
    arrays |= {"random/torch": torch.get_rng_state().numpy(), "random/numpy": np.append(key, np.uint32(position))}
    arrays |= {f"world/{name}": values for name, values in _worlds(trainer).items()}
    return {name: np.array(values, order="C") for name, values in arrays.items()}


def _worlds(trainer: Trainer) -> Arrays:
    """Return the episodes under way; nothing where objects are part of them, so that new ones begin on resuming.

    Such are observers on the host, which are anybody's, and the environments of highway-env.
    """
    if trainer.batch.engine.plugins is not None:
        return {}
    state: Mapping[str, object] = trainer.batch.get_state()
    arrays = {name: values for name, values in state.items() if isinstance(values, np.ndarray)}
    return arrays if len(arrays) == len(state) else {}


def _restore(checkpoint: Checkpoint, trainer: Trainer) -> None:
    policy, statistics = trainer.model.policy, trainer.env.statistics
    policy.load_state_dict(_tensors(_under("policy/", checkpoint.arrays)), strict=True)
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, values in _tensors(_under("optimiser/", checkpoint.arrays)).items():
        index, _, moment = name.partition("/")
        moments.setdefault(int(index), {})[moment] = values
    policy.optimizer.load_state_dict({**policy.optimizer.state_dict(), "state": moments})
    for name in ("mean", "var"):
        found = checkpoint.arrays[f"statistics/{name}"]
        if found.shape != statistics.mean.shape:
            raise ValueError(f"statistics/{name} has shape {found.shape}")
        setattr(statistics, name, found)
    statistics.count = float(checkpoint.arrays["statistics/count"])
    torch.set_rng_state(torch.from_numpy(checkpoint.arrays["random/torch"]))
    key, position = np.split(checkpoint.arrays["random/numpy"], [-1])
    np.random.set_state({"bit_generator": "MT19937", "state": {"key": key, "pos": int(position[0])}})
    world = _under("world/", checkpoint.arrays)
    if world:
        trainer.env.go_on_from(trainer.batch.set_state(world))
    else:
        trainer.batch.seed(trainer.plan.seed + checkpoint.progress["steps"])


def _under(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def _tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")
    return {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}
