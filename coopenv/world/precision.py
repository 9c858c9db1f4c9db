"""The Warp types of one floating point precision."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from coopenv.errors import DeviceError, suggest
from coopenv.world.launch import start_warp


@dataclass(frozen=True)
class Precision:
    """Scalar, vector and matrix types that belong together."""

    name: str
    scalar: Any
    numpy: Any
    vec2: Any
    vec3: Any
    mat33: Any
    mat66: Any


SCALARS = {"float32": (wp.float32, np.float32), "float64": (wp.float64, np.float64)}


def precision(dtype: str) -> Precision:
    """Return the types for `float32` or `float64`. Raises DeviceError: another name."""
    if not isinstance(dtype, str) or dtype not in SCALARS:
        raise DeviceError(f"unknown dtype '{dtype}'{suggest(str(dtype), SCALARS)}; known: float32, float64")
    return _precision(dtype)


@cache
def _precision(dtype: str) -> Precision:
    scalar, numpy_type = SCALARS[dtype]
    return Precision(
        name=dtype,
        scalar=scalar,
        numpy=numpy_type,
        vec2=wp.types.vector(2, scalar),
        vec3=wp.types.vector(3, scalar),
        mat33=wp.types.matrix((3, 3), scalar),
        mat66=wp.types.matrix((6, 6), scalar),
    )


def check_device(device: str) -> str:
    """Return the device's canonical name. Raises DeviceError: Warp knows no such device here."""
    start_warp()
    if not isinstance(device, str) or device.split(":")[0] not in ("cpu", "cuda"):
        raise DeviceError(f"unknown device '{device}'; known: cpu, cuda, cuda:0, ...")
    if device.startswith("cuda") and not wp.is_cuda_available():
        raise DeviceError(f"device '{device}' asked for, but no CUDA device is available here; use device='cpu'")
    try:
        return str(wp.get_device(device))
    except (ValueError, RuntimeError):
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"unknown device '{device}'; known: {known}") from None


def device_memory(device: str) -> int | None:
    """Return the bytes of a device's own memory; None: it shares this machine's."""
    found = wp.get_device(device)
    return int(found.total_memory) if found.is_cuda else None
