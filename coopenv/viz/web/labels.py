"""Names in the scene: of vehicles, with their error, and of landmarks."""

from typing import Any

import numpy as np

from coopenv.base.format import fixed
from coopenv.estimation.outcomes import Outcome
from coopenv.viz.scene import Frame, Stage
from coopenv.viz.web.ground import ROOT
from coopenv.viz.web.look import in_turn
from coopenv.viz.web.sent import Sent

_OFTEN = 0.5  # s between two texts of a label
_CLOSE, _RAISED = 0.09, 0.035  # of the scene's side: vehicles so close have their names so far above each other
_APART = 0.06  # of the scene's side, distance from which on an estimate has a name of its own
_MOST_NAMES = 24  # landmarks; more would hide one another


class Labels:
    """Texts that stand over what they name."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Add them."""
        self._stage, self._said = stage, -np.inf
        look: dict[str, Any] = {"anchor": "bottom-center", "depth_test": False}
        marks = [stage.short_name(stage.landmarks + i) for i in range(stage.vehicles)]
        self._cars = [Sent(scene.add_label(f"{ROOT}/names/{mark}", mark, **look)) for mark in marks]
        self._marks = marks
        self._marked, self._marks_at = False, np.zeros((0, 3))
        above = stage.bodies[0][:, 2] + 0.012 * stage.side
        self._above = np.column_stack([np.zeros((len(above), 2)), above])
        small = {**look, "font_screen_scale": 0.85}
        believed = f"{ROOT}/names/estimates"
        self._believed = [Sent(scene.add_label(f"{believed}/{mark}", f"{mark} estimated", **small)) for mark in marks]
        self._landmarks = {
            i: Sent(scene.add_label(f"{ROOT}/names/landmarks/{i}", stage.short_name(i), **small))
            for i, landmark in enumerate(stage.scenario.landmarks)
            if landmark.group is None and stage.landmarks <= _MOST_NAMES
        }

    def place(self, frame: Frame, time: float, shown: bool, turn: int | None = None) -> None:
        """Put them over what they name; with a `turn` those of some vehicles, as in `Picture.show`."""
        again = not 0.0 <= time - self._said < _OFTEN - 1e-9
        self._said = time if again else self._said
        if again and shown:
            for i, label in enumerate(self._cars):
                label.tell(text=self._text(frame, i))
        mine = in_turn(turn, self._stage.vehicles)
        places = frame.vehicle_position + self._above
        places[:, 2] += _RAISED * self._stage.side * levels(places[:, :2], _CLOSE * self._stage.side)
        for label, place in zip(self._cars[mine], places[mine], strict=True):
            _put(label, place, shown)
        self._place_believed(frame, shown, mine)
        places = self._stage.targets(frame)[: self._stage.landmarks]
        if shown != self._marked or not np.array_equal(places, self._marks_at, equal_nan=True):
            self._marked, self._marks_at = shown, places
            for i, label in self._landmarks.items():
                _put(label, places[i] + [0.0, 0.0, 0.015 * self._stage.side], shown)

    def _place_believed(self, frame: Frame, shown: bool, mine: slice) -> None:
        """Name the estimates that are not where their vehicles are."""
        places = (frame.estimate_position + self._above)[mine]
        inside = np.all((places[:, :2] > self._stage.low) & (places[:, :2] < self._stage.high), axis=-1)
        named = inside & (frame.position_error[mine] > _APART * self._stage.side)
        for label, place, there in zip(self._believed[mine], places, named.tolist(), strict=True):
            _put(label, place, shown and there)

    def _text(self, frame: Frame, vehicle: int) -> str:
        mark, ended = self._marks[vehicle], int(frame.ended[vehicle])
        if ended == Outcome.UNDER_WAY:
            return f"{mark}  {fixed(frame.position_error[vehicle], 2)} m"
        known = {outcome.value for outcome in Outcome}
        return f"{mark}  {Outcome(ended).words}" if ended in known else f"{mark}  ended"


def levels(points: np.ndarray, close: float) -> np.ndarray:
    """Return (N,) on which level the name of each point (N, 2) stands: no two of one level are close to each other.

    Of two that are close the one farther to the north has the higher level: the first camera looks from the south.
    """
    near = np.linalg.norm(points[:, None] - points, axis=-1) < close
    level, done = np.zeros(len(points), int), np.zeros(len(points), bool)
    for i in np.argsort(points[:, 1], kind="stable"):
        taken = set(level[near[i] & done].tolist())
        level[i] = next(k for k in range(len(points)) if k not in taken)
        done[i] = True
    return level


def _put(label: Sent, place: np.ndarray, shown: bool) -> None:
    """Put a label to a place (3,), NaN: nowhere."""
    shown = shown and not np.isnan(place[0])
    label.tell(visible=shown)
    if shown:
        label.tell(position=tuple(place.round(3).tolist()))
