"""MR.CLAM: five recorded robots with odometry, a camera each, and motion capture that judges."""

from coopenv.backends.mrclam.dataset import Dataset, load_dataset
from coopenv.backends.mrclam.recording import VARIANTS, Variant, recording_of

__all__ = ["VARIANTS", "Dataset", "Variant", "load_dataset", "recording_of"]
