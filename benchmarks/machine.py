"""Description of the machine beside measured times. No names, no paths."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

from coopenv.base.installation import available_cores


def machine() -> dict[str, Any]:
    """Return what a reader of measured times needs to know."""
    return {
        "processor": processor(),
        "cores_available": available_cores(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": f"{platform.system()} {platform.machine()}",
        "load_average_at_start": os.getloadavg()[0],
    }


def processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
