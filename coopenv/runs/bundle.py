"""A run as one checked file, which `coopenv run` replays: scenario, seed, actions, versions, and a state near its end.

A ZIP archive of `manifest.json`, `scenario.json`, `arrays.npz` and, to read, `code/NAME.py`: the user's files of an
observer and of terms. The manifest holds the digest of every other part, the archive's comment that of the manifest.
Code in the archive is never executed: a replay needs files with the same digests in the current folder. The files of a
simulator, such as networks, are not in the archive, their digests are.
"""

import json
import re
import zipfile
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from coopenv.base.errors import ActionError, CoopenvError, DataError, error_text, listed, shortened, shown
from coopenv.base.files import replacing_file
from coopenv.base.format import json_text, jsonable, members_of
from coopenv.base.installation import (
    beside,
    data_directory,
    file_digest,
    importing_vouched,
    is_reference,
    versions,
)
from coopenv.base.sections import Section, validated
from coopenv.observers.registry import named, portable
from coopenv.runs.rollouts import Rollout
from coopenv.scenario import load_scenario, parse_scenario
from coopenv.scenario.cosimulators import Sumo
from coopenv.scenario.own_terms import located
from coopenv.world.warp_internals import kernel_hashes

RECORD_FILE = "record.zip"
MANIFEST = "manifest.json"
PARTS = {MANIFEST: 2**20, "scenario.json": 2**24, "arrays.npz": 2**28}
"""Names of the parts with the most bytes that each may unpack to."""
CODE, MOST_CODE = re.compile(r"code/[^/\\]+\.py"), 2**20
"""Names of the parts with code, and the most bytes of one."""
FIGURE_TOLERANCE = 1e-6
"""Relative, of figures that count as the same: other processors round differently."""


Count = Annotated[int, Field(ge=0)]


class RunEnd(Section):
    """End of a run."""

    tick: Count
    error: str
    """Empty: none."""
    by_driver: bool = False
    """True if the error was the driver's; a driver is not replayed."""
    figures: dict[Literal["position_error", "orientation_error"], list[float | None]]
    """Last errors of the vehicles, m and deg; none: not known."""


class Manifest(Section):
    """Description of a run."""

    format: Literal["coopenv-run 2"] = "coopenv-run 2"
    environment: str
    seed: Count
    policy: str
    observer: str
    dtype: str
    device: str
    ticks_planned: Count
    versions: dict[str, str]
    kernels: dict[str, str]
    """Hashes of the modules of kernels, by name."""
    state_tick: Count
    """Tick of the saved state."""
    end: RunEnd
    parts: dict[str, str]
    """Digests of the other parts, by name."""


class RunRecord:
    """The actions of a run, and its state at the last two full seconds."""

    def __init__(self, run: Rollout) -> None:
        self.run = run
        self._actions: list[np.ndarray] = []
        self._states: deque[tuple[int, dict[str, np.ndarray]]] = deque(maxlen=2)
        self.last = 0

    def tick(self, tick: int) -> None:
        """Store the data of a simulated tick."""
        world = self.run.engine.world
        self.last = tick
        if tick % max(1, round(self.run.scenario.rates.camera)) == 0:
            self._states.append((tick, world.get_state()))
        if tick > 0:
            self._keep_actions((tick - 1) // world.model.ticks_per_decision)

    def _keep_actions(self, decision: int) -> None:
        if decision == len(self._actions):
            self._actions.append(self.run.engine.view("actions")[0].copy())

    def save(self, path: Path, environment: str, error: CoopenvError | None = None) -> None:
        """Write the file of a run of an environment that has ended, with an error or without.

        A driver is not part of it: a run in which the driver failed ends before that.

        Raises:
            OutputError: it cannot be written.
        """
        run, world, model = self.run, self.run.engine.world, self.run.engine.world.model
        by_driver = isinstance(error, ActionError)
        if error and self._states and not by_driver:  # in the tick after the last
            self._keep_actions(self.last // model.ticks_per_decision)
        before, state = self._states[0] if self._states else (0, {})
        empty = np.zeros((0, model.vehicles, model.action_size))
        arrays = {"actions": np.array(self._actions or empty), **{f"state.{name}": a for name, a in state.items()}}
        buffer = BytesIO()
        np.savez(buffer, **arrays)  # type: ignore[arg-type]
        parts = {"arrays.npz": buffer.getvalue()}

        code: dict[str, Path] = {}
        keep = partial(beside, code=code)
        scenario = located(run.scenario.model_dump(mode="json", exclude_unset=True), Path(), keep)
        parts["scenario.json"] = json_text(scenario).encode()
        place = portable(run.scenario.observer.name)
        named_by_place = isinstance(place, str) and is_reference(place)
        observer = keep(str(place), Path()) if named_by_place else run.scenario.observer.name
        parts |= {f"code/{name}": file.read_bytes() for name, file in code.items() if file.suffix == ".py"}
        manifest = Manifest(
            environment=environment,
            seed=run.seed,
            policy=run.policy_name,
            observer=observer,
            dtype=world.precision.name,
            device=world.device,
            ticks_planned=self.last if by_driver else run.ticks_planned,
            versions=versions("coopenv", "numpy", "warp-lang"),
            kernels=kernel_hashes(),
            state_tick=before,
            end=RunEnd(tick=self.last, error=str(error or ""), by_driver=by_driver, figures=figures_of(run)),
            parts={f"code/{name}": file_digest(file) for name, file in code.items()}
            | {name: sha256(content).hexdigest() for name, content in parts.items()},
        )
        parts[MANIFEST] = json_text(manifest.model_dump()).encode()
        with replacing_file(path) as new, zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.comment = sha256(parts[MANIFEST]).hexdigest().encode()
            for name, content in parts.items():
                archive.writestr(name, content)


def figures_of(run: Rollout) -> dict[Literal["position_error", "orientation_error"], list[float | None]]:
    """Return the last errors of the vehicles, m and deg; None: not known."""
    position, orientation = (run.engine.view(name)[0] for name in ("position_error", "orientation_error"))
    return {"position_error": jsonable(position), "orientation_error": jsonable(orientation)}


@dataclass(frozen=True)
class Bundle:
    """A file of a run, checked."""

    path: Path
    manifest: Manifest
    scenario: dict[str, Any]
    arrays: dict[str, np.ndarray]

    @classmethod
    def read(cls, path: Path) -> "Bundle":
        """Read a file. Raises DataError: it is cut off, changed, or not of this format."""
        try:
            with zipfile.ZipFile(path) as archive:
                sizes = {name: part.file_size for name, part in members_of(archive).items()}
                most = {name: PARTS.get(name, MOST_CODE if CODE.fullmatch(name) else -1) for name in sizes}
                wrong = [name for name, size in sizes.items() if size > most[name]]
                missing = [name for name in PARTS if name not in sizes]
                if wrong or missing:
                    found = f"{listed(missing or wrong)} {'missing' if missing else 'unknown or too large'}"
                    raise DataError(f"{path}: not a run: parts {found}")
                parts = {name: archive.open(name).read(size) for name, size in sizes.items()}
            manifest = validated(Manifest, parts[MANIFEST], f"{path}: {MANIFEST}", DataError)
            digests = {**manifest.parts, MANIFEST: archive.comment.decode()}
            for name, content in parts.items():
                if digests.get(name) != sha256(content).hexdigest():
                    raise DataError(f"{path}: {name}: not the part that was written, its digest differs")
            with zipfile.ZipFile(BytesIO(parts["arrays.npz"])) as inner:
                if any(part.compress_type != zipfile.ZIP_STORED for part in inner.infolist()):
                    raise DataError(f"{path}: arrays.npz: is packed twice")
            with np.load(BytesIO(parts["arrays.npz"]), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            made = cls(path, manifest, json.loads(parts["scenario.json"]), arrays)
            made._check()
            return made
        except CoopenvError:
            raise
        except Exception as error:  # any error of zipfile, NumPy and JSON for malformed files
            raise DataError(
                f"{path}: not a readable run ({getattr(error, 'strerror', None) or error_text(error)})"
            ) from None

    def _check(self) -> None:
        actions = self.arrays["actions"]
        if not isinstance(self.scenario, dict) or not isinstance(self.scenario.get("observer", {}), dict):
            raise DataError(f"{self.path}: scenario.json: not a scenario, or its observer no table")
        if self.manifest.state_tick > self.manifest.end.tick:
            raise DataError(f"{self.path}: manifest.json: state_tick: later than the end")
        if actions.ndim != 3 or actions.dtype.kind != "f" or not (np.abs(actions) <= 1.0).all():
            raise DataError(
                f"{self.path}: arrays.npz: actions: expected numbers from -1 to 1, decisions x vehicles x parts"
            )

    @property
    def title(self) -> str:
        """Title of the run."""
        about = self.manifest
        names = f"{shortened(about.environment, 200)}, {shortened(about.observer)}"
        return f"{names}, seed {about.seed}, {about.end.tick} ticks"

    def other_versions(self) -> list[str]:
        """Return the versions of the run, and their differences here."""
        here, made = versions("coopenv", "numpy", "warp-lang"), self.manifest.versions
        others = {name: shortened(str(made.get(name))) for name, number in here.items() if made.get(name) != number}
        return [f"{name} {number}, here {here[name]}" for name, number in others.items()]

    def replay(self) -> list[str]:
        """Run it again and return what has come out otherwise, in words; empty: all is as it was.

        Raises:
            CoopenvError: the scenario is not valid, or code or a file is not here that has the digest of the manifest.
        """
        with importing_vouched(Path.cwd(), self.manifest.parts):
            return self._replayed()

    def _replayed(self) -> list[str]:
        about, end = self.manifest, self.manifest.end
        raw = located(self.scenario, Path(), self._here)
        if is_reference(about.observer):
            raw["observer"] = {**raw.get("observer", {}), "name": named(self._here(about.observer, Path()))}
        self._check_options(raw)
        scenario = parse_scenario(raw, f"{self.path.name}: scenario.json")
        drivers = [f"vehicles.{i}.motion.driver" for i, driver in enumerate(scenario.drivers) if driver is not None]
        scenario = load_scenario(scenario, dict.fromkeys(drivers))  # their actions are in the file
        actions = self.arrays["actions"]
        rows, none = iter(actions), np.zeros(actions.shape[1:])
        run = Rollout(scenario, about.seed, None, about.dtype, about.device, lambda observations: next(rows, none))
        expected = (len(scenario.vehicles), run.engine.world.model.action_size)
        if actions.shape[1:] != expected or len(actions) * scenario.ticks_per_decision < end.tick:
            raise DataError(f"{self.path}: arrays.npz: actions: expected {expected} per decision")
        run.ticks_planned, error, last, differing = about.ticks_planned, "", 0, []
        try:
            for last in run.play():
                if last == about.state_tick:
                    differing += self._differing_state(run)
                if last > end.tick:
                    break
        except CoopenvError as failure:
            error = str(failure)
        if kernels := [n for n, digest in kernel_hashes().items() if about.kernels.get(n) != digest]:
            differing.append(f"kernels {listed(kernels)}")
        if (last, error) != (end.tick, "" if end.by_driver else end.error):
            differing.append(f"after tick {last}: {error or 'no error'}")
        for name, values in figures_of(run).items():
            now, before = (np.array(some, float) for some in (values, end.figures.get(name)))
            if now.shape != before.shape or not np.allclose(now, before, rtol=FIGURE_TOLERANCE, equal_nan=True):
                differing.append(f"last {name.replace('_', ' ')} {', '.join(f'{value:.4g}' for value in now)}")
        return differing

    def _check_options(self, raw: Mapping[str, Any]) -> None:
        """Refuse options with which another simulator would write files or import code."""
        sumo, highway = raw.get("sumo"), raw.get("highway")
        options = sumo.get("options") if isinstance(sumo, dict) else None
        if options and not (isinstance(options, dict) and options.keys() <= {*Sumo.traffic_options}):
            raise DataError(f"{self.path}: scenario.json: sumo.options: can write files, so it is not replayed")
        config = highway.get("config") if isinstance(highway, dict) else None
        for key, value in config.items() if isinstance(config, dict) else ():
            if isinstance(value, str) and "." in value and not value.startswith("highway_env."):
                raise DataError(f"{self.path}: scenario.json: highway.config.{key}: names code: {shown(value)}")

    def _here(self, reference: str, folder: Path) -> str:
        """Return the path of a reference's file here: without the digest of the manifest it is neither run nor read.

        Files that ship with coopenv, networks, need none.
        """
        place, colon, name = reference.rpartition(":")
        file = folder.absolute() / Path(place if colon else name).name
        part, shipped = f"code/{file.name}", data_directory("envs") / file.name
        digest = self.manifest.parts.get(part) if file.suffix == ".py" or not colon else None
        for path in (file, shipped) if digest else [shipped] * (not colon):
            if path.is_file() and digest in (None, file_digest(path)):
                return f"{path}{colon}{name if colon else ''}"
        if digest is None:
            raise DataError(f"{self.path}: names {shown(reference)} without the digest of a file: not run, not read")
        where = f"its {part} here as {file.name}: unzip and read it" if file.suffix == ".py" else f"{file.name} here"
        raise DataError(f"{self.path}: needs {where}")

    def _differing_state(self, run: Rollout) -> list[str]:
        before = {name.removeprefix("state."): array for name, array in self.arrays.items() if name != "actions"}
        now = run.engine.world.get_state()
        # NaN stand for what is not there: bytes are compared
        same = [
            n for n in now if n in before and (now[n].dtype, now[n].tobytes()) == (before[n].dtype, before[n].tobytes())
        ]
        changed = sorted({*now, *before}.difference(same)) if before else []
        time = self.manifest.state_tick / run.scenario.rates.camera
        return [f"state at {time:g} s: {listed(changed, 6)}"] if changed else []
