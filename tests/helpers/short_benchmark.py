"""The frozen benchmark with short scenes, for tests of what it does with observers."""

from __future__ import annotations

from typing import Any

from coopenv.bench.frozen import Frozen


def short_definition(seeds: int, horizon: float) -> dict[str, Any]:
    """Return the definition of the benchmark with fewer seeds, and scenes of some seconds."""
    definition = Frozen("v1").definition
    scenes = [{**about, "set": {**about.get("set", {}), "horizon": horizon}} for about in definition["scenes"]]
    return definition | {"seeds": seeds, "scenes": scenes}
