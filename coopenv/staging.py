"""Hidden folders beside a result: made, locked, put in the place of an older one, and found again after a kill."""

import ctypes
import os
import secrets
import stat
import sys
from collections.abc import Collection, Iterator
from contextlib import suppress
from glob import escape
from math import inf
from pathlib import Path
from time import monotonic, sleep

try:
    import fcntl
except ImportError:  # no POSIX: nobody can tell whether a hidden folder is still in use, so all of them stay
    fcntl = None  # type: ignore[assignment]

PART, OLD = ".part", ".old"  # suffixes of hidden folders: what is being written, and what has made room for it
POLL = 0.02  # s between attempts to lock
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


def new_part(place: Path) -> tuple[Path, int | None]:
    """Return a new hidden folder beside a place, and the descriptor that holds it, if there are locks."""
    while True:
        part = place.with_name(f".{place.name}.{secrets.token_hex(4)}{PART}")
        part.mkdir()
        with suppress(FileNotFoundError):
            descriptor = lock(part, wait=inf)
            if part.exists():  # not taken for abandoned before it was locked
                return part, descriptor
            if descriptor is not None:
                os.close(descriptor)


def abandoned(place: Path, suffix: str) -> Iterator[Path]:
    """Yield the hidden folders of a place that belong to no living process."""
    for path in place.parent.glob(f".{escape(place.name)}.{'[0-9a-f]' * 8}{suffix}"):
        try:
            descriptor = lock(path)
        except OSError:  # gone meanwhile
            continue
        if descriptor is not None:
            try:
                yield path
            finally:
                os.close(descriptor)


def lock(folder: Path, wait: float = 0.0) -> int | None:
    """Return a descriptor that holds a folder until it is closed, or None: no locks, or held by others for `wait` s."""
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    end = monotonic() + wait
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return descriptor
            except BlockingIOError:
                if monotonic() >= end:
                    raise
                sleep(POLL)
    except OSError:
        os.close(descriptor)
        return None


def put_in_place(part: Path, place: Path, names: Collection[str]) -> None:
    """Put the folder `part` in its place, with what is there and not of `names`; after an OSError all is as it was."""
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
    part.rename(old)  # from now on nobody removes it unseen
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


def heal(place: Path, names: Collection[str]) -> None:
    """Finish what a run that was killed had begun."""
    for old in abandoned(place, OLD):
        if not os.path.lexists(place):
            old.rename(place)
        elif any((place / name).exists() for name in names):
            clear(old, place, names)
        else:  # somebody has made an empty place since
            clear(old, place, ())


def clear(old: Path, place: Path, names: Collection[str]) -> None:
    """Remove an old folder but for what is not of `names`, which goes to `place` unless something else is there."""
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
    """Give what is new the mode and, where allowed, the owner of what it replaces."""
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
