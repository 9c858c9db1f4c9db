"""Results as JSON, which knows neither NumPy nor NaN."""

from typing import Any

import numpy as np
from pydantic_core import to_json, to_jsonable_python


def json_text(value: Any) -> str:
    """Return a result as JSON text; null for NaN and infinity."""
    return to_json(value, indent=2, inf_nan_mode="null", fallback=_plain).decode() + "\n"


def jsonable(value: Any) -> Any:
    """Return a result as plain Python, as `json.dumps` takes it; None for NaN and infinity."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
