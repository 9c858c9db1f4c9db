"""SUMO as a co-simulator: its networks, routes and traffic under this project's cameras, radio and observers.

SUMO runs in a process of its own for each world (`coopenv.sumo.process`): worlds of a batch run at the same
time, and the end of one is an error and not the end of this program.
"""

import json
import math
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any
from weakref import finalize

import numpy as np

from coopenv.base.errors import CoopenvError, ScenarioError, check_one_of, shortened
from coopenv.base.installation import install_command
from coopenv.estimation.poses import Array
from coopenv.scenario import Scenario
from coopenv.sources.cosimulation import Moment, Poses, TrafficProgram
from coopenv.sumo import process
from coopenv.sumo.files import departures, route_edges

OWNED = {
    "additional-files": "sumo.additional",
    "begin": "sumo.begin",
    "configuration-file": "sumo.net, sumo.routes and sumo.additional",
    "net-file": "sumo.net",
    "remote-port": "the connection",
    "route-files": "sumo.routes",
    "seed": "the world's seed",
    "step-length": "rates.camera",
}
"""SUMO's options that follow from other parts of a scenario, named here."""

OPTIONS: Mapping[str, Any] = {
    "collision.action": "none",  # collisions are judged here
    "lanechange.duration": 2.0,  # s; a vehicle that changed lanes in one step would jump aside by a lane's width
    "no-step-log": True,
    "no-warnings": True,
    "time-to-teleport": -1.0,  # vehicles in jams do not jump
}
"""SUMO's options unless the scenario gives others."""

ROUNDING = 1e-9  # of ms, and of steps

INSERTION = 60.0
"""Longest wait (s) for SUMO to have room for the driven vehicles."""

PATIENCE = 5.0
"""Longest wait (s) for the process to end."""


class SumoProgram(TrafficProgram):
    """A simulation of SUMO whose vehicles are the scenario's, in its order.

    A driven vehicle begins where SUMO inserts it on its route. It is in the hands of actions (`take`) or of SUMO
    (`release`), and may change between the two at every tick. Vehicles of the traffic begin in SUMO's hands.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Prepare a simulation; its process is started by the first reset.

        Raises:
            CoopenvError: SUMO is not installed.
            ScenarioError: the scenario does not fit to SUMO.
        """
        assert scenario.sumo is not None  # the schema asks for it
        if find_spec("libsumo") is None:
            raise CoopenvError(f"backend 'sumo' needs SUMO, which is not installed: {install_command('sumo')}")
        self._scenario, self._section = scenario, scenario.sumo
        self._names, self._origin = scenario.vehicle_names, np.array(scenario.map.origin[:2])
        bodies = [vehicle.body for vehicle in scenario.vehicles]
        self._front = np.array([body.center[0] + body.size[0] / 2 if body else 0.0 for body in bodies])
        period = 1000.0 / scenario.rates.camera
        if period < 1.0:
            raise ScenarioError(f"rates.camera: SUMO's shortest step is 1 ms, not {period:.6g} ms")
        self._step_ms = math.floor(period + ROUNDING)  # whole ms; poses at ticks between two steps are interpolated
        self._steps_per_tick = period / self._step_ms if period - self._step_ms > ROUNDING else 1.0
        self._request = self._reset_request()
        self._begin_taken = np.array([vehicle.motion.kind == "driven" for vehicle in scenario.vehicles])
        self._taken = self._begin_taken.copy()
        self._seed, self._moved = -1, list[Array]()  # the second for each step of SUMO
        self._process: subprocess.Popen[bytes] | None = None
        self._unanswered = False
        self._last = np.zeros((len(bodies), 4))

    def _reset_request(self) -> dict[str, Any]:
        section, scenario = self._section, self._scenario
        for key in section.options:
            if key in OWNED:
                raise ScenarioError(f"sumo.options.{key}: follows from {OWNED[key]}; leave this out")
        files = {"net-file": [section.net], "route-files": section.routes, "additional-files": section.additional}
        options = {key: ",".join(paths) for key, paths in files.items() if paths}
        options |= {"begin": str(section.begin), "step-length": str(self._step_ms / 1000.0)}
        arguments = [f"--{key}={_option(value)}" for key, value in {**OPTIONS, **section.options, **options}.items()]
        edges = route_edges(section) if scenario.driven else {}
        vehicles: list[dict[str, Any] | None] = []
        for i, (vehicle, limits) in enumerate(zip(scenario.vehicles, scenario.limits, strict=True)):
            if vehicle.motion.kind != "driven":
                vehicles.append(None)
                continue
            if len(vehicle.routes) != 1 or vehicle.body is None:
                raise ScenarioError(f"vehicles.{i}: SUMO needs one of its routes, and a body, of a driven vehicle")
            check_one_of(f"vehicles.{i}.routes: unknown route of SUMO", vehicle.routes[0], edges, ScenarioError)
            route = edges[vehicle.routes[0]]
            vehicles.append({"route": route, "size": vehicle.body.size, "speed": limits.max_speed})
        return {
            "do": "reset",
            "arguments": arguments,
            "until": section.begin + section.warm_up,
            "vehicles": vehicles,
            "center": scenario.map.origin[:2],
            "wait": INSERTION,
        }

    def take(self, vehicle: str) -> None:
        """Let actions drive a vehicle from the next tick on. Raises CoopenvError: there is none of that name."""
        self._taken[self._index(vehicle)] = True

    def release(self, vehicle: str) -> None:
        """Let SUMO drive a vehicle along its route from the next tick on, from the nearest lane of the route.

        Raises:
            CoopenvError: there is none of that name, or it is no longer in SUMO.
        """
        i = self._index(vehicle)
        if np.isnan(self._last[i, 0]):
            raise CoopenvError(f"{vehicle}: no longer in SUMO: it has left the road or reached the end of its route")
        self._taken[i] = False

    def _index(self, vehicle: str) -> int:
        check_one_of("unknown vehicle", vehicle, self._names)
        return self._names.index(vehicle)

    def reset(self, seed: int) -> None:
        """Load the network and let traffic drive for `sumo.warm_up`; see `TrafficProgram`."""
        if self._unanswered:  # an interrupt has come between a request and its reply
            self.close()
        self._taken[:] = self._begin_taken
        self._seed, self._moved = seed % 2**31, []
        self._ask({**self._request, "arguments": [*self._request["arguments"], f"--seed={self._seed}"]})

    def command(self, now: Moment) -> None:
        """Let SUMO drive to the next tick or just beyond; taken vehicles are then where they drive to until then."""
        begun, at = len(self._moved), self._ticks * self._steps_per_tick
        end = math.ceil((self._ticks + 1) * self._steps_per_tick - ROUNDING)
        self._step([self._rows_after(now, (k + 1 - at) * self._step_ms / 1000.0) for k in range(begun, end)])

    @property
    def _ticks(self) -> int:
        """Ticks since the reset."""
        return math.floor(len(self._moved) / self._steps_per_tick + ROUNDING)

    def _rows_after(self, now: Moment, dt: float) -> Array:
        """Return vehicle, x, y (m) and angle (deg) of the taken vehicles dt s later; NaN: it is gone."""
        turned = now.heading + now.yaw_rate * dt
        middle, moved = now.heading + now.yaw_rate * dt / 2, np.full((len(turned), 4), np.nan)
        xy = now.xy + self._origin + (now.speed * dt)[:, None] * _direction(middle)
        moved[:, 0] = np.arange(len(turned))
        moved[:, 1:3] = xy + self._front[:, None] * _direction(turned)
        moved[:, 3] = 90.0 - np.degrees(turned)
        gone = np.logical_not(now.present)
        moved[gone, 1:] = np.nan
        return moved[self._taken | gone]

    def _step(self, moves: list[Array]) -> None:
        """Let SUMO drive so many steps, to the first that is not before a tick."""
        if self._process is None:
            raise CoopenvError("SUMO is not running: reset() starts it")
        self._moved += moves
        share = min(1.0, 1.0 - (len(self._moved) - self._ticks * self._steps_per_tick))
        rows = [[[int(i), *(None if np.isnan(x) else float(x) for x in row)] for i, *row in moved] for moved in moves]
        self._ask({"do": "step", "moves": rows, "share": share})

    def poses(self) -> Poses:
        """Return all poses, see `TrafficProgram`."""
        own, others = self._answer()
        left = np.isnan(own[:, 0])
        self._last = own
        heading, traffic_heading = (np.radians(90.0 - some[:, 2]) for some in (own, others))
        half = others[:, 3:] / 2
        position = others[:, :2] - half[:, :1] * _direction(traffic_heading) - self._origin
        xy = own[:, :2] - self._front[:, None] * _direction(heading) - self._origin
        return Poses(
            xy=np.where(left[:, None], 0.0, xy),
            heading=np.where(left, 0.0, heading),
            speed=np.where(left, 0.0, own[:, 3]),
            steering=np.zeros(len(own)),
            crashed=np.zeros(len(own), bool),
            left=left & ~self._taken,
            traffic_position=np.column_stack([position, half[:, 2]]),
            traffic_heading=traffic_heading,
            traffic_half=half,
            driven=self._taken,
        )

    def _ask(self, request: Mapping[str, Any]) -> None:
        if self._process is None:
            command = [sys.executable, "-P", str(Path(process.__file__))]
            pipe, self._errors = subprocess.PIPE, tempfile.TemporaryFile()  # noqa: SIM115 (closed by _end)
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._errors)
            self._end = finalize(self, _end, self._process, self._errors)
        self._unanswered = True
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._fail()

    def _answer(self) -> tuple[Array, Array]:
        """Return x, y (m), angle (deg) and speed (m/s) of the vehicles, and x, y, angle and size of all others."""
        assert self._process is not None and self._process.stdout is not None
        line = self._process.stdout.readline()
        head = json.loads(line) if line.endswith(b"\n") else self._fail()
        if "error" in head:
            too_few = head["error"].startswith("vehicles: ")
            self._fail(head["error"] + (departures(self._section) if too_few else ""))
        size = 8 * (4 * head["own"] + 6 * head["others"])
        body = self._process.stdout.read(size)
        if len(body) < size:
            self._fail()
        self._unanswered = False
        values = np.frombuffer(body)
        return values[: 4 * head["own"]].reshape(-1, 4), values[4 * head["own"] :].reshape(-1, 6)

    def _fail(self, why: str = "") -> Any:
        """End the process. Raises CoopenvError: SUMO's own error, or how the process ended."""
        process, at = self._process, self._ticks / self._scenario.rates.camera
        status = None if why or process is None else process.wait(PATIENCE)
        self._errors.seek(0)
        _, said, error = self._errors.read().decode(errors="replace").rpartition("Error: ")
        self.close()
        if status is not None and status < 0:
            raise CoopenvError(f"SUMO was ended by {signal.Signals(-status).name} {at:g} s after the reset")
        reason = " ".join((error if said else why or f"it ended with status {status}").split())
        raise CoopenvError(f"SUMO, {at:g} s after the reset: {shortened(reason, 300)}")

    def save(self) -> dict[str, Any]:
        """Return the seed, and what vehicles have been moved to since the reset: SUMO repeats itself."""
        return {"seed": self._seed, "moved": [rows.copy() for rows in self._moved], "taken": self._taken.copy()}

    def accepts(self, saved: Any) -> bool:
        """Return whether it is such a record for as many vehicles."""
        if not isinstance(saved, Mapping) or not {"seed", "moved", "taken"} <= saved.keys():
            return False
        seed, moved, taken, count = saved["seed"], saved["moved"], saved["taken"], len(self._taken)
        return (
            type(seed) is int
            and isinstance(moved, list)
            and all(_are_rows(rows, count) for rows in moved)
            and isinstance(taken, np.ndarray)
            and (taken.dtype, taken.shape) == (np.dtype(bool), (count,))
        )

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Drive again from the reset on."""
        if saved["seed"] >= 0:
            self.reset(saved["seed"])
            self._answer()
            if saved["moved"]:
                self._step([rows.copy() for rows in saved["moved"]])
                self._last, _ = self._answer()
        self._taken = saved["taken"].copy()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._end()
        self._process, self._unanswered = None, False


def _end(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    process.kill()
    process.communicate()
    errors.close()


def _option(value: Any) -> str:
    given = value if isinstance(value, list) else [value]
    return ",".join(str(x).lower() if isinstance(x, bool) else str(x) for x in given)


def _direction(heading: Array) -> Array:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _are_rows(rows: Any, count: int) -> bool:
    """Return whether these are rows of vehicle, x, y and angle."""
    if not isinstance(rows, np.ndarray) or rows.dtype != np.float64 or rows.ndim != 2 or rows.shape[1] != 4:
        return False
    return bool(np.isin(rows[:, 0], np.arange(count)).all() and not np.isinf(rows).any())
