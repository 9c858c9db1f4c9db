"""Frames of an episode, kept in one file: `scene.npz`, from which pages and films are made again."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from coopenv.base.errors import CoopenvError, DataError
from coopenv.base.files import replacing_file
from coopenv.base.format import jsonable
from coopenv.base.sections import Section, read_npz, validated
from coopenv.estimation.outcomes import Outcome, Sight
from coopenv.estimation.poses import covariance_in_map
from coopenv.observers.registry import states_covariance
from coopenv.scenario import Scenario
from coopenv.scenario.files import parse_scenario
from coopenv.scenario.own_terms import without_own_terms
from coopenv.viz.scene.stage import FIELDS, WHOLE_FIELDS, Frame, FrameSource

if TYPE_CHECKING:
    from coopenv.observers import Recording, Run

SCENE_FILE = "scene.npz"
_HEADER = "header"


class Source(Section):
    """Environment, observer, driver and seed of a scene, for its heading."""

    name: str
    """Of the environment, the recording or the deployment."""
    observer: str
    policy: str = ""
    """Name of the driver; empty: no driver."""
    seed: int | None = None
    """None: the episode was not drawn at random."""
    terms: tuple[str, ...] = ()
    """Names of the reward terms of a frame."""
    honest: bool = True
    """Whether the observer's P is meant as a covariance; of the paper's it is a gain matrix."""

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


@dataclass(frozen=True)
class SceneRecord:
    """K frames of an episode."""

    scenario: Scenario
    source: Source
    fields: dict[str, np.ndarray]
    """By name of a frame's field, (K, ...)."""

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
            whole = name in WHOLE_FIELDS
            small = values.astype(np.int32 if whole else np.float32)
            same = len(small) > 1 and np.array_equal(
                small, np.broadcast_to(small[:1], small.shape), equal_nan=not whole
            )
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
        header = read_npz(path, "scene", {_HEADER: "u B"})[_HEADER]
        try:
            facts = json.loads(header.tobytes())
            count, source = int(facts["frames"]), validated(Source, facts["source"], str(path), DataError)
            scenario = parse_scenario(facts["scenario"], str(path))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            if isinstance(error, CoopenvError):
                raise
            raise DataError(f"{path}: not a scene: header: {error}") from None
        if count < 1:
            raise DataError(f"{path}: not a scene: header: {count} frames")
        n = len(scenario.vehicles)
        lengths = {"F": (count,), "K": (1, count), "N": (n,), "A": (n + len(scenario.landmarks),)}
        lengths["R"] = (len(source.terms),)
        fields = {}
        for name, values in read_npz(path, "scene", _TABLE, lengths).items():
            whole = values.astype(np.int64 if name in WHOLE_FIELDS else np.float64)
            fields[name] = np.broadcast_to(whole, (count, *values.shape[1:]))
        return cls(scenario, source, fields)


_AXES = {
    "tick": "F",
    "rotation": "K A 3 3",
    "position": "K A 3",
    **dict.fromkeys(("estimate_rotation", "position_covariance"), "K N 3 3"),
    **dict.fromkeys(("estimate_position", "goal"), "K N 3"),
    **dict.fromkeys(("position_error", "orientation_error", "nees", "pan", "ended"), "K N"),
    **dict.fromkeys(("route_count", "route_drawn"), "K N"),
    "sight": "K N A",
    "inbox_tick": "K N N",
    "terms": "K N R",
    "route": "K N P 3",
    "traffic_rotation": "K Z 3 3",
    **dict.fromkeys(("traffic_position", "traffic_half"), "K Z 3"),
}
"""By field of a frame its axes; F: all frames, K: all frames, or a single one for a constant field."""
_TABLE = {name: f"{'i' if name in WHOLE_FIELDS else 'f'} {axes}" for name, axes in _AXES.items()}


def frames_of(recording: "Recording", run: "Run", ticks: np.ndarray) -> list[Frame]:
    """Return frames of a recording and of a run of an observer on it.

    A vehicle whose truth is never known has the pose of its estimate. There are no goals, routes and reward terms.

    Args:
        recording: of N vehicles and L landmarks, whose positions are the points that cameras see.
        run: on that recording.
        ticks: (K,) to be shown.
    """
    r, K, N, L = recording, len(ticks), len(recording.setups), recording.landmarks.shape[1]
    known = np.atleast_1d(r.truth.known.any(axis=0))
    R_hat, p_hat = run.rotation[ticks], run.position[ticks]
    R = np.where(known[:, None, None], r.truth.rotation[ticks], R_hat)
    p = np.where(known[:, None], r.truth.position[ticks], p_hat)
    P = covariance_in_map(run.coordinates, R_hat, p_hat, run.covariance[ticks])
    unseen = np.where(np.eye(N, N + L, L, dtype=bool), Sight.NOT_A_NEIGHBOUR, Sight.OUT_OF_VIEW)
    fields = {
        "tick": ticks,
        "rotation": np.concatenate([np.broadcast_to(np.eye(3), (K, L, 3, 3)), R], axis=1),
        "position": np.concatenate([r.landmarks[ticks], p], axis=1),
        "estimate_rotation": R_hat,
        "estimate_position": p_hat,
        "position_covariance": P[..., :3, :3],
        **{name: getattr(run, name)[ticks] for name in ("position_error", "orientation_error", "nees")},
        "sight": np.where(r.visible[ticks], Sight.VISIBLE, unseen),
        "pan": np.zeros((K, N)) if r.pan is None else r.pan[ticks],
        "ended": np.full((K, N), Outcome.UNDER_WAY),
        "inbox_tick": r.inbox_tick[ticks],
        "terms": np.zeros((K, N, 0)),
        "goal": np.full((K, N, 3), np.nan),
        "route": np.zeros((K, N, 0, 3)),
        "route_count": np.zeros((K, N), int),
        "route_drawn": np.full((K, N), -1),
        "traffic_rotation": np.zeros((K, 0, 3, 3)),
        **dict.fromkeys(("traffic_position", "traffic_half"), np.zeros((K, 0, 3))),
    }
    return [Frame(**{name: values[k] for name, values in fields.items()}) for k in range(K)]


class SceneWriter:
    """Collects frames while an episode goes on."""

    def __init__(self, scenario: Scenario, source: Source) -> None:
        """Begin with none."""
        self.scenario, self.source = scenario, source
        self._frames: list[Frame] = []

    def add(self, shown: FrameSource) -> Frame:
        """Add the present frame, and return it."""
        self._frames.append(Frame.of(shown))
        return self._frames[-1]

    def record(self) -> SceneRecord:
        """Return the record of all frames; `add` must have been called."""
        stacked = {name: np.stack([getattr(frame, name) for frame in self._frames]) for name in FIELDS}
        return SceneRecord(self.scenario, self.source, stacked)
