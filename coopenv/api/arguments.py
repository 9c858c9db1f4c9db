"""Arguments and results on the host: options of a reset, results of a step, state for critics, reward in Python."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NotRequired, TypedDict

import numpy as np

from coopenv.base.errors import ActionError, CoopenvError, check_one_of, error_text, shown, suggest
from coopenv.estimation import Outcome, Sight
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import LEVELS, PARAMETERS
from coopenv.world.reset import ABSENT
from coopenv.world.state import LASTING_ERRORS

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
        if key not in ignored:
            check_one_of("unknown option", key, known)
    return dict(options)


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
        check_one_of("unknown parameter", name, PARAMETERS)
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
            check_one_of("unknown difficulty", level, LEVELS)
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


QUALITIES = (
    *("position_error", "orientation_error", "nees", "log_determinant", "position_std", "gramian_min_eigenvalue"),
    "protection_level",
)
"""Fields of an engine with a number for every vehicle, or two, which infos hold, too."""


class EstimateInfo(TypedDict):
    """The vehicle's estimate of its pose; `coopenv.position_covariance(**estimate)` is its spread in the map frame."""

    position: np.ndarray
    """(3,) m, map frame."""
    rotation: np.ndarray
    """(3, 3), body to map."""
    covariance: np.ndarray
    """(6, 6), the observer's P over (2 lambda, p), p in the body frame: rad^2, rad m, m^2."""


class Info(TypedDict):
    """Entries of `infos[agent]`, always the same ones; `infos[agent].items()` are those that are numbers."""

    truth: dict[str, np.ndarray]
    """Fields of `Step`, and lasting errors of sensors and faults where the scenario has them."""
    estimate: EstimateInfo
    visible: tuple[str, ...]
    """Names of the targets measured in the last frame."""
    position_error: float
    """m, norm of the difference in the map frame."""
    orientation_error: float
    """deg, geodesic angle."""
    nees: float
    """Normalised error squared in the coordinates in which the observer states P; in the mean its degrees of freedom
    (6, on a plane 3) for a consistent estimate."""
    log_determinant: float
    """Log-determinant of P."""
    position_std: float
    """m, root of the trace of the position's covariance in the map frame."""
    gramian_min_eigenvalue: float
    """Smallest eigenvalue of the observability Gramian, mixed units."""
    protection_level: list[float]
    """Bounds that the observer states, of the horizontal error, m, and the angle, rad; infinite: unknown, or none."""
    reward_terms: dict[str, float]
    time: float
    """Time since the reset, s."""
    outcome: str
    """`under way`, `arrived`, `collided`, `off route`, or a condition of the scenario's own."""
    late_ticks: int
    """Camera ticks of this step that came late."""
    missing_ticks: int
    """Camera ticks of this step in which nothing came from the vehicle, which has gone on with its last odometry."""
    car: NotRequired[dict[str, Any]]
    """Link and gate of a real car."""


FLAGS = ("alive", "terminated", "truncated", "ended")
FIELDS = ("observation", "action", "reward", *FLAGS, *QUALITIES, "targets_in_view")
"""Fields of an engine under the same name."""
OTHERS = ("truth", "estimate", "reward_terms", "visible", "time")


class Step:
    """Results of a step: the infos of N vehicles in W worlds as arrays, read-only until the next step.

    - `position_error` (m), `orientation_error` (deg), `nees`, `log_determinant`, `position_std` (m),
      `gramian_min_eigenvalue`, `targets_in_view`: (W, N);
    - `protection_level`: (W, N, 2), bounds of the horizontal error (m) and of the angle (rad) that the observer states;
      infinite: unknown, or none stated;
    - `truth`: position (m, map frame), velocity and angular_velocity (m/s, rad/s, body frame), each (W, N, 3), and
      rotation (W, N, 3, 3), body to map; `estimate`: position, rotation, and covariance (W, N, 6, 6);
    - `visible`: (W, N, T), the targets measured in this frame; `time`: (W, 1), s since the reset;
    - `observation`: (W, N, D), scaled and clipped; `action`: (W, N, A) in [-1, 1];
    - `reward_terms`: (W, N) by name, and `reward`, what the scenario's weights make of them, for each vehicle itself;
    - `alive`, `terminated`, `truncated`: (W, N) bool; `ended`: (W, N), 0 under way, 1 arrived, 2 collided, 3 off
      route, from 4 on the scenario's own conditions.
    """

    def __init__(self, view: Callable[[str], np.ndarray], scenario: Scenario) -> None:
        """Read the fields that `view` gives by name, see `Engine.view`."""
        self._view, self._landmarks = view, len(scenario.landmarks)
        self._terms, self._tick_length = tuple(scenario.reward.by_name), 1.0 / scenario.rates.camera

    def __getitem__(self, name: str) -> Any:
        """Return an array, or a dictionary of arrays.

        Raises:
            CoopenvError: no such name.
        """
        if name in FIELDS:
            return _locked(self._view(name))
        if name == "truth":
            moved = ("position", "rotation", "velocity", "angular_velocity")
            return {key: _locked(self._view(key)[:, self._landmarks :]) for key in moved}
        if name == "estimate":
            rotation, covariance = (_locked(self._view(key)) for key in ("estimate_rotation", "covariance"))
            position = np.matmul(rotation, self._view("estimate_position")[..., None])[..., 0]
            return {"position": position, "rotation": rotation, "covariance": covariance}
        if name == "reward_terms":
            return dict(zip(self._terms, np.moveaxis(_locked(self._view("terms")), -1, 0), strict=True))
        if name == "visible":
            return self._view("sight") == Sight.VISIBLE
        if name == "time":
            return self._view("tick")[:, None] * self._tick_length
        raise CoopenvError(f"a step has no '{name}'{suggest(str(name), self)}; known: {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        return iter((*FIELDS, *OTHERS))


STATE_LIMIT = 10.0
"""Largest entry of a state; most are below 1."""
LASTING_SCALE = 0.1
"""Divisor of lasting sensor errors in a state; rad, rad/s, m, or a share."""


def world_states(view: Callable[[str], np.ndarray], scenario: Scenario) -> np.ndarray:
    """Return the state of every world for a central critic, (W, S) float32, scaled; what cannot change is left out.

    - Of every vehicle: its observation (0 if absent); true position / `position_scale`, forward axis and velocity in
      the body frame / `velocity_scale` (with `observation.planar` forwards only, else with the left axis); error of the
      estimated position (m, map frame) and orientation (rad); log10 of the standard deviation of the position, as in
      `position_std`; rest of the way / `position_scale`; 1 if under way; 1 if it has arrived.
    - Of landmarks that are drawn or move: true position / `position_scale`, and 1 if present; velocity of those that
      move.
    - The share of the horizon that has passed; with lasting errors of sensors those of every vehicle / 0.1: odometry
      scale, gyro bias (3), slip (2), turn and shift of the camera (6). Truth that a recording lacks reads 0.
    """
    scales, axes = scenario.observation, 2 if scenario.observation.planar else 3
    vehicles, ended = slice(len(scenario.landmarks), None), view("ended")[..., None]
    p, v = view("position")[..., :axes], view("velocity")[..., : 2 * axes - 3]  # on a plane wheels roll forwards only
    R = view("rotation")[:, vehicles, :axes]
    estimated = np.matmul(view("estimate_rotation"), view("estimate_position")[..., None])[..., :axes, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = (np.log10(view("position_std")) + 1.25) / 1.5
    own = [
        np.where(ended == ABSENT, 0.0, view("observation")),
        p[:, vehicles] / scales.position_scale,
        *(R[..., column] for column in range(axes - 1)),
        v[:, vehicles] / scales.velocity_scale,
        estimated - p[:, vehicles],
        *(each[..., None] for each in (np.radians(view("orientation_error")), spread)),
        view("last_remaining")[..., None] / scales.position_scale,
        ended == Outcome.UNDER_WAY,
        ended == Outcome.ARRIVED,
    ]
    moving = [i for i, each in enumerate(scenario.landmarks) if each.motion.kind != "static"]
    changing = [i for i, each in enumerate(scenario.landmarks) if each.is_drawn or i in moving]
    rest = [
        *(p[:, changing] / scales.position_scale, v[:, moving] / scales.velocity_scale, view("present")[:, changing]),
        view("tick") / (scenario.horizon * scenario.rates.camera),
        *(view(name) / LASTING_SCALE for name in (LASTING_ERRORS if scenario.has_lasting_errors else ())),
    ]
    parts = [np.concatenate(own, axis=2), *rest]
    flat = np.concatenate([part.reshape(len(ended), -1) for part in parts], axis=1, dtype=np.float32)
    return np.asarray(np.nan_to_num(flat.clip(-STATE_LIMIT, STATE_LIMIT), nan=0.0))


RewardFunction = Callable[[Step], Any]
"""Returns the reward of every vehicle, (W, N), for one decision step."""


def check_function(reward: object, device: str) -> None:
    """Make sure that a reward is a function, if there is one, and that its arrays are at hand.

    Raises:
        CoopenvError: it is not so.
    """
    if reward is not None and not callable(reward):
        raise CoopenvError(f"reward: expected a function of a step, got {shown(reward)}")
    if reward is not None and device != "cpu":
        raise CoopenvError(f"reward: a function in Python runs on the host; use device='cpu' instead of '{device}'")


def reward_of(function: RewardFunction, step: Step, earning: np.ndarray) -> np.ndarray:
    """Return the rewards (W, N) of a user's function for rows of a mask (W, N), bool; 0 elsewhere.

    Raises:
        CoopenvError: the function raises something, or returns another shape or what is no number.
    """
    title = f"reward function {getattr(function, '__name__', shown(function))}"
    try:
        values = np.asarray(function(step))
    except Exception as error:  # anybody's code
        raise CoopenvError(f"{title}: {error_text(error)}") from error
    if values.shape != earning.shape or values.dtype.kind not in "biuf":
        worlds, vehicles = earning.shape
        given = f"shape {values.shape} and dtype {values.dtype}"
        raise CoopenvError(
            f"{title}: returned {given}, expected numbers of shape ({worlds}, {vehicles}), worlds x vehicles"
        )
    result = np.where(earning, values, 0.0)
    check_finite(title, result)
    return result


def check_finite(title: str, values: np.ndarray) -> None:
    """Check that the values (W, N, ...) of a user's term are finite.

    Raises:
        CoopenvError: it is not.
    """
    if not np.isfinite(values).all():
        world, vehicle, *_ = place = np.argwhere(~np.isfinite(values))[0]
        raise CoopenvError(
            f"{title}: {values[tuple(place)]} for vehicle_{vehicle + 1} of world {world}, expected a number"
        )


def _locked(values: np.ndarray) -> np.ndarray:
    """Return a read-only view."""
    view = values.view()
    view.flags.writeable = False
    return view


def outcome_words(scenario: Scenario) -> tuple[str, ...]:
    """Return the words of `info["outcome"]` by the values of the field `ended`; that of -1 stands last."""
    return (*(outcome.words for outcome in Outcome), *scenario.termination.own, "absent")
