"""Commands in an installation without any extra: one line that says which one to install."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.commands import ROOT, Commands, commands

WITHOUT = """
import sys

LIBRARIES = {
    "cryptography", "foxglove", "gtsam", "h5py", "highway_env", "imageio_ffmpeg", "lz4", "mcap", "minari", "moviepy",
    "nats", "onnx", "ray", "rosbags", "stable_baselines3", "tensorboard", "tomlkit", "torch", "torchrl", "viser",
    "zenoh", "zstandard",
}

class Filtered:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in LIBRARIES else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Filtered(finder) if hasattr(finder, "find_spec") else finder for finder in sys.meta_path]
import coopenv.api.engine
import coopenv.policies
import coopenv.runs.demo
import coopenv.runs.dataset
import coopenv.runs.live
from coopenv.cli import main
"""
FLEET = ROOT / "examples" / "fleet" / "overtaking.toml"


@pytest.fixture(scope="module")
def without_extras(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    with commands(WITHOUT, tmp_path_factory.mktemp("printed")) as started:
        yield started


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "drive.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(64))
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "topics.toml").write_text('environment = "crossing_path"\ncars = [{ name = "svea7" }]\n')
    (tmp_path / "recorded.mcap").write_bytes(b"\x89MCAP0\r\n" + metadata("coopenv-drive"))
    return tmp_path


def metadata(name: str) -> bytes:
    """Return a record of metadata without entries."""
    content = len(name).to_bytes(4, "little") + name.encode() + bytes(4)
    return b"\x0c" + len(content).to_bytes(8, "little") + content


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("view crossing_path", "view"),
        ("film crossing_path --out film.mp4", "video"),
        ("run recorded.mcap", "log"),
        ("describe recorded.mcap", "log"),
        ("film recorded.mcap --out film.gif", "log"),
        ("run drive.bag --map topics.toml", "log"),
        ("import drive.bag", "log"),
        ("record crossing_path --out new.mcap", "log"),
        ("bench observers recorded.mcap", "log"),
        ("train facade --out agent", "train"),
        ("dataset facade", "minari"),
        ("describe highway_intersection", "highway"),
        ("bench observers overtaking --observers factor_graph", "bench"),
        ("bench observers overtaking --engine ray", "ray"),
        ("svea demo", "svea"),
        ("svea router", "svea"),
        (f"svea fake {FLEET} --car svea7", "svea"),
        (f"svea run {FLEET}", "svea"),
        (f"svea keys {FLEET} --out keys", "svea"),
        (f"svea health {FLEET} --car svea7", "svea"),
    ],
)
def test_one_line_names_the_extra(command: str, extra: str, folder: Path, without_extras: Commands) -> None:
    result = without_extras.run(command.split(), folder)
    assert result.returncode == 2, result.stderr
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert f"pip install '.[{extra}]'" in result.stderr
    names = {"drive.mcap", "drive.bag", "topics.toml", "recorded.mcap"}
    assert {path.name for path in folder.iterdir()} == names
