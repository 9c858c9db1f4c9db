"""Names in the scene: of vehicles, with their error, and of landmarks."""

from typing import Any

import numpy as np

from coopenv.estimation.outcomes import Outcome
from coopenv.format import fixed
from coopenv.viz.scene import Frame, Stage
from coopenv.viz.web.ground import ROOT

_OFTEN = 0.25  # s between two texts of a label
_APART = 0.06  # of the scene's side, distance from which on an estimate has a name of its own
_MOST_NAMES = 24  # landmarks; more would hide one another


class Labels:
    """Texts that stand over what they name."""

    def __init__(self, scene: Any, stage: Stage) -> None:
        """Add them."""
        self._stage, self._said = stage, -np.inf
        look: dict[str, Any] = {"anchor": "bottom-center", "depth_test": False}
        marks = [stage.short_name(stage.landmarks + i) for i in range(stage.vehicles)]
        self._cars = [scene.add_label(f"{ROOT}/names/{mark}", mark, **look) for mark in marks]
        self._marks = marks
        small = {**look, "font_screen_scale": 0.85}
        believed = f"{ROOT}/names/estimates"
        self._believed = [scene.add_label(f"{believed}/{mark}", f"{mark} estimated", **small) for mark in marks]
        self._landmarks = {
            i: scene.add_label(f"{ROOT}/names/landmarks/{i}", stage.short_name(i), **small)
            for i, landmark in enumerate(stage.scenario.landmarks)
            if landmark.group is None and stage.landmarks <= _MOST_NAMES
        }

    def place(self, frame: Frame, time: float, shown: bool) -> None:
        """Put them over what they name."""
        above = self._stage.bodies[0][:, 2] + 0.012 * self._stage.side
        again = not 0.0 <= time - self._said < _OFTEN - 1e-9
        self._said = time if again else self._said
        for i, label in enumerate(self._cars):
            place = frame.vehicle_position[i] + [0.0, 0.0, above[i]]
            label.visible = shown and bool(np.isfinite(place).all())
            if label.visible:
                label.position = tuple(np.round(place, 3).tolist())
                if again:
                    label.text = self._text(frame, i)
            self._place_believed(frame, i, above[i], shown)
        targets = self._stage.targets(frame)
        for i, label in self._landmarks.items():
            label.visible = shown and bool(np.isfinite(targets[i]).all())
            if label.visible:
                label.position = tuple(np.round(targets[i] + [0.0, 0.0, 0.015 * self._stage.side], 3).tolist())

    def _place_believed(self, frame: Frame, vehicle: int, above: float, shown: bool) -> None:
        """Name an estimate that is not where its vehicle is."""
        label, place = self._believed[vehicle], frame.estimate_position[vehicle] + [0.0, 0.0, above]
        inside = np.all((place[:2] > self._stage.low) & (place[:2] < self._stage.high))
        label.visible = bool(shown and inside and frame.position_error[vehicle] > _APART * self._stage.side)
        if label.visible:
            label.position = tuple(np.round(place, 3).tolist())

    def _text(self, frame: Frame, vehicle: int) -> str:
        mark, ended = self._marks[vehicle], int(frame.ended[vehicle])
        if ended == Outcome.UNDER_WAY:
            return f"{mark}  {fixed(frame.position_error[vehicle], 2)} m"
        known = {outcome.value for outcome in Outcome}
        return f"{mark}  {Outcome(ended).words}" if ended in known else f"{mark}  ended"
