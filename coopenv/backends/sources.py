"""Backends by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopenv.backends.base import Backend
from coopenv.backends.replay import Replay, is_recorded, open_recording
from coopenv.backends.simulated import Simulated
from coopenv.errors import CoopenvError, suggest
from coopenv.scenario import load_scenario

BACKENDS = ("simulated", "replay")


def open_backend(
    name_or_path: str | Path,
    backend: str | None,
    overrides: Mapping[str, Any],
    data: str | Path | None = None,
    variant: str | None = None,
) -> Backend:
    """Return where the ticks of an environment or a recording come from.

    Args:
        name_or_path: environment, TOML file, MCAP file or data set.
        backend: one of `BACKENDS`; None: as the name says.
        overrides: dotted scenario keys.
        data: folder of the data sets.
        variant: of a data set.

    Raises:
        CoopenvError: any of it does not exist or does not fit.
    """
    if backend is not None and backend not in BACKENDS:
        raise CoopenvError(
            f"unknown backend '{backend}'{suggest(str(backend), BACKENDS)}; known: {', '.join(BACKENDS)}"
        )
    if backend == "replay" or (backend is None and is_recorded(name_or_path)):
        return Replay(open_recording(name_or_path, data, variant), Path(name_or_path).name, overrides)
    for what, value in (("data", data), ("variant", variant)):
        if value is not None:
            raise CoopenvError(f"{what} is for recorded data, '{name_or_path}' is simulated")
    return Simulated(load_scenario(name_or_path, overrides))
