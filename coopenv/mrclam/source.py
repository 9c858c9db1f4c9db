"""MR.CLAM as a kind of source: `mrclam_1` .. `mrclam_9`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from coopenv.sources.registry import SourceKind

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording

NAMES = re.compile(r"mrclam_\d+(_space)?")


def is_dataset(name: str, topics: str | Path | None) -> bool:
    """Return whether a name is that of a sub-dataset, be there one of that number or not."""
    return NAMES.fullmatch(name) is not None


def read(name: str | Path, data: str | Path | None, variant: str | None) -> Recording:
    """Return a sub-dataset; arguments and errors as for `coopenv.sources.sources.open_recording`."""
    from coopenv.mrclam.dataset import IN_SPACE
    from coopenv.mrclam.recording import check_variant, load_dataset, recording_of

    chosen = check_variant(variant or "landmarks+robots")  # before much is read
    return recording_of(load_dataset(str(name).removesuffix(IN_SPACE), data), chosen)


MRCLAM = SourceKind(
    title="a sub-dataset of MR.CLAM",
    opener="coopenv.sources.sources:replay_of",
    claims=is_dataset,
    options=("data", "variant", "selection"),
    recorded=True,
    reader="coopenv.mrclam.source:read",
    example="mrclam_1 .. mrclam_9",
    comparison="coopenv.mrclam.comparison:Robots",
    variants={
        "landmarks": "no robot sees another",
        "landmarks+robots": "everything that was seen counts",
        "blind": "robots 3 to 5 see no landmark",
    },
    caveat="Friendly: robots start at their true pose; who is seen is known from barcodes, "
    "their own left out; the nominal calibration was fitted to sub-dataset 6; all receive from all, 10 Hz, no loss.",
)
