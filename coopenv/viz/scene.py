"""The moving parts of a picture of a world as plain data, a frame per drawn tick, and the file that keeps an episode.

The top view, the page in the browser and films are made of frames and of a `Stage`, whether a world runs, has been
recorded or is the one of real cars. `scene.npz` holds the frames of an episode, from which pages and films are made
again.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import get_annotations
from pathlib import Path
from typing import Annotated, Any, Protocol, Self

import numpy as np
from pydantic import Field

from coopenv.base.errors import DataError
from coopenv.base.files import replacing_file
from coopenv.base.format import fixed, jsonable, read_npz
from coopenv.base.sections import Section, validated
from coopenv.estimation import Sight
from coopenv.estimation.poses import position_covariance
from coopenv.observers.registry import states_covariance
from coopenv.scenario import Scenario, parse_scenario
from coopenv.scenario.own_terms import without_own_terms

SIGMAS = 3.0
_ROUNDING = 1e-12  # of the largest eigenvalue: so far below zero is zero


def semi_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 3-sigma semi-axes of covariances (..., D, D): lengths (..., D), ascending, and axes (..., D, D).

    Axes are rotation matrices. Lengths are NaN where a matrix is not finite, or has a negative eigenvalue.
    """
    finite = np.isfinite(covariance).all(axis=(-1, -2))
    variance, axes = np.linalg.eigh(np.where(finite[..., None, None], covariance, 0.0))
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]
    valid = finite & (variance[..., 0] >= -_ROUNDING * variance[..., -1])
    return np.where(valid[..., None], SIGMAS * np.sqrt(np.maximum(variance, 0.0)), np.nan), axes


class FrameSource(Protocol):
    """Source of frames: an engine, or a stand-in for one."""

    def view(self, name: str) -> np.ndarray:
        """Return a field of its results or its state, (W, ...)."""
        ...


@dataclass(frozen=True)
class Frame:
    """A agents (landmarks first, then N vehicles), R reward terms, P points of a route, Z bodies of other traffic.

    Positions are in the map frame, m; rotations map body to map. Arrays are copies. Numbers are NaN of agents that are
    not there, and of unknown true poses. An annotation is the kind of a field's numbers (i: whole), and its axes in a
    file: F, all frames; K, all, or one for a constant field; of a frame the first axis is left out.
    """

    tick: Annotated[np.ndarray, "i F"]  # () camera ticks since the start
    rotation: Annotated[np.ndarray, "f K A 3 3"]  # true
    position: Annotated[np.ndarray, "f K A 3"]  # true
    estimate_rotation: Annotated[np.ndarray, "f K N 3 3"]
    estimate_position: Annotated[np.ndarray, "f K N 3"]
    position_covariance: Annotated[np.ndarray, "f K N 3 3"]  # m^2, from the observer's P to first order
    position_error: Annotated[np.ndarray, "f K N"]  # m
    orientation_error: Annotated[np.ndarray, "f K N"]  # deg
    nees: Annotated[np.ndarray, "f K N"]  # normalised error squared of the pose, see `Info`
    protection_level: Annotated[np.ndarray, "f? K N 2"]  # m and rad, see `Step`
    sight: Annotated[np.ndarray, "i K N A"]  # values of `Sight`
    pan: Annotated[np.ndarray, "f K N"]  # rad, by which the camera is turned to the left
    ended: Annotated[np.ndarray, "i K N"]  # values of `Outcome`, or conditions of the scenario's own
    inbox_tick: Annotated[np.ndarray, "i K N N"]  # (receiver, sender) sending tick of the last message; -1: none
    terms: Annotated[np.ndarray, "f K N R"]  # terms of the reward, of this tick
    goal: Annotated[np.ndarray, "f K N 3"]
    route: Annotated[np.ndarray, "f K N P 3"]  # x, y, and arc length
    route_count: Annotated[np.ndarray, "i K N"]  # points of the route; 0: none
    route_drawn: Annotated[np.ndarray, "i K N"]  # number of the scenario's route that it is drawn from; -1: of none
    traffic_rotation: Annotated[np.ndarray, "f K Z 3 3"]
    traffic_position: Annotated[np.ndarray, "f K Z 3"]
    traffic_half: Annotated[np.ndarray, "f K Z 3"]  # half of the edges; zero: not there

    @classmethod
    def of(cls, shown: FrameSource, world: int = 0) -> Self:
        """Return the present frame of a world of an engine."""
        kept: dict[str, Any] = {
            name: np.array(shown.view(name)[world], np.int64 if name in _WHOLE else np.float64)
            for name in FIELDS.keys() - {"position_covariance"}
        }
        R_hat, p_hat = kept["estimate_rotation"], kept["estimate_position"]
        covariance = np.array(shown.view("covariance")[world], float)
        estimate = (R_hat @ p_hat[..., None])[..., 0]
        spread = position_covariance(R_hat, estimate, covariance)
        absent = np.asarray(shown.view("present")[world]) == 0
        kept["position"][absent] = np.nan
        estimate[absent[len(absent) - len(estimate) :]] = np.nan
        return cls(**{**kept, "estimate_position": estimate, "position_covariance": spread})

    @property
    def landmarks(self) -> int:
        """Number of landmarks among the agents."""
        return len(self.position) - len(self.estimate_position)

    @property
    def vehicle_rotation(self) -> np.ndarray:
        """(N, 3, 3) true, body to map."""
        return self.rotation[self.landmarks :]

    @property
    def vehicle_position(self) -> np.ndarray:
        """(N, 3) true, map, m."""
        return self.position[self.landmarks :]

    @property
    def three_sigma(self) -> np.ndarray:
        """(N,) m: three standard deviations of the estimated position in plan, along the axis where it is worst."""
        return semi_axes(self.position_covariance[:, :2, :2])[0][:, -1]

    def table(self, sigma: bool = True) -> list[tuple[str, str, str, str]]:
        """Return, per vehicle, both errors (m, deg), 3 sigma (m; with `sigma`), and targets seen of all, as text."""
        sigmas = self.three_sigma if sigma else np.full(len(self.nees), np.nan)
        seen, all_targets = self.sight == Sight.VISIBLE, self.sight != Sight.NOT_A_NEIGHBOUR
        columns = self.position_error, self.orientation_error, sigmas, seen.sum(axis=-1), all_targets.sum(axis=-1)
        return [
            (fixed(error, 3), fixed(angle, 1), fixed(bound, 3), f"{count}/{most}")
            for error, angle, bound, count, most in zip(*columns, strict=True)
        ]


FIELDS: dict[str, str] = {name: kind.__metadata__[0] for name, kind in get_annotations(Frame).items()}
"""Kind and axes of each field of a frame."""
_WHOLE = frozenset(name for name, rule in FIELDS.items() if rule.startswith("i"))


SCENE_FILE = "scene.npz"
_HEADER = "header"


class Origin(Section):
    """Environment, observer, driver and seed of a scene, for its heading."""

    name: str
    """Name of the environment, the recording or the deployment."""
    observer: str
    policy: str = ""
    """Name of the driver; empty: no driver."""
    seed: int | None = None
    """None: the episode was not drawn at random."""
    terms: tuple[str, ...] = ()
    """Names of the reward terms of a frame."""
    honest: bool = True
    """True if the observer's P is a covariance; the paper's P is a gain matrix."""

    @classmethod
    def of(cls, name: str, scenario: Scenario, **more: Any) -> Self:
        """Return the source of a scene of a scenario; `more` are further fields."""
        observer = scenario.observer.name
        terms = tuple(scenario.reward.by_name)
        return cls(name=name, observer=observer, terms=terms, honest=states_covariance(observer), **more)

    @property
    def words(self) -> str:
        """Return it in a line, such as "busy_intersection, observer riccati, seed 0"."""
        parts = [self.name, f"observer {self.observer}"]
        parts += [f"driven by {self.policy}"] if self.policy else []
        return ", ".join([*parts, *([f"seed {self.seed}"] if self.seed is not None else [])])


class SceneHeader(Section):
    """Description of the arrays in the file of a scene."""

    frames: int = Field(ge=1)
    source: Origin
    scenario: dict[str, Any]


@dataclass(frozen=True)
class SceneRecord:
    """K frames of an episode."""

    scenario: Scenario
    source: Origin
    fields: dict[str, np.ndarray]
    """Arrays (K, ...) by the name of a frame's field."""

    def __len__(self) -> int:
        """Return K."""
        return len(self.fields["tick"])

    def frame(self, k: int) -> Frame:
        """Return frame k."""
        return Frame(**{name: values[k] for name, values in self.fields.items()})

    @property
    def time(self) -> np.ndarray:
        """(K,) s since the start."""
        return np.asarray(self.fields["tick"] / self.scenario.rates.camera)

    @property
    def length(self) -> float:
        """Time from the first to the last frame, s."""
        return float(self.time[-1] - self.time[0])

    @classmethod
    def of_frames(cls, scenario: Scenario, source: Origin, frames: Sequence[Frame]) -> Self:
        """Return the record of at least one frame."""
        return cls(scenario, source, {name: np.stack([getattr(frame, name) for frame in frames]) for name in FIELDS})

    def of(self, frames: np.ndarray) -> "SceneRecord":
        """Return some of the frames."""
        return SceneRecord(self.scenario, self.source, {name: values[frames] for name, values in self.fields.items()})

    def save(self, path: Path) -> None:
        """Write everything in single precision.

        Raises:
            OutputError: it cannot be written; an older file is untouched.
        """
        arrays: dict[str, Any] = {}
        for name, values in self.fields.items():
            whole = name in _WHOLE
            small = values.astype(np.int32 if whole else np.float32)
            same = np.array_equal(small[1:], small[:-1], equal_nan=not whole)
            arrays[name] = small[:1] if same else small  # an array that never changes is kept once
        scenario = without_own_terms(jsonable(self.scenario))
        header = {"frames": len(self), "source": self.source.model_dump(), "scenario": scenario}
        arrays[_HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        with replacing_file(path) as new, new.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file written by `save`.

        Raises:
            DataError: there is no such file, or it is no scene.
        """
        content = read_npz(path, "scene", {_HEADER: "u B"})[_HEADER].tobytes()
        header = validated(SceneHeader, content, f"{path}", DataError)
        count, source, scenario = header.frames, header.source, parse_scenario(header.scenario, str(path))
        n = len(scenario.vehicles)
        lengths = {"F": (count,), "K": (1, count), "N": (n,), "A": (n + len(scenario.landmarks),)}
        lengths["R"] = (len(source.terms),)
        fields = {}
        for name, values in read_npz(path, "scene", FIELDS, lengths).items():
            whole = values.astype(np.int64 if name in _WHOLE else np.float64)
            fields[name] = np.broadcast_to(whole, (count, *values.shape[1:]))
        steps, last = np.diff(fields["tick"], prepend=-1), scenario.horizon_ticks
        if (steps <= 0).any() or fields["tick"][-1] > last:
            raise DataError(f"{path}: tick: expected camera ticks from 0 to {last}, each later than the one before")
        return cls(scenario, source, fields)
