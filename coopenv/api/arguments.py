"""Arguments and infos of the interfaces: actions, options of a reset, arrays in and out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import warp as wp
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from coopenv.api.engine import Engine
from coopenv.api.reward import Step
from coopenv.backends.base import Broadcasting
from coopenv.base.errors import ActionError, CoopenvError, shown, suggest
from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.learning import LEVELS, PARAMETERS
from coopenv.viz.scene.stage import Frame
from coopenv.world.state import FAULTS, LASTING_ERRORS

if TYPE_CHECKING:
    from coopenv.viz.topview import TopView


class ActionReader:
    """Turns {agent: (A,)} into (1, N, A), clipped to [-1, 1]."""

    def __init__(self, index: Mapping[str, int], engine: Engine) -> None:
        self._index = index  # of possible agents among the vehicles
        self._engine = engine
        self._size = engine.view("actions").shape[-1]

    def __call__(self, actions: Mapping[str, np.ndarray], alive: Sequence[str]) -> np.ndarray:
        """Return the actions of the living agents; those that have ended keep their last one, whatever is given.

        Raises:
            ActionError: an action is missing, unknown, of the wrong shape, or not finite.
        """
        if not isinstance(actions, Mapping):
            raise ActionError(f"actions must be a dict of agent to array, got {type(actions).__name__}")
        try:
            values = np.array([actions[agent] for agent in alive])
        except (IndexError, KeyError, TypeError, ValueError, RuntimeError):
            values = np.empty(0)
        numeric = values.dtype.kind in "fiu" and values.shape == (len(alive), self._size)
        unknown = len(actions) != len(alive) and not set(actions) <= set(self._index)
        if not numeric or unknown or not np.isfinite(values).all():
            self._complain(actions, alive)
        whole = self._engine.view("actions").copy()
        whole[0, [self._index[agent] for agent in alive]] = np.clip(values, -1.0, 1.0)
        return whole

    def _complain(self, actions: Mapping[str, np.ndarray], alive: Sequence[str]) -> None:
        for agent in actions:
            if agent not in self._index:
                raise ActionError(
                    f"action for unknown agent '{agent}'{suggest(str(agent), self._index)}; agents: {', '.join(alive)}"
                )
        for agent in alive:
            if agent not in actions:
                raise ActionError(f"no action for '{agent}'; agents: {', '.join(alive)}")
            check_action(actions[agent], agent, self._size)


def check_action(action: object, agent: str, size: int) -> np.ndarray:
    """Return one action as a float array.

    Raises:
        ActionError: wrong shape, not a number, or not finite.
    """
    try:
        value = np.asarray(action)
    except (TypeError, ValueError):
        value = np.array("?")
    if value.dtype.kind not in "fiu":
        raise ActionError(f"action of '{agent}' is not numeric: {action!r}")
    if value.shape != (size,):
        raise ActionError(f"action of '{agent}' has shape {value.shape}, expected ({size},)")
    if not np.isfinite(value).all():
        raise ActionError(f"action of '{agent}' is not finite: {value.tolist()}")
    return value


SETTINGS = ("parameters", "difficulty")
"""Options that hold until they are given again."""


def checked_options(options: object, known: tuple[str, ...], ignored: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return options by name.

    Raises:
        CoopenvError: they are not a dict, or one of them is not known.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise CoopenvError(f"options must be a dict, got {type(options).__name__}")
    for key in options:
        if key not in known and key not in ignored:
            raise CoopenvError(f"unknown option {shown(key)}{suggest(str(key), known)}; known: {', '.join(known)}")
    return dict(options)


def world_number(value: object) -> int:
    """Return the option `world`, a number below 2^32.

    Raises:
        CoopenvError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 0 <= value < 2**32:
        raise CoopenvError(f"option 'world' must be a whole number from 0 to 2^32 - 1, got {shown(value)}")
    return int(value)


def world_mask(value: object, worlds: int, vehicles: int) -> np.ndarray:
    """Return the option `reset_mask`, one bool per row (world, vehicle) or per world, as (worlds,).

    Raises:
        CoopenvError: it is something else, or splits a world.
    """
    try:
        chosen = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        chosen = np.empty(0)
    if chosen.dtype != bool or not chosen.any():
        raise CoopenvError("reset_mask must be an array of bool with at least one True")
    if chosen.shape == (worlds * vehicles,):
        by_world = chosen.reshape(worlds, vehicles)
        split = np.flatnonzero(by_world.any(axis=1) != by_world.all(axis=1))
        if split.size:
            raise CoopenvError(f"reset_mask splits world {split[0]}: its {vehicles} rows are reset together")
        chosen = by_world[:, 0]
    if chosen.shape != (worlds,):
        expected = f"({worlds * vehicles},) rows or ({worlds},) worlds"
        raise CoopenvError(f"reset_mask has shape {chosen.shape}, expected {expected}")
    return chosen


def world_parameters(options: Mapping[str, Any], worlds: int, scenario: Scenario) -> dict[str, np.ndarray]:
    """Return the options `parameters` and `difficulty`, as far as they are given, as (worlds,) by name.

    Raises:
        CoopenvError: one is not known, or not what it must be.
    """
    factors = options.get("parameters") if options.get("parameters") is not None else {}
    if not isinstance(factors, Mapping):
        raise CoopenvError(f"option 'parameters' must be a dict, got {type(factors).__name__}")
    found = {}
    for name, value in factors.items():
        if name not in PARAMETERS:
            near = suggest(str(name), PARAMETERS)
            raise CoopenvError(f"unknown parameter {shown(name)}{near}; known: {', '.join(PARAMETERS)}")
        _, low, high = PARAMETERS[name]
        if name == "traffic_pace" and not scenario.paced:
            high = 1.0  # motions are worked out for the horizon alone
        found[name] = (
            np.full(worlds, np.nan) if value is None else _numbers(f"parameter '{name}'", value, worlds, low, high)
        )
    if "difficulty" in options:
        value = options["difficulty"]
        level = scenario.difficulty.number if value is None else value
        if isinstance(level, str):
            if level not in LEVELS:
                raise CoopenvError(
                    f"unknown difficulty {shown(level)}{suggest(level, LEVELS)}; known: {', '.join(LEVELS)}"
                )
            level = LEVELS[level]
        found["difficulty"] = _numbers("option 'difficulty'", level, worlds, 0.0, 1.0)
        if value is not None and not scenario.difficulty.matters:
            raise CoopenvError("option 'difficulty': nothing depends on it here: no factors under [difficulty]")
    return found


def _numbers(what: str, value: object, worlds: int, low: float, high: float) -> np.ndarray:
    """Return a number, or one per world, as (worlds,)."""
    try:
        given = np.asarray(value)
        numbers = given.astype(float) if given.dtype.kind in "fiu" else np.array(np.nan)
    except (TypeError, ValueError, RuntimeError):
        numbers = np.array(np.nan)
    if numbers.shape not in ((), (worlds,)):
        raise CoopenvError(f"{what} has shape {numbers.shape}, expected a number or one per world, ({worlds},)")
    if not ((numbers >= low) & (numbers <= high)).all():
        raise CoopenvError(f"{what} must be from {low:g} to {high:g}, got {shown(value)}")
    return np.broadcast_to(numbers, (worlds,)).copy()


def check_choice(what: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Make sure that an argument is one of those allowed.

    Raises:
        CoopenvError: it is not.
    """
    if value not in allowed:
        names = [str(a) for a in allowed]
        raise CoopenvError(f"unknown {what} '{value}'{suggest(str(value), names)}; known: {', '.join(names)}")


def checked_autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    """Return a member of Gymnasium's enumeration for it, its name or its value.

    Raises:
        CoopenvError: no such mode.
    """
    known = {word.lower(): m for m in AutoresetMode for word in (m.name, m.value)}
    word = str(getattr(mode, "name", mode)).lower().replace("-", "_")
    if word not in known:
        names = [m.name.lower() for m in AutoresetMode]
        raise CoopenvError(f"unknown autoreset '{mode}'{suggest(word, names)}; known: {', '.join(names)}")
    return known[word]


ArrayKind = Literal["numpy", "torch"]


class Exchange:
    """Gives fields of an engine as rows (W N, ...) and takes actions as rows."""

    def __init__(self, engine: Engine, kind: ArrayKind | None) -> None:
        """Choose what arrays look like.

        Args:
            engine: the batch.
            kind: "numpy": fresh host arrays; "torch": tensors on the engine's device that share its memory and are
                overwritten by the next step. None: "numpy" on the CPU, "torch" on CUDA.

        Raises:
            CoopenvError: another kind, or torch is not installed.
        """
        self._engine = engine
        self._on_cpu = engine.world.device == "cpu"
        self.kind: ArrayKind = kind if kind is not None else ("numpy" if self._on_cpu else "torch")
        if self.kind not in ("numpy", "torch"):
            raise CoopenvError(f"unknown arrays '{kind}'; known: numpy, torch")
        if self.kind == "torch" and find_spec("torch") is None:
            raise CoopenvError("arrays='torch' needs torch: pip install '.[train]'")
        self._shape: tuple[int, ...] = tuple(engine.array("actions").shape)
        self._rows = self._shape[0] * self._shape[1]
        self._tensors: dict[str, Any] = {}
        self._stream: Any = None

    def follow_torch(self) -> None:
        """Queue this engine's kernels on torch's current CUDA stream, so that neither overtakes the other."""
        if self._on_cpu or self.kind != "torch":
            return
        import torch

        device = self._engine.world.device
        current = torch.cuda.current_stream(wp.device_to_torch(device))
        if self._stream is None or self._stream.cuda_stream != current.cuda_stream:
            self._stream = wp.stream_from_torch(current)
        # The first time, wait for what was queued on the stream so far, such as the building of the world.
        wp.set_stream(self._stream, device, sync=wp.get_stream(device) != self._stream)

    def rows(self, name: str) -> Any:
        """Return a field: a copy on the host, or a tensor that shares memory."""
        if self.kind == "numpy":
            view = self._engine.view(name)
            return view.reshape(self._rows, *view.shape[2:]).copy()
        tensor = self._tensors.get(name)
        if tensor is None:
            whole = wp.to_torch(self._engine.array(name))
            tensor = self._tensors[name] = whole.reshape(self._rows, *whole.shape[2:])
        return tensor

    def time(self) -> Any:
        """Return (W N,) s since the start of each row's episode."""
        engine, vehicles = self._engine, self._shape[1]
        period = float(engine.world.model.camera_period)
        if self.kind == "numpy":
            return np.repeat(engine.view("tick") * period, vehicles)
        import torch

        ticks = wp.to_torch(engine.array("tick"))
        return torch.repeat_interleave(ticks * period, vehicles)

    def owned(self, rows: Any) -> Any:
        """Return rows that `rows()` gave, or dictionaries of them, as what the next step does not touch."""
        if isinstance(rows, dict):
            return {name: self.owned(values) for name, values in rows.items()}
        return rows if self.kind == "numpy" else rows.clone()

    def set_actions(self, actions: Any) -> None:
        """Take actions (W N, A), or (W, N, A), clipped to [-1, 1] by the actuators.

        A tensor that is on the device already is copied there; whether it is finite is not checked, as that would
        wait for the device: an action that is not finite counts as zero.

        Raises:
            ActionError: wrong shape or dtype; a host array that is not finite.
        """
        if self.kind == "torch" and type(actions).__module__.split(".")[0] == "torch":
            self._set_tensor(actions)
        else:
            self._engine.set_actions(host_actions(actions, self._shape))

    def _set_tensor(self, actions: Any) -> None:
        import torch

        if tuple(actions.shape) not in ((self._rows, self._shape[-1]), self._shape):
            raise ActionError(f"actions have shape {tuple(actions.shape)}, expected ({self._rows}, {self._shape[-1]})")
        if not torch.is_floating_point(actions) or actions.device.type == "meta":
            raise ActionError(f"actions have dtype {actions.dtype} on {actions.device}, expected a float with data")
        if actions.device.type == "cpu" and not torch.isfinite(actions).all():
            host_actions(actions.detach().numpy(), self._shape)  # says which row
        target = wp.to_torch(self._engine.array("actions"))
        target.copy_(actions.detach().reshape(self._shape))


def host_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return host actions as an array (W, N, A).

    Args:
        actions: (W N, A) or (W, N, A).
        shape: (W, N, A).

    Raises:
        ActionError: wrong shape or dtype, or not finite.
    """
    rows, size = shape[0] * shape[1], shape[2]
    try:
        values = np.asarray(actions)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ActionError(f"actions cannot be read as an array of shape ({rows}, {size}): {error}") from None
    if values.shape not in ((rows, size), shape):
        raise ActionError(f"actions have shape {values.shape}, expected ({rows}, {size})")
    if values.dtype.kind not in "fiu":
        raise ActionError(f"actions have dtype {values.dtype}, expected a float")
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values.reshape(rows, size)).all(axis=1))[0])
        raise ActionError(f"action of row {row} is not finite: {values.reshape(rows, size)[row].tolist()}")
    return values.reshape(shape)


def outcome_words(scenario: Scenario) -> tuple[str, ...]:
    """Return the words of `info["outcome"]` by the values of the field `ended`; that of -1 stands last."""
    return (*(outcome.words for outcome in Outcome), *scenario.termination.own, "absent")


class InfoWriter:
    """Builds {agent: info} for world 0 of an engine."""

    def __init__(self, engine: Engine, scenario: Scenario) -> None:
        self._engine = engine
        self._index = {agent: i for i, agent in enumerate(scenario.vehicle_names)}
        self._targets, self._step = scenario.target_names, Step(engine.view, scenario)
        self._outcomes = outcome_words(scenario)
        self._backend = engine.backend if isinstance(engine.backend, Broadcasting) else None
        lasting = (*LASTING_ERRORS, "camera_focal") if scenario.has_lasting_errors else ()
        self._lasting = (*lasting, *(FAULTS if any(faults.any for faults in scenario.all_faults) else ()))

    def __call__(self, agents: list[str]) -> dict[str, dict[str, Any]]:
        """Return one info per agent, always with the same keys."""
        view, step = self._engine.view, self._step
        truth = {name: values[0].copy() for name, values in step["truth"].items()}
        truth |= {name: view(name)[0].copy() for name in self._lasting}
        estimate = {name: values[0].copy() for name, values in step["estimate"].items()}
        numbers = {name: view(name)[0].tolist() for name in _NUMBERS}
        ended, terms = view("ended")[0].tolist(), view("terms")[0].tolist()
        seen: list[list[str]] = [[] for _ in ended]
        for i, target in zip(*(each.tolist() for each in np.nonzero(step["visible"][0])), strict=True):
            seen[i].append(self._targets[target])
        late, missing = self._engine.world.late.tolist(), self._engine.world.missing.tolist()
        time = float(step["time"][0, 0])
        infos = {}
        for agent in agents:
            i = self._index[agent]
            infos[agent] = {
                "truth": {name: values[i] for name, values in truth.items()},
                "estimate": {name: values[i] for name, values in estimate.items()},
                "visible": tuple(seen[i]),
                **{name: values[i] for name, values in numbers.items()},
                "reward_terms": dict(zip(self._engine.reward_terms, terms[i], strict=True)),
                "time": time,
                "outcome": self._outcomes[ended[i]],
                "late_ticks": late[i],
                "missing_ticks": missing[i],
                **({} if self._backend is None else {"car": self._backend.notes(i)}),
            }
        return infos


_NUMBERS = ("position_error", "orientation_error", "nees", "log_determinant", "position_std", "gramian_min_eigenvalue")
PER_AGENT = 12
"""position (3), first two columns of R (6), linear velocity (3), all of truth"""
PER_VEHICLE = 9
"""estimated position (3) and first two columns of Rhat (6)"""
LASTING = 12
"""a vehicle's lasting errors, if any: scale (1), gyro bias (3), slip (2), turn and shift of the camera (6)"""
LIMIT = 1e6


def state_space(scenario: Scenario) -> spaces.Box:
    """Return the space of `state_vector`: metres and m/s, clipped far beyond any scene."""
    per_vehicle = PER_VEHICLE + (LASTING if scenario.has_lasting_errors else 0)
    size = PER_AGENT * len(scenario.target_names) + per_vehicle * len(scenario.vehicles) + 1
    return spaces.Box(-LIMIT, LIMIT, shape=(size,), dtype=np.float32)


def state_vector(engine: Engine) -> np.ndarray:
    """Return the state of world 0: every agent's truth (landmarks first), every vehicle's estimate, episode share.

    Where the scenario has lasting errors of sensors, those of every vehicle come last. Truth that a recording does not
    know reads 0.
    """
    view = engine.view
    R, position, velocity = (view(name)[0] for name in ("rotation", "position", "velocity"))
    R_hat, p_hat = view("estimate_rotation")[0], view("estimate_position")[0]
    position_hat = np.einsum("nij,nj->ni", R_hat, p_hat)
    truth = np.hstack([position, R[:, :, 0], R[:, :, 1], velocity])
    estimate = np.hstack([position_hat, R_hat[:, :, 0], R_hat[:, :, 1]])
    share = view("tick")[:1] / engine.world.model.horizon_ticks
    lasting = [view(name)[0] for name in LASTING_ERRORS] if engine.world.scenario.has_lasting_errors else []
    errors = np.hstack([part.reshape(len(p_hat), -1) for part in lasting]) if lasting else np.zeros(0)
    whole = np.concatenate([truth.ravel(), estimate.ravel(), share, errors.ravel()]).astype(np.float32)
    result: np.ndarray = np.nan_to_num(whole.clip(-LIMIT, LIMIT), nan=0.0)
    return result


class Pictures:
    """Draws worlds of an engine; matplotlib is loaded with the first picture."""

    def __init__(self, engine: Engine, scenario: Scenario) -> None:
        self._engine, self._scenario = engine, scenario
        self._view: TopView | None = None

    def of(self, world: int = 0) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of a world."""
        return self.view.paint(Frame.of(self._engine, world))

    def show(self) -> None:
        """Draw the first world in a window."""
        self.view.show(self.of())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    @property
    def view(self) -> TopView:
        """What draws, made when it is first asked for."""
        if self._view is None:
            from coopenv.viz.topview import TopView

            self._view = TopView(self._scenario)
        return self._view
