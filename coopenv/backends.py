"""Former name of `coopenv.sources`, to be removed in 0.10."""

import sys
import warnings
from importlib import import_module

warnings.warn("coopenv.backends is now coopenv.sources", DeprecationWarning, stacklevel=2)
for _name in ("", ".base", ".cosimulation", ".mcap"):
    sys.modules[f"coopenv.backends{_name}"] = import_module(f"coopenv.sources{_name}")
