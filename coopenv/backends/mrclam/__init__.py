"""MR.CLAM: five recorded robots with odometry, a camera each, and motion capture that judges."""

from coopenv.backends.mrclam.dataset import Dataset, load_dataset
from coopenv.backends.mrclam.events import CameraFrame, OdometrySample, Variant, events
from coopenv.backends.mrclam.files import Recording, find_folder, read_recording

__all__ = [
    "CameraFrame",
    "Dataset",
    "OdometrySample",
    "Recording",
    "Variant",
    "events",
    "find_folder",
    "load_dataset",
    "read_recording",
]
