"""Results written whole: a file or folder is complete or not there."""

import ctypes
import os
import secrets
import shutil
import stat
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from glob import escape
from math import inf
from pathlib import Path
from time import monotonic, sleep

from coopenv.base.errors import OutputError, shown
from coopenv.base.interrupts import NOTHING, before_a_hard_end, held, note

try:
    import fcntl
except ImportError:  # no POSIX: whether a hidden folder is in use cannot be tested, so all of them stay
    fcntl = None  # type: ignore[assignment]

PART, OLD = ".part", ".old"  # suffixes of hidden folders: for new results, and for replaced results
_HIDDEN = ".{}." + "[0-9a-f]" * 8
POLL = 0.02  # s between attempts to lock
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


_MUTING = threading.RLock()


@contextmanager
def muted_errors() -> Iterator[None]:
    """Drop what libraries meanwhile write to standard error, past Python; one thread at a time."""
    with _MUTING:
        saved = None
        with suppress(OSError):  # no standard error: nothing to mute
            saved = os.dup(2)
        try:
            if saved is not None:
                with Path(os.devnull).open("wb") as nothing:
                    os.dup2(nothing.fileno(), 2)
            yield
        finally:
            if saved is not None:
                os.dup2(saved, 2)
                os.close(saved)


def lock(folder: Path, wait: float = 0.0, shared: bool = False) -> int | None:
    """Return a descriptor that holds a folder until it is closed, or None: no locks, or held by others for `wait` s.

    Several may hold it `shared`, and then it is held by others for all that want it for themselves.
    """
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    end = monotonic() + wait
    while True:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            return descriptor
        except OSError as error:
            if not isinstance(error, BlockingIOError) or monotonic() >= end:
                os.close(descriptor)
                return None
        sleep(POLL)


def put_in_place(part: Path, place: Path, names: Collection[str]) -> None:
    """Put the folder `part` in its place and keep entries there that are not of `names`; an OSError changes nothing."""
    if not place.exists():
        part.rename(place)
        return
    copy_owner(place, part)
    for entry in place.iterdir():
        if entry.name not in names and (entry.is_symlink() or not entry.is_dir()):
            with suppress(OSError):  # a file system without links: moved over afterwards, like folders
                os.link(entry, part / entry.name, follow_symlinks=False)
    old = part.with_suffix(OLD)
    exchange(part, place, old)
    clear(old, place, names)


def exchange(part: Path, place: Path, old: Path) -> None:
    """Let `part` and the folder at `place` change places; the latter is then called `old`."""
    part.rename(old)  # if this process is killed, the rest is removed entry by entry
    rename = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    paths = os.fsencode(old), os.fsencode(place)
    if rename is not None and rename(AT_FDCWD, paths[0], AT_FDCWD, paths[1], RENAME_EXCHANGE) == 0:
        return
    old.rename(part)
    place.rename(old)
    try:
        part.rename(place)
    except OSError:
        old.rename(place)
        raise


def clean(place: Path, names: Collection[str]) -> None:
    """Remove what killed runs have left beside a place; finish a replacement that one had begun."""
    for left in place.parent.glob(_HIDDEN.format(escape(place.name)) + ".*"):
        if left.suffix == PART:
            shutil.rmtree(left, ignore_errors=True)
        elif left.suffix == OLD and not os.path.lexists(place):
            left.rename(place)
        elif left.suffix == OLD:  # a place without a result was made anew, and gets the old one
            clear(left, place, names if any((place / name).exists() for name in names) else ())


def clear(old: Path, place: Path, names: Collection[str]) -> None:
    """Remove an old folder; entries that are not of `names` move to `place`, unless an entry of that name is there."""
    with suppress(OSError):
        for entry in old.iterdir():
            with suppress(OSError):
                kept = place / entry.name
                if entry.name in names or (os.path.lexists(kept) and os.path.samestat(entry.lstat(), kept.lstat())):
                    entry.unlink()
                elif not os.path.lexists(kept):
                    entry.rename(kept)
        old.rmdir()


def copy_owner(old: Path, new: Path) -> None:
    """Give a new file or folder the mode and, where allowed, the owner of the replaced one."""
    if os.name == "posix":
        with suppress(OSError):
            info = old.stat()
            new.chmod(stat.S_IMODE(info.st_mode))
            os.chown(new, info.st_uid, info.st_gid)


def sync(path: Path) -> None:
    """Wait until a file, or, where that can be asked for, a folder's list of names is on the disk; else OSError."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError:
        if not path.is_dir():
            raise


PROBE_BYTES = 1 << 16  # written before the work begins, to find a disk that is full already
LAST_WAIT = 0.5  # s to wait for a result that is being put in place, before the process is ended

_replacing = threading.Lock()
_under_way: list[Path] = []


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turn the system's refusal to write `path` into an `OutputError`."""
    try:
        yield
    except OSError as error:
        of_folders = {FileExistsError: "it is not a folder", NotADirectoryError: "a part of its path is not a folder"}
        raise OutputError(f"cannot write to {path}: {of_folders.get(type(error), error.strerror or error)}") from None


@contextmanager
def replacing_file(path: str | Path) -> Iterator[Path]:
    """Yield a path to write to; the file there replaces the file `path` at the end.

    Raises:
        OutputError: it cannot be written; the old file is untouched.
    """
    if not isinstance(path, str | os.PathLike):
        raise OutputError(f"path: expected text or a Path, got {shown(path)}")
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
    """Write a text that replaces the file `path`.

    Raises:
        OutputError: it cannot be written; the old file is untouched.
    """
    with replacing_file(path) as new:
        new.write_text(text, encoding="utf-8")


@contextmanager
def replacing_folder(folder: str | Path, names: Collection[str]) -> Iterator[Path]:
    """Yield a new folder to write to; at the end it takes the place of `folder`, which is made if need be.

    Args:
        folder: may hold an older result, which goes as a whole, and other files and folders, which are kept.
        names: of all files that such a result can have.

    Raises:
        OutputError: it cannot be written or replaced, or another run is writing there, which is found before anything
            is yielded where it can be known; the old folder is untouched.
    """
    with _staging(folder, partial(_check_folder, names), names) as (place, part):
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
    """Make a folder and its parents, where need be; after an error in the block, empty ones are removed again.

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


def check_new(path: Path, force: bool, named: Path | None = None) -> None:
    """Keep an existing file, which errors call `named`. Raises OutputError: it exists, and `force` is not given."""
    if path.exists() and not force:
        raise OutputError(f"{named or path}: exists already; --force replaces it")


def check_file(path: str | Path) -> None:
    """Check before any work that a file can be written. Raises OutputError: it cannot."""
    with _staging(path, _check_file):
        pass


def _abandon() -> None:
    """Remove unfinished results; from now on no result is put in place."""
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
def _staging(
    path: str | Path, check: Callable[[str | Path, Path], None], names: Collection[str] = ()
) -> Iterator[tuple[Path, Path]]:
    """Yield the place behind `path`, its symbolic links followed, and a hidden folder beside it, removed at the end.

    Meanwhile the folder above is locked, shared with other runs: where it is not, hidden folders are of killed runs.
    """
    with writing(path):
        place = Path(os.path.realpath(path))
        check(path, place)
        if not os.access(place.parent, os.W_OK | os.X_OK):
            raise OutputError(f"cannot write to {path}: folder {Path(path).parent} is read-only")
        if (alone := lock(place.parent)) is not None:
            clean(place, names)
            os.close(alone)
        in_use = lock(place.parent, inf, shared=True)
    if place.parent not in _under_way:
        note(f"kept: {path} of an earlier run" if os.path.lexists(place) else NOTHING)
    part = place.with_name(f".{place.name}.{secrets.token_hex(4)}{PART}")
    _under_way.append(part)
    own = None
    try:
        with writing(path):
            part.mkdir()
            probe = part / "probe"
            probe.write_bytes(bytes(PROBE_BYTES))
            sync(probe)
            probe.unlink()
        own = lock(part, inf, shared=True) if names else None  # of two runs at once, at least one then finds the other
        others = place.parent.glob(_HIDDEN.format(escape(place.name)) + PART) if own is not None else ()
        for other in (other for other in others if other != part):
            with suppress(FileNotFoundError):  # removed meanwhile
                if (free := lock(other)) is None:
                    raise OutputError(f"cannot write to {path}: another run is writing its results there")
                os.close(free)
        yield place, part
    finally:
        shutil.rmtree(part, ignore_errors=True)
        _under_way.remove(part)
        for descriptor in (in_use, own):
            if descriptor is not None:
                os.close(descriptor)
