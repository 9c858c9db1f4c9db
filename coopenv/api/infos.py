"""What one world tells beside observations: infos of its agents, and the state of everybody."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from coopenv.api.engine import Engine
from coopenv.backends.base import Conversing
from coopenv.estimation.outcomes import Outcome, Sight
from coopenv.scenario import Scenario
from coopenv.viz.scene.stage import Frame
from coopenv.world.state import FAULTS, LASTING_ERRORS

if TYPE_CHECKING:
    from coopenv.viz.topview import TopView


def outcome_words(scenario: Scenario) -> tuple[str, ...]:
    """Return the words of `info["outcome"]` by the values of the field `ended`; that of -1 stands last."""
    return (*(outcome.words for outcome in Outcome), *scenario.termination.own, "absent")


class InfoWriter:
    """Builds {agent: info} for world 0 of an engine."""

    def __init__(self, engine: Engine, scenario: Scenario) -> None:
        self._engine = engine
        self._index = {agent: i for i, agent in enumerate(scenario.vehicle_names)}
        self._targets, self._landmarks = scenario.target_names, len(scenario.landmarks)
        self._outcomes = outcome_words(scenario)
        self._backend = engine.backend if isinstance(engine.backend, Conversing) else None
        lasting = (*LASTING_ERRORS, "camera_focal") if scenario.has_lasting_errors else ()
        self._lasting = (*lasting, *(FAULTS if any(faults.any for faults in scenario.all_faults) else ()))
        self._tick_length = 1.0 / scenario.rates.camera

    def __call__(self, agents: list[str]) -> dict[str, dict[str, Any]]:
        """Return one info per agent, always with the same keys."""
        view = self._engine.view
        L = self._landmarks
        R, position = view("rotation")[0, L:].copy(), view("position")[0, L:].copy()
        v, w = view("velocity")[0, L:].copy(), view("angular_velocity")[0, L:].copy()
        sensor_errors = {name: view(name)[0].copy() for name in self._lasting}
        R_hat, p_hat = view("estimate_rotation")[0].copy(), view("estimate_position")[0]
        position_hat = np.matmul(R_hat, p_hat[..., None])[..., 0]
        covariance = view("covariance")[0].copy()
        position_error, orientation_error = view("position_error")[0].tolist(), view("orientation_error")[0].tolist()
        nees, log_determinant = view("nees")[0].tolist(), view("log_determinant")[0].tolist()
        position_std = view("position_std")[0].tolist()
        smallest = view("gramian_min_eigenvalue")[0].tolist()
        ended, terms = view("ended")[0].tolist(), view("terms")[0].tolist()
        seen: list[list[str]] = [[] for _ in R]
        vehicle_seen, target_seen = np.nonzero(view("sight")[0] == Sight.VISIBLE)
        for i, target in zip(vehicle_seen.tolist(), target_seen.tolist(), strict=True):
            seen[i].append(self._targets[target])
        late, missing = self._engine.world.late.tolist(), self._engine.world.missing.tolist()
        time = int(view("tick")[0]) * self._tick_length
        infos = {}
        for agent in agents:
            i = self._index[agent]
            infos[agent] = {
                "truth": {
                    "position": position[i],
                    "rotation": R[i],
                    "velocity": v[i],
                    "angular_velocity": w[i],
                    **{name: values[i] for name, values in sensor_errors.items()},
                },
                "estimate": {"position": position_hat[i], "rotation": R_hat[i], "covariance": covariance[i]},
                "position_error": position_error[i],
                "orientation_error": orientation_error[i],
                "visible": tuple(seen[i]),
                "nees": nees[i],
                "log_determinant": log_determinant[i],
                "position_std": position_std[i],
                "gramian_min_eigenvalue": smallest[i],
                "reward_terms": dict(zip(self._engine.reward_terms, terms[i], strict=True)),
                "time": time,
                "outcome": self._outcomes[ended[i]],
                "late_ticks": late[i],
                "missing_ticks": missing[i],
                **({} if self._backend is None else {"car": self._backend.notes(i)}),
            }
        return infos


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
