"""Results that are replaced as a whole: a file, or a folder of files.

What is new is written into a hidden folder beside its place, synced to the disk, and then put in place by one operation
of the file system. Whoever reads, at whatever instant, after `kill -9` and on a full disk, finds the whole old result
or the whole new one. Two folders change places by Linux's renameat2(RENAME_EXCHANGE); where a system or a file system
lacks it, by two renames, between which the place is empty: a run that is killed there is put right by the next one.
"""

import os
import shutil
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from coopenv.errors import OutputError
from coopenv.interrupts import NOTHING, before_a_hard_end, held, note
from coopenv.staging import PART, abandoned, copy_owner, heal, new_part, put_in_place, sync

PROBE_BYTES = 1 << 16  # written before the work begins, to find a disk that is full already
LAST_WAIT = 0.5  # s to wait for a result that is being put in place, before the process is ended

_replacing = threading.Lock()
_under_way: list[Path] = []


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turn the system's refusal to write `path` into an `OutputError`."""
    try:
        yield
    except FileExistsError:  # where a folder is to be made
        raise OutputError(f"cannot write to {path}: it is not a folder") from None
    except NotADirectoryError:
        raise OutputError(f"cannot write to {path}: what stands above it is not a folder") from None
    except OSError as error:
        raise OutputError(f"cannot write to {path}: {error.strerror or error}") from None


@contextmanager
def replacing_file(path: str | Path) -> Iterator[Path]:
    """Yield a path to write to; what stands there at the end takes the place of the file `path`.

    Raises:
        OutputError: it cannot be written; the old file is untouched.
    """
    with _staging(path, _check_file) as (place, part):
        new = part / place.name
        with writing(path):
            yield new
            sync(new)
            copy_owner(place, new)
            with held(), _replacing:
                new.replace(place)
                _written(path, place)
            sync(place.parent)


def replace_text(path: str | Path, text: str) -> None:
    """Write a text that takes the place of the file `path`; an OutputError says why not, and the old one stays."""
    with replacing_file(path) as new:
        new.write_text(text, encoding="utf-8")


@contextmanager
def replacing_folder(folder: str | Path, names: Collection[str]) -> Iterator[Path]:
    """Yield a new folder to write to; at the end it takes the place of `folder`, which is made if need be.

    Args:
        folder: may hold an older result, which goes as a whole, and other files and folders, which are kept.
        names: of all files that such a result can have.

    Raises:
        OutputError: it cannot be written or replaced, which is found before anything is yielded where it can be known;
            the old folder is untouched.
    """
    with _staging(folder, partial(_check_folder, names)) as (place, part):
        try:
            yield part
        except OutputError as error:
            raise OutputError(str(error).replace(str(part), str(folder))) from None
        with writing(folder):
            for path in part.rglob("*"):
                sync(path)
            sync(part)
        with held(), _replacing:
            try:
                put_in_place(part, place, names)
            except OSError as error:
                rescued = place.with_name(part.stem.removeprefix("."))
                with writing(folder):
                    part.rename(rescued)
                why = f"{error.strerror}; the new result is in {rescued}"
                raise OutputError(f"cannot replace {folder}: {why}") from None
            _written(folder, place)
        sync(place.parent)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Make a folder and those above it, where need be; if what follows fails, those that stayed empty are none again.

    Raises:
        OutputError: it cannot be made.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except BaseException:
        with suppress(OSError):
            for place in made:
                place.rmdir()
        raise


def check_file(path: str | Path) -> None:
    """Find out before any work whether a file can be written. Raises OutputError: it cannot."""
    with _staging(path, _check_file):
        pass


def _abandon() -> None:
    """Remove what is unfinished; nothing is put in place any more."""
    if _replacing.acquire(timeout=LAST_WAIT):
        for part in list(_under_way):
            shutil.rmtree(part, ignore_errors=True)


before_a_hard_end(_abandon)


def _written(path: str | Path, place: Path) -> None:
    if place.parent not in _under_way:  # otherwise it is a part of a result
        note(f"written: {path}")


def _check_file(path: str | Path, place: Path) -> None:
    reasons = {
        f"{Path(path).parent} is not a folder": place.parent.exists() and not place.parent.is_dir(),
        f"folder {Path(path).parent} does not exist": not place.parent.is_dir(),
        "it is a folder": place.is_dir(),
        "it is no plain file": os.path.lexists(place) and not place.is_file(),
        "it is read-only": place.exists() and not os.access(place, os.W_OK),
    }
    for reason in (reason for reason, applies in reasons.items() if applies):
        raise OutputError(f"cannot write to {path}: {reason}")


def _check_folder(names: Collection[str], folder: str | Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    heal(place, names)
    if not os.path.lexists(place):
        return
    if not place.is_dir():
        raise OutputError(f"cannot write to {folder}: it is not a folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write to {folder}: it is read-only")
    folders = [entry for entry in place.iterdir() if entry.is_dir() and not entry.is_symlink()]
    for entry in (entry for entry in folders if entry.name in names):
        raise OutputError(f"cannot write to {Path(folder) / entry.name}: it is a folder")
    fixed = [entry.name for entry in folders if os.path.ismount(entry) or not os.access(entry, os.W_OK)]
    foreign = [entry.name for entry in folders if not any((place / name).exists() for name in names)]
    reasons = {
        "it is the current folder": place.samefile(os.curdir),
        "it is a mount point": os.path.ismount(place),
        f"the folder {''.join(fixed[:1])} in it cannot be moved": fixed,
        f"it holds other folders (such as {''.join(foreign[:1])}) and no earlier result": foreign,
    }
    for reason in (reason for reason, applies in reasons.items() if applies):
        raise OutputError(f"cannot replace {folder}: {reason}; name a folder within it")


@contextmanager
def _staging(path: str | Path, check: Callable[[str | Path, Path], None]) -> Iterator[tuple[Path, Path]]:
    """Yield the place behind `path`, its symbolic links followed, and a hidden folder beside it, removed at the end.

    The folder is locked for as long as this process lives: others that nobody holds are of runs that were killed.
    """
    with writing(path):
        place = Path(os.path.realpath(path))
        check(path, place)
        if not os.access(place.parent, os.W_OK | os.X_OK):
            raise OutputError(f"cannot write to {path}: folder {Path(path).parent} is read-only")
        for left in abandoned(place, PART):
            shutil.rmtree(left, ignore_errors=True)
    if place.parent not in _under_way:
        note(f"kept: {path} of an earlier run" if os.path.lexists(place) else NOTHING)
    part = None
    try:
        with writing(path):
            with held():
                part, lock = new_part(place)
                _under_way.append(part)
            probe = part / "probe"
            probe.write_bytes(bytes(PROBE_BYTES))
            sync(probe)
            probe.unlink()
        yield place, part
    finally:
        if part is not None:
            _under_way.remove(part)
            shutil.rmtree(part, ignore_errors=True)
            if lock is not None:
                os.close(lock)
