"""MR.CLAM: five recorded robots with odometry, a camera each, and motion capture that judges."""

from coopenv.backends.mrclam.dataset import Dataset, load_dataset
from coopenv.backends.mrclam.files import Recording, find_folder, read_recording
from coopenv.backends.mrclam.variants import VARIANTS, Variant

__all__ = ["VARIANTS", "Dataset", "Recording", "Variant", "find_folder", "load_dataset", "read_recording"]
