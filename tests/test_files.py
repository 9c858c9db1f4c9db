"""Results that are replaced as a whole, by processes that are killed and on disks that are full."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from coopenv.base import files
from coopenv.base.errors import OutputError
from coopenv.base.files import check_file, new_folder, replacing_file, replacing_folder, writing
from tests.helpers.processes import small_disk, start

NAMES = ("a.txt", "b.txt", "c.txt", "sometimes.txt")

WRITER = """
import sys
from coopenv.base.files import replacing_file, replacing_folder
from tests.test_files import write
for generation in range(int(sys.argv[1]), 10**9):
    write("result", generation)
    with replacing_file("single.txt") as new:
        new.write_text(str(generation) * 200_000)
    print(generation, flush=True)
"""


def write(folder: str | Path, generation: int) -> None:
    """Write a result whose files all name their generation; every other one has a further file."""
    with replacing_folder(folder, NAMES) as new:
        for name in NAMES[: 3 + generation % 2]:
            with writing(new / name):
                (new / name).write_text(str(generation) * 20_000)


def generation_of(folder: Path) -> int:
    """Return the one generation that all files of a whole result name."""
    found = {path.name: path.read_text() for path in folder.iterdir() if path.name in NAMES}
    generations = {text[: len(text) // 20_000] for text in found.values()}
    assert len(generations) == 1, {name: text[:20] for name, text in found.items()}
    generation = generations.pop()
    assert sorted(found) == sorted(NAMES[: 3 + int(generation) % 2])
    assert all(text == generation * 20_000 for text in found.values())
    return int(generation)


def hidden(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with a result, beside which a user keeps a file and a folder."""
    monkeypatch.chdir(tmp_path)
    write("result", 0)
    (tmp_path / "result" / "notes.txt").write_text("mine")
    (tmp_path / "result" / "mine").mkdir()
    (tmp_path / "result" / "mine" / "deep.txt").write_text("mine too")
    return tmp_path


@pytest.mark.parametrize("kills", [5, pytest.param(50, marks=pytest.mark.slow)])
def test_writers_killed_at_random_instants_leave_a_whole_result(kills: int, place: Path) -> None:
    (place / "single.txt").write_text("0" * 200_000)
    draw, least = random.Random(3), 0
    for _ in range(kills):
        writer = start([sys.executable, "-c", WRITER, str(least + 1)], place)
        assert writer.stdout is not None
        least = int(writer.stdout.readline())
        time.sleep(draw.uniform(0.0, 0.1))
        writer.kill()
        output, errors = writer.communicate()
        assert errors == ""
        finished = [least, *(int(line) for line in output.split())]
        least = generation_of(place / "result")
        assert least in (finished[-1], finished[-1] + 1)
        single = (place / "single.txt").read_text()
        assert single in (str(finished[-1]) * 200_000, str(finished[-1] + 1) * 200_000)
        assert (place / "result" / "notes.txt").read_text() == "mine"
    write("result", 10**6)
    with replacing_file("single.txt") as new:
        new.write_text("end")
    assert generation_of(place / "result") == 10**6
    assert (place / "result" / "mine" / "deep.txt").read_text() == "mine too"
    assert hidden(place) == []


def test_a_new_folder_goes_again_with_what_failed_in_it(tmp_path: Path) -> None:
    with new_folder(tmp_path / "kept") as made:
        assert made.is_dir()
    for left in ([], ["file"]):
        with pytest.raises(OutputError), new_folder(tmp_path / "kept" / "a" / "b"):
            for name in left:
                (tmp_path / "kept" / "a" / name).write_text("")
            raise OutputError("full")
        assert [path.name for path in (tmp_path / "kept").rglob("*")] == (["a", "file"] if left else [])
    with pytest.raises(OutputError, match="cannot write to "), new_folder(tmp_path / "kept" / "a" / "file" / "c"):
        pass


def test_readers_find_a_whole_result_at_every_instant(place: Path) -> None:
    writer = start([sys.executable, "-c", WRITER, "1"], place, stdout=subprocess.DEVNULL)
    seen = set()
    try:
        while len(seen) < 20:
            text = (place / "result" / "a.txt").read_text()
            assert text == text[: len(text) // 20_000] * 20_000
            seen.add(text)
            assert (place / "result" / "notes.txt").read_text() == "mine"
    finally:
        writer.kill()
        writer.wait()


@pytest.mark.parametrize("step", ["link", "exchange", "clear", "rmdir"])
def test_a_run_killed_at_any_step_is_put_right_by_the_next(
    step: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def killed(*_: object, **__: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr({"link": os, "rmdir": Path}.get(step, files), step, killed)
        patched.setattr(shutil, "rmtree", lambda *_, **__: None)  # a dead process does not clean up
        with pytest.raises(Killed):
            write("result", 7)
    assert generation_of(place / "result") == (7 if step in ("clear", "rmdir") else 0)
    assert hidden(place) != []
    write("result", 8)
    assert generation_of(place / "result") == 8
    assert (place / "result" / "notes.txt").read_text() == "mine"
    assert (place / "result" / "mine" / "deep.txt").read_text() == "mine too"
    assert hidden(place) == []


@pytest.fixture
def without_exchange(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "RENAME_EXCHANGE", 1 << 20)  # a flag that no system knows


@pytest.mark.usefixtures("without_exchange")
def test_without_an_exchange_two_renames_do(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write("result", 1)
    assert generation_of(place / "result") == 1
    assert (place / "result" / "mine" / "deep.txt").read_text() == "mine too"
    assert hidden(place) == []
    Path("result").rename(".result.0123abcd.old")  # killed between the two
    write("result", 2)
    assert generation_of(place / "result") == 2
    assert (place / "result" / "notes.txt").read_text() == "mine"
    assert hidden(place) == []
    Path("result").rename(".result.0123abcd.old")
    Path("result").mkdir()  # by somebody who misses it
    with pytest.raises(ZeroDivisionError), replacing_folder("result", NAMES):
        raise ZeroDivisionError
    assert generation_of(place / "result") == 2


@pytest.mark.usefixtures("without_exchange")
def test_a_result_that_cannot_be_put_in_place_is_not_lost(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.rename

    def guarded(self: Path, target: Path) -> Path:
        if self.name == "result":
            raise OSError(16, "Device or resource busy")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", guarded)
    with pytest.raises(OutputError, match=r"cannot replace result: Device or resource busy; the new result is in") as e:
        write("result", 3)
    assert generation_of(Path(str(e.value).rpartition(" ")[2])) == 3
    assert generation_of(place / "result") == 0


def test_files_of_the_user_stay_and_stale_results_go(place: Path) -> None:
    (place / "result").chmod(0o750)
    (place / "result" / "link").symlink_to("nowhere")
    write("result", 1)
    os.link(place / "result" / "notes.txt", place / "other.txt")
    write("result", 2)
    names = {path.name for path in (place / "result").iterdir()}
    assert names == {"a.txt", "b.txt", "c.txt", "notes.txt", "mine", "link"}
    assert (place / "result").stat().st_mode & 0o777 == 0o750
    assert (place / "other.txt").samefile(place / "result" / "notes.txt")


def test_a_result_that_fails_leaves_the_old_one(place: Path) -> None:
    with pytest.raises(ZeroDivisionError), replacing_folder("result", NAMES) as new:
        (new / "a.txt").write_text("new")
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), replacing_file("result/a.txt") as new:
        new.write_text("new")
        raise ZeroDivisionError
    assert generation_of(place / "result") == 0
    assert hidden(place) == hidden(place / "result") == []


def test_links_stay_links_and_modes_stay_modes(place: Path) -> None:
    (place / "to_folder").symlink_to("result")
    (place / "to_file").symlink_to("result/a.txt")
    write("to_folder", 1)
    assert generation_of(place / "result") == 1
    (place / "result" / "a.txt").chmod(0o604)
    with replacing_file("to_file") as new:
        new.write_text("through")
    assert (place / "result" / "a.txt").read_text() == "through"
    assert (place / "result" / "a.txt").stat().st_mode & 0o777 == 0o604
    assert (place / "to_folder").is_symlink() and (place / "to_file").is_symlink()


def test_a_second_run_into_a_folder_is_refused_and_the_first_one_is_whole(place: Path) -> None:
    with replacing_folder("result", NAMES) as first:
        (first / "a.txt").write_text("1" * 20_000)
        with pytest.raises(OutputError, match=r"^cannot write to result: another run is writing its results there$"):
            write("result", 4)
        write("beside", 5)
        assert first.is_dir() and generation_of(place / "result") == 0
        for name in NAMES[1:]:
            (first / name).write_text("1" * 20_000)
    assert generation_of(place / "result") == 1
    write("result", 4)
    assert (generation_of(place / "result"), generation_of(place / "beside")) == (4, 5)
    assert hidden(place) == []


def test_a_run_beside_what_a_killed_run_has_left_is_not_refused(place: Path) -> None:
    (place / ".result.0123abcd.part").mkdir()
    with replacing_folder("beside", NAMES) as other:  # while another run goes on, nothing is removed
        (other / "a.txt").write_text("")
        write("result", 2)
    assert generation_of(place / "result") == 2


@pytest.mark.parametrize(
    ("folder", "reason"),
    [
        ("", "current folder"),
        (".", "current folder"),
        ("result/notes.txt", "it is not a folder"),
        ("result/notes.txt/below", "it is not a folder"),
        ("/proc", "/proc"),
        ("home", r"other folders \(such as x\)"),
        ("x" * 300, "File name too long"),
        ("x" * 250, "File name too long"),
        ("loop", "not a folder"),
        ("/dev/null", "it is not a folder"),
        ("taken", "taken/a.txt: it is a folder"),
    ],
)
def test_impossible_folders_are_refused_before_the_work(folder: str, reason: str, place: Path) -> None:
    (place / "home" / "x").mkdir(parents=True)
    (place / "taken" / "a.txt").mkdir(parents=True)
    (place / "loop").symlink_to("loop")
    with pytest.raises(OutputError, match=reason) as error, replacing_folder(folder, NAMES):
        pytest.fail("began")
    assert "\n" not in str(error.value)
    assert hidden(place) == []


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("", "it is a folder"),
        ("result", "it is a folder"),
        ("none/file", "folder none does not exist"),
        ("/dev/null", "no plain file"),
        ("result/notes.txt/below", "result/notes.txt is not a folder"),
        ("x" * 300, "File name too long"),
        ("loop", "no plain file"),
        ("/proc/file", "cannot write to /proc/file"),
    ],
)
def test_impossible_files_are_refused_before_the_work(path: str, reason: str, place: Path) -> None:
    (place / "loop").symlink_to("loop")
    with pytest.raises(OutputError, match=reason):
        check_file(path)
    with pytest.raises(OutputError, match=reason), replacing_file(path):
        pytest.fail("began")
    assert hidden(place) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_targets_are_refused_before_the_work(place: Path) -> None:
    (place / "result" / "a.txt").chmod(0o444)
    with pytest.raises(OutputError, match="read-only"):
        check_file("result/a.txt")
    (place / "result").chmod(0o555)
    with pytest.raises(OutputError, match="read-only"):
        write("result", 1)
    place.chmod(0o555)
    with pytest.raises(OutputError, match=r"cannot write to new: folder \. is read-only"):
        write("new", 1)
    place.chmod(0o755)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", "400k") as place:
        yield place


def test_a_full_disk_keeps_the_old_result(disk: Path) -> None:
    write(disk / "result", 0)
    with replacing_file(disk / "single.txt") as new:
        new.write_text("old")
    with (
        pytest.raises(OutputError, match=r"result/.*: No space left"),
        replacing_folder(disk / "result", NAMES) as folder,
        replacing_file(folder / "a.txt") as new,
    ):
        new.write_bytes(bytes(1_000_000))
    with pytest.raises(OutputError, match="No space left"), replacing_file(disk / "single.txt") as new:
        new.write_bytes(bytes(1_000_000))
    assert generation_of(disk / "result") == 0
    assert (disk / "single.txt").read_text() == "old"
    assert hidden(disk) == hidden(disk / "result") == []
    with (disk / "filler").open("wb", buffering=0) as stream, pytest.raises(OSError, match="No space"):
        while True:
            stream.write(bytes(4096))
    for write_one in (lambda: write(disk / "result", 1), lambda: check_file(disk / "single.txt")):
        with pytest.raises(OutputError, match="No space left"):
            write_one()
    assert generation_of(disk / "result") == 0
    with pytest.raises(OutputError, match="mount point"):
        write(disk, 1)


def test_a_read_only_disk_is_found_before_the_work(disk: Path) -> None:
    write(disk / "result", 0)
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    for place in ("result", "new", "new/below"):
        with pytest.raises(OutputError, match=f"cannot write to .*{place}: .*[rR]ead-only"):
            write(disk / place, 1)
    with pytest.raises(OutputError, match="ead-only"):
        check_file(disk / "single.txt")
    assert generation_of(disk / "result") == 0


def test_a_folder_that_is_held_is_waited_for_so_long(tmp_path: Path) -> None:
    first = files.lock(tmp_path)
    assert first is not None
    assert files.lock(tmp_path) is None and files.lock(tmp_path, wait=0.1) is None
    with ThreadPoolExecutor(1) as pool:
        second = pool.submit(files.lock, tmp_path, 60.0)
        os.close(first)
        descriptor = second.result(timeout=60)
    assert descriptor is not None
    os.close(descriptor)
