"""Recordings by name: MCAP files, and the sub-datasets of MR.CLAM."""

from __future__ import annotations

import re
from pathlib import Path
from typing import cast

from coopenv.errors import DataError
from coopenv.observers.recording import Recording

SUFFIX = ".mcap"
DATASETS = re.compile(r"mrclam_\d+")
DEFAULT_VARIANT = "landmarks+robots"


def is_recorded(name: str | Path) -> bool:
    """Return whether a name is that of a recording and not of an environment."""
    return str(name).endswith(SUFFIX) or DATASETS.fullmatch(str(name)) is not None


def open_recording(name: str | Path, data: str | Path | None = None, variant: str | None = None) -> Recording:
    """Read a recording.

    Args:
        name: path of an MCAP file, or `mrclam_1` .. `mrclam_9`.
        data: folder of the data sets (None: what COOPENV_DATA says).
        variant: of a data set: "landmarks", "landmarks+robots" (as recorded, the default) or "blind".

    Raises:
        CoopenvError: no such recording or variant, or the file is not what it should be.
    """
    if str(name).endswith(SUFFIX):
        if variant is not None:
            raise DataError(f"{name}: a file has no variants, got variant '{variant}'")
        from coopenv.backends.mcap import read_recording

        return read_recording(name)
    if not is_recorded(name):
        raise DataError(f"'{name}' is no recording; known: FILE{SUFFIX}, mrclam_1 .. mrclam_9")
    from coopenv.backends.mrclam import load_dataset
    from coopenv.backends.mrclam.recording import recording_of
    from coopenv.backends.mrclam.variants import Variant, check_variant

    chosen = variant or DEFAULT_VARIANT
    check_variant(chosen)
    return recording_of(load_dataset(str(name), data), cast(Variant, chosen))
