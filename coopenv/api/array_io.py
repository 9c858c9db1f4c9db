"""Hand arrays of a batch in and out: NumPy copies on the host, or torch tensors that share memory."""

from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
import warp as wp

from coopenv.api.engine import Engine
from coopenv.base.errors import ActionError, CoopenvError

ArrayKind = Literal["numpy", "torch"]


class Exchange:
    """Gives fields of an engine as rows (W N, ...) and takes actions as rows."""

    def __init__(self, engine: Engine, kind: ArrayKind | None) -> None:
        """Choose what arrays look like.

        Args:
            engine: the batch.
            kind: "numpy": fresh host arrays; "torch": tensors on the engine's device that share its memory and are
                overwritten by the next step. None: "numpy" on the CPU, "torch" on CUDA.

        Raises:
            CoopenvError: another kind, or torch is not installed.
        """
        self._engine = engine
        self._on_cpu = engine.world.device == "cpu"
        self.kind: ArrayKind = kind if kind is not None else ("numpy" if self._on_cpu else "torch")
        if self.kind not in ("numpy", "torch"):
            raise CoopenvError(f"unknown arrays '{kind}'; known: numpy, torch")
        if self.kind == "torch" and find_spec("torch") is None:
            raise CoopenvError("arrays='torch' needs torch: pip install '.[train]'")
        self._shape: tuple[int, ...] = tuple(engine.array("actions").shape)
        self._rows = self._shape[0] * self._shape[1]
        self._tensors: dict[str, Any] = {}
        self._stream: Any = None

    def follow_torch(self) -> None:
        """Queue this engine's kernels on torch's current CUDA stream, so that neither overtakes the other."""
        if self._on_cpu or self.kind != "torch":
            return
        import torch

        device = self._engine.world.device
        current = torch.cuda.current_stream(wp.device_to_torch(device))
        if self._stream is None or self._stream.cuda_stream != current.cuda_stream:
            self._stream = wp.stream_from_torch(current)
        # The first time, wait for what was queued on the stream so far, such as the building of the world.
        wp.set_stream(self._stream, device, sync=wp.get_stream(device) != self._stream)

    def rows(self, name: str) -> Any:
        """Return a field: a copy on the host, or a tensor that shares memory."""
        if self.kind == "numpy":
            view = self._engine.view(name)
            return view.reshape(self._rows, *view.shape[2:]).copy()
        tensor = self._tensors.get(name)
        if tensor is None:
            whole = wp.to_torch(self._engine.array(name))
            tensor = self._tensors[name] = whole.reshape(self._rows, *whole.shape[2:])
        return tensor

    def time(self) -> Any:
        """Return (W N,) s since the start of each row's episode."""
        engine, vehicles = self._engine, self._shape[1]
        period = float(engine.world.model.camera_period)
        if self.kind == "numpy":
            return np.repeat(engine.view("tick") * period, vehicles)
        import torch

        ticks = wp.to_torch(engine.array("tick"))
        return torch.repeat_interleave(ticks * period, vehicles)

    def owned(self, rows: Any) -> Any:
        """Return rows that `rows()` gave, or dictionaries of them, as what the next step does not touch."""
        if isinstance(rows, dict):
            return {name: self.owned(values) for name, values in rows.items()}
        return rows if self.kind == "numpy" else rows.clone()

    def set_actions(self, actions: Any) -> None:
        """Take actions (W N, A), or (W, N, A), clipped to [-1, 1] by the actuators.

        A tensor that is on the device already is copied there; whether it is finite is not checked, as that would
        wait for the device: an action that is not finite counts as zero.

        Raises:
            ActionError: wrong shape or dtype; a host array that is not finite.
        """
        if self.kind == "torch" and type(actions).__module__.split(".")[0] == "torch":
            self._set_tensor(actions)
        else:
            self._engine.set_actions(host_actions(actions, self._shape))

    def _set_tensor(self, actions: Any) -> None:
        import torch

        if tuple(actions.shape) not in ((self._rows, self._shape[-1]), self._shape):
            raise ActionError(f"actions have shape {tuple(actions.shape)}, expected ({self._rows}, {self._shape[-1]})")
        if not torch.is_floating_point(actions) or actions.device.type == "meta":
            raise ActionError(f"actions have dtype {actions.dtype} on {actions.device}, expected a float with data")
        if actions.device.type == "cpu" and not torch.isfinite(actions).all():
            host_actions(actions.detach().numpy(), self._shape)  # says which row
        target = wp.to_torch(self._engine.array("actions"))
        target.copy_(actions.detach().reshape(self._shape))


def host_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return host actions as an array (W, N, A).

    Args:
        actions: (W N, A) or (W, N, A).
        shape: (W, N, A).

    Raises:
        ActionError: wrong shape or dtype, or not finite.
    """
    rows, size = shape[0] * shape[1], shape[2]
    try:
        values = np.asarray(actions)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ActionError(f"actions cannot be read as an array of shape ({rows}, {size}): {error}") from None
    if values.shape not in ((rows, size), shape):
        raise ActionError(f"actions have shape {values.shape}, expected ({rows}, {size})")
    if values.dtype.kind not in "fiu":
        raise ActionError(f"actions have dtype {values.dtype}, expected a float")
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values.reshape(rows, size)).all(axis=1))[0])
        raise ActionError(f"action of row {row} is not finite: {values.reshape(rows, size)[row].tolist()}")
    return values.reshape(shape)
