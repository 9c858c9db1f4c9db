"""Recordings of episodes, and trajectories written for other tools."""

from collections.abc import Callable
from io import StringIO
from pathlib import Path

import numpy as np

from coopenv.api.engine import Engine
from coopenv.backends.base import Backend
from coopenv.backends.sources import simulation_of
from coopenv.base.files import replace_text, writing
from coopenv.estimation.observability import Trajectory
from coopenv.estimation.poses import quaternion_wxyz
from coopenv.evaluation.episodes import Views, play
from coopenv.observers.mailbox import Interference, interference_of, stacked
from coopenv.observers.recording import MEASURED, Drawn, Recording, Sensed, Truth, is_due
from coopenv.policies import Policy, load_policy
from coopenv.scenario import Scenario


def record(
    source: Scenario | Backend,
    seed: int = 0,
    policy: str | Policy = "zero",
    on_progress: Callable[[float], None] = lambda share: None,
    on_tick: Callable[[Engine, int], None] = lambda engine, tick: None,
) -> Recording:
    """Drive a backend in float64 to its horizon, or as long as it has ticks, and keep what is sensed.

    Args:
        source: where the ticks come from; a scenario is simulated.
        seed: of the episode.
        policy: of driven vehicles: "zero", "random", the name of an agent, or a function of the observations.
        on_progress: called with the share of the horizon that is done.
        on_tick: called with the engine and the tick's number after every tick, 0 included.

    Raises:
        CoopenvError: unknown policy or observer, or the backend cannot begin.
    """
    backend: Backend = simulation_of(source) if isinstance(source, Scenario) else source
    scenario = backend.scenario
    driver = load_policy(policy, scenario, seed) if isinstance(policy, str) else policy
    engine = Engine(scenario, 1, "float64", backend=backend)
    views = Views(engine, ("rotation", "position", "estimate_rotation", "estimate_position", "inbox_tick"))
    ticks: list[Sensed] = []
    faults: list[Interference | None] = []
    drawn = None
    for k in play(engine, [seed], scenario.horizon_ticks, driver if scenario.driven else None):
        views.take()
        if k == 0 and backend.capabilities.batched:
            key, episode, parameters = (engine.view(name)[0].tolist() for name in ("seed", "episode", "parameter"))
            drawn = Drawn(key, episode, tuple(parameters))
        ticks.append(engine.world.sensed(0, k))
        faults.append(interference_of(scenario, engine.world.model, engine.view, 0, k))
        on_tick(engine, k)
        on_progress(k / scenario.horizon_ticks)
    L, observer_init = len(scenario.landmarks), engine.world.observer_init
    names = MEASURED if scenario.action.pan is None else (*MEASURED, "pan")
    kept = {name: np.stack([getattr(tick, name) for tick in ticks]) for name in names}
    start_rotation = views["estimate_rotation"][0, 0]
    return Recording(
        setups=observer_init.setups,
        order=observer_init.order,
        dt=observer_init.dt,
        period=observer_init.period,
        staleness=observer_init.staleness,
        due=is_due(np.arange(len(ticks)), engine.world.model.observer.rate / scenario.rates.camera),
        inbox_tick=views["inbox_tick"][:, 0].astype(np.int64),
        start_rotation=start_rotation,
        start_position=(start_rotation @ views["estimate_position"][0, 0][..., None])[..., 0],
        start_covariance=observer_init.start_covariance,
        truth=Truth(views["rotation"][:, 0, L:], views["position"][:, 0, L:]),
        scenario=scenario,
        drawn=drawn,
        interference=stacked(faults),
        **kept,
    )


def write_tum(trajectory: Trajectory, folder: str | Path) -> list[Path]:
    """Write `VEHICLE_truth.tum` and `VEHICLE_estimate.tum` of every vehicle, and return their paths.

    Poses are of the body in the map frame, m; ticks at which a pose is not finite are left out.

    Raises:
        OutputError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, name in enumerate(trajectory.vehicles.tolist()):
        poses = {
            "truth": (trajectory.position[:, i], trajectory.rotation[:, i]),
            "estimate": (trajectory.position_estimate[:, i], trajectory.rotation_estimate[:, i]),
        }
        for kind, (position, rotation) in poses.items():
            known = np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
            quaternion = quaternion_wxyz(rotation[known])[:, [1, 2, 3, 0]]
            text = StringIO()
            np.savetxt(text, np.column_stack([trajectory.t[known], position[known], quaternion]), "%.9f")
            paths.append(folder / f"{name}_{kind}.tum")
            replace_text(paths[-1], text.getvalue())
    return paths
