"""The scenario: everything that defines a world, typed and checked."""

from __future__ import annotations

from pydantic import field_validator, model_validator

from coopenv.scenario import checks
from coopenv.scenario.bodies import Landmark
from coopenv.scenario.fields import ScenarioFields


class Scenario(ScenarioFields):
    """One environment. Units: m, s, rad; frames: x east, y north, z up; body x forward, y left, z up."""

    @field_validator("landmarks")
    @classmethod
    def _landmark_names(cls, landmarks: tuple[Landmark, ...]) -> tuple[Landmark, ...]:
        checks.landmark_names([landmark.name for landmark in landmarks])
        return landmarks

    @model_validator(mode="after")
    def _is_possible(self) -> Scenario:
        checks.everything(self)
        return self
