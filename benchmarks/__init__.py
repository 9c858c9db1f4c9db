"""Measurements of speed, run from a checkout; not a part of the package."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "examples" / "trainers"))  # adapters of trainers are examples
