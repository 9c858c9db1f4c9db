"""An agent's folder: settings and environment of its training, `agent.toml`, weights, curve, ONNX. Needs `train`."""

import csv
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from shlex import join
from typing import Any

import numpy as np
import tomlkit
from safetensors.numpy import save

from coopenv.api.terms.layout import observation_layout, settings_of_meaning
from coopenv.base.errors import CoopenvError
from coopenv.base.files import writing
from coopenv.base.installation import install_command, needing, version, versions
from coopenv.evaluation import Result
from coopenv.policies import sets
from coopenv.policies.loader import AGENT_FILE, NetworkCard
from coopenv.policies.network import CRITIC, ENTRY, layout_hash, layout_tables
from coopenv.scenario import Scenario
from coopenv.training.sets import SetTrainer
from coopenv.training.settings import SETTINGS_FILE, EnvironmentFile, Settings, settings_digest, write_settings
from coopenv.training.trainer import Trainer

WEIGHTS_FILE, CURVE_FILE, ONNX_FILE = "weights.safetensors", "curve.csv", "policy.onnx"
EXPORTED = (AGENT_FILE, WEIGHTS_FILE, SETTINGS_FILE, CURVE_FILE, ONNX_FILE)
OPSET = 17
PACKAGES = ("numpy", "warp-lang", "torch", "stable-baselines3")


def export(
    folder: Path,
    old: Path,
    trainer: Trainer | SetTrainer,
    environment: EnvironmentFile,
    results: Sequence[Result],
    curve: list[dict[str, float]],
    onnx: bool = False,
) -> None:
    """Write everything that an agent's folder holds.

    Args:
        folder: to write to.
        old: whose place it takes.
        trainer: whose policy it is.
        environment: of the training, as it was at its beginning.
        results: figures on held-out maps.
        curve: rows of figures while it learnt.
        onnx: also write the mean action as an ONNX model, from raw observations to actions.

    Raises:
        OutputError: it cannot be written, or see `check_settings`.
    """
    write_settings(folder, old, trainer.plan, environment)
    tensors = trainer.tensors if isinstance(trainer, SetTrainer) else trainer.tensors()
    tensors = {name: np.asarray(values, dtype=np.float32) for name, values in tensors.items()}
    weights = save(tensors)
    with writing(folder):
        (folder / WEIGHTS_FILE).write_bytes(weights)
        if environment.text is not None:
            (folder / environment.name).write_text(environment.text, encoding="utf-8")
        for name, path in environment.code.items():
            (folder / name).write_bytes(path.read_bytes())
        card = _card(trainer, environment, results, sha256(weights).hexdigest())
        (folder / AGENT_FILE).write_text(card, encoding="utf-8")
        if curve:
            with (folder / CURVE_FILE).open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, curve[-1])
                writer.writeheader()
                writer.writerows(curve)
        if onnx:
            (folder / ONNX_FILE).write_bytes(onnx_model(tensors, trainer.plan.settings.ppo.observation_clip))


def scenario_digest(scenario: Scenario) -> str:
    """Return the first 16 hexadecimal digits of SHA-256 over what a scenario sets, whatever it is called."""
    aside = {"title", "description", "source", *(["difficulty"] if scenario.difficulty.neutral else [])}
    text = scenario.model_dump_json(exclude=aside, exclude_defaults=True)
    return sha256(text.encode()).hexdigest()[:16]


def _network(trainer: Trainer | SetTrainer, digest: str) -> NetworkCard:
    plan, more = trainer.plan, dict[str, Any]()
    observation, action, settings = (dict[str, Any]() for _ in range(3))  # a network over sets reads any
    if isinstance(trainer, SetTrainer):
        seen = trainer.seen
    else:
        observation, action = layout_tables(observation_layout(trainer.scenario))
        settings = settings_of_meaning(trainer.scenario, observation)
        fields = {name: slice(f.start, f.stop) for name, f in observation.items()}
        fields.pop("time_left", None)  # goes on for vehicles that have arrived
        seen = {name: trainer.env.seen(columns) for name, columns in fields.items()}
        more = {"right_of_way": plan.settings.right_of_way, "alone": plan.settings.alone}
    return NetworkCard(
        weights=WEIGHTS_FILE,
        sha256=digest,
        layout=layout_hash(observation, action, settings),
        clip=plan.settings.ppo.observation_clip,
        observation=observation,
        action=action,
        settings=settings,
        seen=seen,
        actions=plan.portable.actions,
        **more,
    )


def _card(trainer: Trainer | SetTrainer, environment: EnvironmentFile, results: Sequence[Result], digest: str) -> str:
    plan, card = trainer.plan, _network(trainer, digest)
    arm = f", arm {plan.arm}" if plan.arm else ""
    others = [each.environment for each in plan.watched() if each is not plan]
    begun = f"Clone of {trainer.teacher}" if plan.settings.steps == 0 else "PPO"
    document = {
        "title": f"Learned driver of {'many environments' if others else environment.title}",
        "description": f"{begun}, one policy for all vehicles{arm}, seed {plan.seed}.",
        "kind": "learned",
        "entry": sets.ENTRY if isinstance(trainer, SetTrainer) else ENTRY,
        "environments": [environment.name, *others],
        "network": _with_rows(card.model_dump(mode="json", exclude_none=True), "observation", "action"),
        "training": {
            # trains the same once more, in the agent's folder
            "command": join(
                ["coopenv", "train", environment.name, "--settings", SETTINGS_FILE, "--seed", str(plan.seed)]
            ),
            "environment": environment.name,
            "seed": plan.seed,
            "scenario": scenario_digest(trainer.scenario),
            "settings": settings_digest(plan),
            **({"arm": plan.arm} if plan.arm else {}),
            **({"teacher": trainer.teacher} if trainer.teacher else {}),
            "steps": trainer.status.steps,
            "discount": plan.settings.ppo.discount(trainer.scenario),  # per decision
            "minutes": round(trainer.status.seconds / 60.0, 2),
            "cpu_minutes": round(trainer.cpu_seconds / 60.0, 2),
            "versions": {"coopenv": version(), **versions(*PACKAGES)},
        },
        "results": _with_rows({"figures": _figures(results)}, "figures"),
    }
    return tomlkit.dumps(document)


def _figures(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return the known figures on held-out maps, with their intervals, by name; `n` worlds each."""
    return {
        result.metric: {
            **{key: round(getattr(result, key), 5) for key in ("mean", "ci_low", "ci_high")},
            "n": result.n,
        }
        for result in results
        if np.isfinite(result.mean)
    }


def _with_rows(table: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return a table in which the entries of some tables stand on one line each."""
    rows = dict(table)
    for name in names:
        rows[name] = tomlkit.table()
        for key, values in table[name].items():
            row = tomlkit.inline_table()
            row.update(values)
            rows[name][key] = row
    return rows


def check_onnx(settings: Settings) -> None:
    """Find out before any work whether ONNX models can be written.

    Raises:
        CoopenvError: the package is missing, or the settings are of another network.
    """
    if settings.network:
        raise CoopenvError(f"--onnx: not with network = '{settings.network}'")
    if settings.ppo.memory:
        raise CoopenvError("--onnx: not with ppo.memory, a model has no state")
    if settings.actions == "choices":
        raise CoopenvError("--onnx: not with actions = 'choices', whose driver is no network")
    with needing(f"--onnx needs the package onnx: {install_command('onnx')}"):
        import_module("onnx")


def onnx_model(tensors: Mapping[str, np.ndarray], clip: float) -> bytes:
    """Return an ONNX model from raw observations, (rows, D), to actions, (rows, A) in [-1, 1]; see `check_onnx`."""
    from onnx import TensorProto, checker, helper, numpy_helper

    tensors = {name: values for name, values in tensors.items() if not name.startswith(CRITIC)}
    constants = {**tensors, "clip.low": np.float32(-clip), "clip.high": np.float32(clip)}
    constants |= {"action.low": np.float32(-1.0), "action.high": np.float32(1.0)}
    del constants["log_std"]
    depth = sum(name.endswith(".weight") for name in tensors)
    nodes = [
        helper.make_node("Sub", ["observation", "observation.mean"], ["centred"]),
        helper.make_node("Div", ["centred", "observation.std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "clip.low", "clip.high"], ["hidden.0"]),
    ]
    for i in range(depth):
        inputs = [f"hidden.{i}", f"layers.{i}.weight", f"layers.{i}.bias"]
        nodes.append(helper.make_node("Gemm", inputs, [f"linear.{i}"], transB=1))
        nodes.append(helper.make_node("Tanh", [f"linear.{i}"], [f"hidden.{i + 1}"]))
    nodes[-1] = helper.make_node("Clip", [f"linear.{depth - 1}", "action.low", "action.high"], ["action"])
    entries, outputs = tensors["observation.mean"].shape[0], tensors["log_std"].shape[0]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["rows", entries])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["rows", outputs])],
        [numpy_helper.from_array(np.asarray(values), name) for name, values in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data
