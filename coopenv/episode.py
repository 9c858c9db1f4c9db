"""The record of an episode: ticks and estimates of any source, of which everything that is shown or written is a view.

A simulation, a replayed log, cars and recorded robots all give the same record. Its views are the `Trajectory` of
tables and figures, the `Frame` of pictures, films and pages, and the `Recording` of logs. A file holds one view:
`trajectory.npz` the trajectory, `scene.npz` the frames, an MCAP log the recording.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import get_annotations
from pathlib import Path
from typing import Annotated, Any, Protocol, Self

import numpy as np
from pydantic import Field

from coopenv.base.errors import CoopenvError, DataError
from coopenv.base.files import replacing_file
from coopenv.base.format import fixed, jsonable, read_npz
from coopenv.base.sections import Section, validated
from coopenv.estimation import Sight
from coopenv.estimation.poses import position_covariance
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.recording import Recording
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
    """One tick of an episode, for pictures; names are those of the `Trajectory`.

    N vehicles, A targets (landmarks first, then the vehicles), R reward terms, P points of a route, Z bodies of other
    traffic. Positions are in the map frame, m; rotations map body to map. Arrays are copies. Numbers are NaN of targets
    that are not there, and of unknown true poses. An annotation is the kind of a field's numbers (i: whole), and its
    axes in a file: F, all frames; K, all, or one for a constant field; of a frame the first axis is left out.
    """

    tick: Annotated[np.ndarray, "i F"]  # () camera ticks since the start
    target_rotation: Annotated[np.ndarray, "f K A 3 3"]  # true
    target_position: Annotated[np.ndarray, "f K A 3"]  # true
    rotation_estimate: Annotated[np.ndarray, "f K N 3 3"]
    position_estimate: Annotated[np.ndarray, "f K N 3"]
    position_covariance: Annotated[np.ndarray, "f K N 3 3"]  # m^2, from the observer's P to first order
    position_error: Annotated[np.ndarray, "f K N"]  # m
    orientation_error: Annotated[np.ndarray, "f K N"]  # deg
    nees: Annotated[np.ndarray, "f K N"]  # normalised error squared of the pose, see `Info`
    protection_level: Annotated[np.ndarray, "f? K N 2"]  # m and rad, see `Step`
    sight: Annotated[np.ndarray, "i K N A"]  # values of `Sight`
    pan: Annotated[np.ndarray, "f K N"]  # rad, by which the camera is turned to the left
    ended: Annotated[np.ndarray, "i K N"]  # values of `Outcome`, or conditions of the scenario's own
    inbox_tick: Annotated[np.ndarray, "i K N N"]  # (receiver, sender) sending tick of the last message; -1: none
    reward_terms: Annotated[np.ndarray, "f K N R"]  # of this tick
    goal: Annotated[np.ndarray, "f K N 3"]
    route: Annotated[np.ndarray, "f K N P 3"]  # x, y, and arc length
    route_count: Annotated[np.ndarray, "i K N"]  # points of the route; 0: none
    route_drawn: Annotated[np.ndarray, "i K N"]  # number of the scenario's route that it is drawn from; -1: of none
    traffic_rotation: Annotated[np.ndarray, "f K Z 3 3"]
    traffic_position: Annotated[np.ndarray, "f K Z 3"]
    traffic_half: Annotated[np.ndarray, "f K Z 3"]  # half of the edges; zero: not there
    reading_tick: Annotated[np.ndarray | None, "i? K N D A"] = None
    """Last ticks at which D sensors beside the camera measured targets, -1: never; None without such sensors."""

    @classmethod
    def of(cls, shown: FrameSource, world: int = 0) -> Self:
        """Return the present frame of a world of an engine."""
        return cls.of_row(_in_map({name: np.array(shown.view(name)[world]) for name in RECORDED}))

    @classmethod
    def of_row(cls, row: Mapping[str, np.ndarray]) -> Self:
        """Return the frame of the arrays of one tick of an episode."""
        kept: dict[str, Any] = {
            name: np.array(row[name], np.int64 if name in _WHOLE else np.float64) for name in FIELDS if name in row
        }
        if "reading_tick" in kept and not kept["reading_tick"].size:
            del kept["reading_tick"]
        R_hat, estimate = kept["rotation_estimate"], kept["position_estimate"]
        if "position_covariance" not in row:
            P = np.array(row["covariance"], float)
            kept["position_covariance"] = position_covariance(R_hat, estimate, P)
        if "present" in row:
            absent = np.asarray(row["present"]) == 0
            kept["target_position"][absent] = np.nan
            estimate[absent[len(absent) - len(estimate) :]] = np.nan
        return cls(**kept)

    @property
    def landmarks(self) -> int:
        """Number of landmarks among the targets."""
        return len(self.target_position) - len(self.position_estimate)

    @property
    def rotation(self) -> np.ndarray:
        """(N, 3, 3) true, body to map, of the vehicles."""
        return self.target_rotation[self.landmarks :]

    @property
    def position(self) -> np.ndarray:
        """(N, 3) true, map, m, of the vehicles."""
        return self.target_position[self.landmarks :]

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


VIEWS = {
    "target_rotation": "rotation",
    "target_position": "position",
    "rotation_estimate": "estimate_rotation",
    "position_estimate": "estimate_position",
    "reward_terms": "terms",
}
"""Arrays of an episode that have another name in an engine and in `scene.npz`."""
_NAMES = {view: name for name, view in VIEWS.items()}
RECORDED = (
    *(VIEWS.get(name, name) for name in FIELDS if name != "position_covariance"),
    *("velocity", "angular_velocity", "covariance", "present"),
)
"""Fields of an engine that an episode is made of: of frames; of all targets velocities and presence; P of vehicles."""
_UNCHANGED = ("goal", "route", "route_count", "route_drawn", "traffic_half", "present", "inbox_tick", "pan")
_SELDOM = frozenset(("ended", *_UNCHANGED))
"""Fields that are mostly as at the tick before; a record then holds them once."""
OF_TRAJECTORY = tuple(name for name in RECORDED if not name.startswith("traffic") and name not in _UNCHANGED)
"""Fields of `RECORDED` that a `Trajectory` and the ends of its vehicles are made of, without pictures."""


def _in_map(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of an engine, of a tick or (K, ...), by their names in an episode, estimates in the map frame."""
    named = {_NAMES.get(name, name): array for name, array in fields.items()}
    named["position_estimate"] = (named["rotation_estimate"] @ named["position_estimate"][..., None])[..., 0]
    return named


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


@dataclass(frozen=True, eq=False)
class Episode:
    """K ticks of one world, or those of them that are drawn."""

    scenario: Scenario
    source: Origin
    rows: Mapping[str, Sequence[np.ndarray]]
    """Array of each tick by its name: of a `Frame`, and the others of `RECORDED`, which `scene.npz` does not hold."""
    recording: Recording | None = None
    """Measurements of the vehicles at the K ticks, where they have been recorded."""

    def __len__(self) -> int:
        """Return K."""
        return len(self.rows["tick"])

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array (K, ...) by its name."""
        if name == "position_covariance" and name not in self.rows:
            return position_covariance(self["rotation_estimate"], self["position_estimate"], self["covariance"])
        rows = self.rows[name]
        return rows if isinstance(rows, np.ndarray) else np.stack(rows)

    def frame(self, k: int) -> Frame:
        """Return frame k."""
        return Frame.of_row({name: rows[k] for name, rows in self.rows.items()})

    @property
    def measured(self) -> Recording:
        """The recording of its measurements. Raises CoopenvError: nothing has been recorded."""
        if self.recording is None:
            raise CoopenvError(f"{self.source.name}: nothing has been recorded of what the vehicles measured")
        return self.recording

    @property
    def time(self) -> np.ndarray:
        """(K,) s since the start."""
        return np.asarray(self["tick"] / self.scenario.rates.camera)

    @property
    def length(self) -> float:
        """Time from the first to the last frame, s."""
        return float(self.time[-1] - self.time[0])

    def of(self, ticks: Sequence[int] | np.ndarray) -> "Episode":
        """Return some of the ticks, without measurements."""
        chosen = {
            name: rows[ticks] if isinstance(rows, np.ndarray) else [rows[k] for k in ticks]
            for name, rows in self.rows.items()
        }
        return Episode(self.scenario, self.source, chosen)

    def drawn(self, stride: int) -> "Episode":
        """Return the ticks that pictures are made of: every `stride`-th and the last."""
        last = len(self) - 1
        return self.of([*range(0, last, stride), last])

    @cached_property
    def trajectory(self) -> Trajectory:
        """The arrays that tables and figures are about; NaN where the file of the episode does not have one."""
        s, L = self.scenario, len(self.scenario.landmarks)
        moving = [landmark.motion.kind != "static" for landmark in s.landmarks]
        sight, target_position = self["sight"], self["target_position"]
        if "covariance" in self.rows:
            P, velocity, turn = self["covariance"], self["velocity"][:, L:], self["angular_velocity"][:, L:]
        else:
            P = np.full((len(self), len(s.vehicles), 6, 6), np.nan)
            velocity = turn = P[..., :3, 0]
        same = ("position_estimate", "rotation_estimate", "position_error", "orientation_error", "nees")
        return Trajectory(
            t=self.time,
            position=target_position[:, L:],
            rotation=self["target_rotation"][:, L:],
            target_position=target_position,
            visible=sight == Sight.VISIBLE,
            sight=sight,
            covariance=P,
            velocity=velocity,
            angular_velocity=turn,
            vehicles=np.array(s.vehicle_names),
            targets=np.array(s.target_names),
            target_moving=np.array([*moving, *(True for _ in s.vehicles)]),
            terms=np.array(self.source.terms, dtype=str),
            **{name: self[name] for name in (*same, "protection_level", "reward_terms")},
        )

    def save(self, path: Path) -> None:
        """Write the frames, `scene.npz`, in single precision.

        Raises:
            OutputError: it cannot be written; an older file is untouched.
        """
        arrays: dict[str, Any] = {}
        frames = [self.frame(k) for k in range(len(self))]
        for name in FIELDS:
            if getattr(frames[0], name) is None:
                continue
            whole = name in _WHOLE
            small = np.stack([getattr(frame, name) for frame in frames]).astype(np.int32 if whole else np.float32)
            same = np.array_equal(small[1:], small[:-1], equal_nan=not whole)
            arrays[VIEWS.get(name, name)] = small[:1] if same else small  # an array that never changes is kept once
        scenario = without_own_terms(jsonable(self.scenario))
        header = {"frames": len(self), "source": self.source.model_dump(), "scenario": scenario}
        arrays[_HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        with replacing_file(path) as new, new.open("wb") as stream:
            np.savez_compressed(stream, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the frames of a file written by `save`.

        Raises:
            DataError: there is no such file, or it is no scene.
        """
        content = read_npz(path, "scene", {_HEADER: "u B"})[_HEADER].tobytes()
        header = validated(SceneHeader, content, f"{path}", DataError)
        count, source, scenario = header.frames, header.source, parse_scenario(header.scenario, str(path))
        n = len(scenario.vehicles)
        lengths = {"F": (count,), "K": (1, count), "N": (n,), "A": (n + len(scenario.landmarks),)}
        lengths |= {"R": (len(source.terms),), "D": (len(scenario.sensors),)}
        stored = read_npz(path, "scene", {VIEWS.get(name, name): kinds for name, kinds in FIELDS.items()}, lengths)
        rows: dict[str, Any] = {}
        for name in FIELDS:
            whole = stored[VIEWS.get(name, name)].astype(np.int64 if name in _WHOLE else np.float64)
            rows[name] = np.broadcast_to(whole, (count, *whole.shape[1:]))
        steps, last = np.diff(rows["tick"], prepend=-1), scenario.horizon_ticks
        if (steps <= 0).any() or rows["tick"][-1] > last:
            raise DataError(f"{path}: tick: expected camera ticks from 0 to {last}, each later than the one before")
        return cls(scenario, source, rows)


class Views:
    """Fields of an engine at several ticks; one whose copying was interrupted does not count."""

    def __init__(self, shown: FrameSource, names: Iterable[str] = RECORDED) -> None:
        """Begin with no tick; an episode needs those of `RECORDED`."""
        self._shown = shown
        self._rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
        self._often = [(name, rows) for name, rows in self._rows.items() if name not in _SELDOM]
        self._seldom = [(name, rows) for name, rows in self._rows.items() if name in _SELDOM]
        self._contents: dict[str, tuple[int, bytes]] = {}
        self.taken = 0
        """Number of ticks."""

    def take(self) -> None:
        """Copy the fields as they are now."""
        view, contents = self._shown.view, self._contents
        for name, rows in self._often:
            rows[self.taken :] = [view(name).copy()]
        for name, rows in self._seldom:
            row = view(name)
            content = row.tobytes()
            same = contents.get(name) == (self.taken - 1, content)
            rows[self.taken :] = [rows[self.taken - 1] if same else row.copy()]
            contents[name] = self.taken, content
        self.taken += 1

    def __getitem__(self, name: str) -> np.ndarray:
        """Return (K, W, ...) of one field."""
        return np.stack(self._rows[name][: self.taken])

    def episode(self, scenario: Scenario, source: Origin) -> Episode:
        """Return the episode of the first world so far, of at least one tick."""
        first = {name: [row[0] for row in rows[: self.taken]] for name, rows in self._rows.items()}
        poses = {VIEWS[name]: self[VIEWS[name]][:, 0] for name in ("rotation_estimate", "position_estimate")}
        return Episode(scenario, source, _in_map({**first, **poses}))
