"""The Warp types of one floating point precision."""

from dataclasses import dataclass
from typing import Any

import warp as wp

from coopenv.base.errors import DeviceError, suggest
from coopenv.world.launch import start_warp


@dataclass(frozen=True)
class Precision:
    """Scalar, vector and matrix types that belong together."""

    name: str
    scalar: Any
    numpy: Any
    vec2: Any
    vec3: Any
    vec4: Any
    mat33: Any
    mat66: Any


def _precision(scalar: Any) -> Precision:
    vector, matrix, number = wp.types.vector, wp.types.matrix, wp.dtype_to_numpy(scalar)
    small = vector(2, scalar), vector(3, scalar), vector(4, scalar), matrix((3, 3), scalar)
    return Precision(scalar.__name__, scalar, number, *small, matrix((6, 6), scalar))


PRECISIONS = {"float32": _precision(wp.float32), "float64": _precision(wp.float64)}


def precision(dtype: str) -> Precision:
    """Return the types for `float32` or `float64`. Raises DeviceError: another name."""
    if not isinstance(dtype, str) or dtype not in PRECISIONS:
        raise DeviceError(f"unknown dtype '{dtype}'{suggest(str(dtype), PRECISIONS)}; known: float32, float64")
    return PRECISIONS[dtype]


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
