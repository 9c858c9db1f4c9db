"""Factors that make worlds easier, harder or different: difficulty and randomisation."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, create_model, model_validator

from coopenv.base.sections import Section

MOST = 100.0
"""Largest factor."""
FASTEST_PACE = 4.0
"""Largest factor of the traffic's pace."""

PARAMETERS: dict[str, tuple[str, float, float]] = {  # name: what it multiplies, least, most
    "camera_range": ("the cameras' range", 1e-3, MOST),
    "bearing_noise": ("the noise of bearings", 0.0, MOST),
    "odometry_noise": ("the noise of odometry", 0.0, MOST),
    "odometry_scale": ("the error of the odometry's scale, as drawn, and its walk", 0.0, MOST),
    "gyro_bias": ("the gyro's bias, as drawn, and its walk", 0.0, MOST),
    "slip": ("how often wheels slip", 0.0, MOST),
    "extrinsics": ("how far cameras, their focal length included, are from their nominal values", 0.0, MOST),
    "initial_error": ("the drawn offset and turn of initial estimates (not a turn over SO(3))", 0.0, MOST),
    "landmark_presence": ("the chance of landmarks to be there (at most 1)", 0.0, MOST),
    "v2x_loss": ("the chance of messages to be lost (at most 1)", 0.0, MOST),
    "traffic_pace": ("the pace of prescribed motions", 0.0, FASTEST_PACE),
    "wander": ("how far routes wander", 0.0, MOST),
}
"""Every parameter is a factor; in the order of the state's field `parameter`."""

LEVELS = {"easy": 0.0, "normal": 0.5, "hard": 1.0}
"""Difficulties by name."""


def _two_factors(what: str, low: float, high: float) -> tuple[Any, Any]:
    factor = Annotated[float, Field(ge=low, le=high)]
    return tuple[factor, factor], Field((1.0, 1.0), description=f"Two factors of {what}.")


_BOTH: dict[str, Any] = {name: _two_factors(*row) for name, row in PARAMETERS.items()}


class _Factors(create_model("_Ranges", __base__=Section, **_BOTH)):  # type: ignore[misc]
    """Two factors of every parameter."""

    def factors(self, name: str) -> tuple[float, float]:
        """Return the two factors of a parameter."""
        first, second = getattr(self, name)
        return first, second


class Randomisation(_Factors):
    """Factors [low, high] of which every world draws one uniformly at every reset."""

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> Self:
        for name in PARAMETERS:
            low, high = self.factors(name)
            if low > high:
                raise ValueError(f"{name}: the lower factor is {low:g}, the upper {high:g}")
        return self


class Difficulty(_Factors):
    """Factors [at difficulty 0, at difficulty 1], linear between; drawn factors multiply them."""

    level: Annotated[float, Field(ge=0.0, le=1.0)] | Literal["easy", "normal", "hard"] = 0.5
    """Default of the options of a reset; `easy` is 0, `normal` 0.5, `hard` 1."""

    @model_validator(mode="after")
    def _level_has_a_meaning(self) -> Self:
        if self.number != LEVELS["normal"] and not self.matters:
            raise ValueError("level: nothing depends on it; give factors, such as camera_range = [1.25, 0.75]")
        return self

    @property
    def number(self) -> float:
        """The level as a number."""
        return LEVELS[self.level] if isinstance(self.level, str) else self.level

    @property
    def matters(self) -> bool:
        """True if any factor depends on the level."""
        return any(easy != hard for easy, hard in map(self.factors, PARAMETERS))

    @property
    def neutral(self) -> bool:
        """True if every factor is 1 at its level, as without difficulties."""
        return all(easy + (hard - easy) * self.number == 1.0 for easy, hard in map(self.factors, PARAMETERS))
