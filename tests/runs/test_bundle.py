"""A run as one file: it is replayed, what comes out otherwise is named, and what is not such a file is refused."""

from __future__ import annotations

import io
import json
import shutil
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from hashlib import sha256
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from coopenv.base import installation
from coopenv.base.errors import DataError
from coopenv.cli.app import main
from coopenv.runs.bundle import Bundle
from tests.helpers.commands import refused

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

OBSERVER = """
from coopenv.observers import Estimate, Message

class Late:
    def __init__(self, setup):
        pass
    def reset(self, pose, covariance):
        self.pose, self.covariance = pose, covariance
    def update(self, tick):
        if tick.time > 2.5:
            VERDICT
        return Estimate(*self.pose, self.covariance)
    def message(self):
        return Message()
"""

DRIVER = """
import numpy as np

calls = []

def drive(observations):
    calls.append(0)
    if len(calls) > 25:
        VERDICT
    return np.full((len(observations), 2), 0.1)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*more: str) -> list[str]:
    return ["run", "facade", "--no-figures", "--policy", "peek", "--out", "run", *more]


def edited(file: Path, change: Callable[[dict[str, bytes]], None], sealed: bool = True) -> str:
    """Write a file with changed parts, and with all digests if `sealed`; return its name."""
    with zipfile.ZipFile(file) as archive:
        parts, comment = {name: archive.read(name) for name in archive.namelist()}, archive.comment
    change(parts)
    if sealed:
        manifest = json.loads(parts["manifest.json"])
        manifest["parts"] = {n: sha256(c).hexdigest() for n, c in parts.items() if n != "manifest.json"}
        parts["manifest.json"] = json.dumps(manifest).encode()
        comment = sha256(parts["manifest.json"]).hexdigest().encode()
    with zipfile.ZipFile("edited.zip", "w") as archive:
        archive.comment = comment
        for name, content in parts.items():
            archive.writestr(name, content)
    return "edited.zip"


def lacking(parts: dict[str, bytes], key: str) -> None:
    manifest = json.loads(parts["manifest.json"])
    del manifest[key]
    parts["manifest.json"] = json.dumps(manifest).encode()


def arrays(parts: dict[str, bytes], pack: Callable[..., None] = np.savez, **changed: np.ndarray) -> None:
    buffer = io.BytesIO()
    pack(buffer, **{**np.load(io.BytesIO(parts["arrays.npz"])), **changed})
    parts["arrays.npz"] = buffer.getvalue()


@pytest.mark.parametrize(
    ("verdict", "reason"),
    [("raise ValueError('late')", "ValueError: late"), ("self.pose[1][0] = float('nan')", "not a finite array")],
)
def test_a_failed_run_is_kept_and_fails_again(
    folder: Path, capsys: pytest.CaptureFixture[str], verdict: str, reason: str
) -> None:
    (folder / "mine.py").write_text(OBSERVER.replace("VERDICT", verdict))
    assert main(run("--observer", "mine.py:Late")) == 2
    assert "coopenv bundle run_failed" in capsys.readouterr().err and not (folder / "run").exists()
    assert main(["bundle", "run_failed", "--out", "report.zip"]) == 0
    with zipfile.ZipFile("report.zip") as archive:
        manifest = json.loads(archive.read("manifest.json"))
        assert archive.read("code/mine.py") == (folder / "mine.py").read_bytes()
    assert manifest["state_tick"] == 30 and manifest["end"]["tick"] == 75 and str(folder) not in str(manifest)
    capsys.readouterr()
    assert main(["run", "report.zip"]) == 0
    assert "Late' at vehicle_1" in (printed := capsys.readouterr().out) and reason in printed
    (folder / "mine.py").write_text(OBSERVER.replace("VERDICT", "pass"))
    assert "report.zip: needs its code/mine.py here as mine.py" in refused("run", "report.zip")


@pytest.mark.parametrize("verdict", ["raise ValueError('late')", "return observations[:, :2] + np.nan"])
def test_a_run_whose_driver_fails_is_replayed_up_to_there(
    folder: Path, capsys: pytest.CaptureFixture[str], verdict: str
) -> None:
    """The driver is not in the file, and need not be there."""
    (folder / "mine.py").write_text(DRIVER.replace("VERDICT", verdict))
    assert main(["run", "facade", "--no-figures", "--policy", "mine.py:drive", "--out", "run"]) == 2
    error = capsys.readouterr().err.rpartition("error: ")[2]
    (folder / "mine.py").unlink()
    assert main(["bundle", "run_failed"]) == 0 and main(["run", "run_failed.zip"]) == 0
    assert capsys.readouterr().out.endswith(f"seed 0, 75 ticks\nThe same figures up to the driver's error: {error}")
    few = edited(folder / "run_failed.zip", lambda parts: arrays(parts, actions=np.zeros((24, 1, 2))))
    assert "actions: expected (1, 2) per decision" in refused("run", few)


def test_code_that_a_scenario_names_runs_from_the_current_folder_only(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = folder / "own"
    shutil.copytree(EXAMPLES / "lane_keeping", own)
    assert main(["run", str(own / "lane_keeping.toml"), "--no-figures", "--steps", "4", "--out", "run"]) == 0
    assert main(["bundle", "run", "--out", "own.zip"]) == 0
    with zipfile.ZipFile("own.zip") as archive:
        assert archive.read("code/lane_terms.py") == (own / "lane_terms.py").read_bytes()
        assert str(folder).encode() not in archive.read("scenario.json")
    needed = "own.zip: needs its code/lane_terms.py here as lane_terms.py: unzip and read it"
    assert needed in refused("run", "own.zip")
    monkeypatch.chdir(own)
    capsys.readouterr()
    assert main(["run", "../own.zip"]) == 0 and capsys.readouterr().out.endswith("The same figures.\n")
    with (own / "lane_terms.py").open("a") as file:
        file.write("# changed\n")
    assert needed in refused("run", "../own.zip")


EVIL = "open('ran', 'w').close()\n\nclass X:\n    pass\n\ndef x(ego):\n    return 0.0\n"


def changed(name: str, *keys: str, value: object) -> Callable[[dict[str, bytes]], None]:
    """Return a change of an entry of a part in JSON."""

    def change(parts: dict[str, bytes]) -> None:
        node = whole = json.loads(parts[name])
        for key in keys[:-1]:
            node = node.setdefault(key, {})
        node[keys[-1]] = value
        parts[name] = json.dumps(whole).encode()

    return change


SCENARIO, MANIFEST = "scenario.json", "manifest.json"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(MANIFEST, "observer", value="evil.py:X"), "names 'evil.py:X' without the digest of a file"),
        (changed(MANIFEST, "observer", value="../evil.py:X"), "names '../evil.py:X' without the digest of a file"),
        (changed(MANIFEST, "observer", value="evil:X"), "names 'evil:X' without the digest of a file"),
        (changed(SCENARIO, "observer", "name", value="evil.py:X"), "observer.name: String should match pattern"),
        *(
            (changed(SCENARIO, part, "custom", value={"e": row}), "names 'evil.py:x' without the digest of a file")
            for part in ("reward", "termination", "observation")
            for row in ("evil.py:x", {"function": "evil.py:x"})
        ),
        (changed(SCENARIO, "program", value={"code": "evil.py:X"}), "names 'evil.py:X' without the digest of a file"),
        (changed(SCENARIO, "program", value={"code": "os:system"}), "names 'os:system' without the digest of a file"),
        (changed(SCENARIO, "sumo", value={"net": "evil.py"}), "names 'evil.py' without the digest of a file"),
        (changed(SCENARIO, "sumo", value={"net": "a.xml", "routes": ["evil.py"]}), "'a.xml' without the digest"),
        (changed(SCENARIO, "sumo", value={"net": "sumo_crossing.net.xml", "options": {"log": "a"}}), "can write files"),
        (
            changed(SCENARIO, "highway", value={"id": "a-v0", "config": {"other_vehicles_type": "evil.X"}}),
            "highway.config.other_vehicles_type: names code: 'evil.X'",
        ),
    ],
)
def test_code_and_files_without_a_digest_are_neither_run_nor_read(
    folder: Path, bundled: Path, change: Callable[[dict[str, bytes]], None], words: str
) -> None:
    (folder / "evil.py").write_text(EVIL)
    assert words in refused("run", edited(bundled, change))
    assert not (folder / "ran").exists()


@pytest.fixture(scope="module")
def bundled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bundle of a short run."""
    folder = tmp_path_factory.mktemp("bundled")
    assert (
        main(["run", "facade", "--no-figures", "--policy", "peek", "--steps", "2", "--out", str(folder / "run")]) == 0
    )
    assert main(["bundle", str(folder / "run"), "--out", str(folder / "run.zip")]) == 0
    return folder / "run.zip"


def test_modules_that_code_imports_from_the_folder_need_digests_of_the_archive(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "mine.py").write_text(
        "import beside_mine\n" + OBSERVER.replace("VERDICT", "pass").replace("Late", "Beside")
    )
    (folder / "beside_mine.py").write_text("")
    assert main(run("--steps", "2", "--observer", "mine.py:Beside")) == 0 and main(["bundle", "run"]) == 0
    with zipfile.ZipFile("run.zip") as archive:
        assert {"code/mine.py", "code/beside_mine.py"} <= {*archive.namelist()}
    capsys.readouterr()
    for content, same in (("", True), (EVIL, False)):
        (folder / "beside_mine.py").write_text(content)
        sys.modules.pop("beside_mine")
        for name in [name for name in sys.modules if name.endswith("_mine")]:
            del sys.modules[name]
        installation._module_of.cache_clear()
        if same:
            assert main(["run", "run.zip"]) == 0 and capsys.readouterr().out.endswith("The same figures.\n")
        else:
            line = refused("run", "run.zip")
            assert "cannot be loaded: ImportError: beside_mine of the current folder: no digest of it is stated" in line
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("place", ["evil.py", "evil/__init__.py", "evil/inner.py"])
def test_only_vouched_modules_of_a_folder_are_imported(
    folder: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.syspath_prepend(str(folder))
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_text(EVIL)
    (folder / "sound.py").write_text("value = 3\n")
    (folder / "xml").mkdir()  # a folder without code hides no module
    digests = {"code/sound.py": sha256((folder / "sound.py").read_bytes()).hexdigest()}
    with installation.importing_vouched(folder, digests):
        assert import_module("sound").value == 3 and import_module("xml.dom").__name__ == "xml.dom"
        with pytest.raises(ImportError, match="evil of the current folder: no digest of it is stated"):
            import_module("evil.inner" if "inner" in place else "evil")
    del sys.modules["sound"]
    assert not (folder / "ran").exists()


def test_files_of_simulators_are_read_with_their_digests_only(folder: Path, bundled: Path) -> None:
    (folder / "own.net.xml").write_text("<net/>")
    code: dict[str, Path] = {}
    assert installation.beside("own.net.xml", folder, code) == "own.net.xml"
    assert code == {"own.net.xml": folder / "own.net.xml"}
    found = Bundle.read(bundled)
    for digest, words in ((installation.file_digest(code["own.net.xml"]), ""), ("0" * 64, "needs own.net.xml here")):
        parts = found.manifest.parts | {"code/own.net.xml": digest}
        stating = replace(found, manifest=found.manifest.model_copy(update={"parts": parts}))
        with nullcontext() if not words else pytest.raises(DataError, match=words):
            assert stating._here("elsewhere/own.net.xml", Path()) == str(folder / "own.net.xml")
    shipped = installation.data_directory("envs") / "sumo_crossing.net.xml"
    assert found._here("sumo_crossing.net.xml", Path()) == str(shipped)


def test_long_names_of_a_bundle_are_shortened(folder: Path, bundled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    many = changed(MANIFEST, "environment", value="A" * 5000)
    versions = changed(MANIFEST, "versions", value={"coopenv": "B" * 5000})

    def both(parts: dict[str, bytes]) -> None:
        many(parts)
        versions(parts)

    file = edited(bundled, both)
    capsys.readouterr()
    assert main(["run", file]) == 0
    printed = capsys.readouterr()
    assert "AAA...AAA" in printed.out and "BBB...BBB" in printed.err and len(printed.out + printed.err) < 800


def test_a_driver_that_a_scenario_names_is_replayed_without_its_code(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "mine.py").write_text(DRIVER.replace("VERDICT", "return observations[:, :2] * 0 + 0.3"))
    assert main(run("--steps", "4", "--override", 'vehicles.0.motion.driver="mine.py:drive"')) == 0
    (folder / "mine.py").unlink()
    assert main(["bundle", "run"]) == 0
    capsys.readouterr()
    assert main(["run", "run.zip"]) == 0 and capsys.readouterr().out.endswith("The same figures.\n")


def test_large_seeds_are_replayed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run("--steps", "4", "--seed", str(2**80))) == 0 and main(["bundle", "run"]) == 0
    capsys.readouterr()
    assert main(["run", "run.zip"]) == 0 and capsys.readouterr().out.endswith("The same figures.\n")


def test_a_run_is_replayed_and_differences_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(run("--steps", "30")) == 0 and main(["bundle", "run"]) == 0
    assert main(["run", "run.zip"]) == 0 and capsys.readouterr().out.endswith("The same figures.\n")
    assert main(["run", "run.zip", "--json"]) == 0 and json.loads(capsys.readouterr().out)["end"]["tick"] == 90
    for option, *value in (["--seed", "3"], ["--override", "horizon=3"], ["--open"]):
        assert refused("run", "run.zip", option, *value).startswith(f"error: {option}: is for a new run, run.zip is")
    with zipfile.ZipFile("run.zip") as archive, np.load(io.BytesIO(archive.read("arrays.npz"))) as kept:
        actions, position = kept["actions"], kept["state.position"]
    assert len(actions) == 30 and np.abs(actions).max() > 0.1
    other = edited(folder / "run.zip", lambda parts: arrays(parts, actions=-actions))
    assert "the result differs from the file's: state at 2 s:" in (line := refused("run", other))
    assert "last position error" in line
    other = edited(folder / "run.zip", lambda parts: arrays(parts, **{"state.position": position + 1e-3}))
    assert refused("run", other).endswith("state at 2 s: position\n")


def test_what_is_no_such_file_is_refused_in_one_line(folder: Path) -> None:
    assert main(run("--steps", "4")) == 0 and main(["bundle", "run"]) == 0
    whole = folder / "run.zip"

    def manifest(key: str, value: object) -> Callable[[dict[str, bytes]], None]:
        def change(parts: dict[str, bytes]) -> None:
            parts["manifest.json"] = json.dumps({**json.loads(parts["manifest.json"]), key: value}).encode()

        return change

    (folder / "cut.zip").write_bytes(whole.read_bytes()[:2000])
    assert "cut.zip: not a readable run" in refused("run", "cut.zip")
    assert "no such scenario file: none.zip; expected a scenario" in refused("run", "none.zip")
    assert "holds no record.zip, as only simulated runs do" in refused("bundle", ".")
    cases: list[tuple[Callable[[dict[str, bytes]], None], bool, str]] = [
        (lambda parts: arrays(parts, actions=np.zeros((4, 1, 2))), False, "arrays.npz: not the part that was written"),
        (manifest("observer", "riccati"), False, "manifest.json: not the part that was written, its digest differs"),
        (manifest("kernels", {"a": "b"}), True, "the result differs from the file's: kernels coopenv."),
        (lambda parts: arrays(parts, pack=np.savez_compressed), True, "arrays.npz: is packed twice"),
        (lambda parts: arrays(parts, actions=np.full((4, 1, 2), 7.0)), True, "actions: expected numbers from -1 to 1"),
        (lambda parts: arrays(parts, actions=np.zeros((4, 9, 2))), True, "actions: expected (1, 2) per decision"),
        (lambda parts: parts.update(more=b"x"), True, "not a run: parts more unknown or too large"),
        (lambda parts: parts.pop("arrays.npz") and None, True, "not a run: parts arrays.npz missing"),
        (manifest("format", "coopenv-run 1"), True, "format: Input should be 'coopenv-run 2', got 'coopenv-run 1'"),
        (manifest("seed", -1), True, "manifest.json: seed: Input should be greater than or equal to 0"),
        (manifest("end", 3), True, "manifest.json: end: "),
        (manifest("kernels", 5), True, "manifest.json: kernels: "),
        (lambda parts: lacking(parts, "versions"), True, "manifest.json: versions: Field required"),
        (manifest("ticks_planned", 10**12), True, "the result differs from the file's: after tick 13: no error"),
        (manifest("state_tick", 10**6), True, "manifest.json: state_tick: later than the end"),
        (lambda parts: parts.update({"scenario.json": b'{"horizon": -1}'}), True, "scenario.json: "),
        (lambda parts: parts.update({"scenario.json": b"[1]"}), True, "scenario.json: not a scenario"),
        (lambda parts: parts.update({"scenario.json": b'{"observer": 1}'}), True, "its observer no table"),
        (lambda parts: parts.update({"manifest.json": bytes(2**20 + 1)}), False, "not a run: parts manifest.json"),
    ]
    for change, sealed, reason in cases:
        assert reason in refused("run", edited(whole, change, sealed)), reason


def test_archives_that_unpack_to_more_than_they_state_are_refused(folder: Path) -> None:
    assert main(run("--steps", "4")) == 0 and main(["bundle", "run"]) == 0
    with zipfile.ZipFile("run.zip") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile("large.zip", "w") as archive:
            for name, content in parts.items():
                large = bytes(2**26 if name == "scenario.json" else 0)
                archive.writestr(name, content + large, kind)
                archive.getinfo(name).file_size = len(content)  # as the central directory then states
        tracemalloc.start()
        try:
            assert "large.zip: " in refused("run", "large.zip")
            assert tracemalloc.get_traced_memory()[1] < 2**25
        finally:
            tracemalloc.stop()
