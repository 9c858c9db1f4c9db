"""Limits for rosbags, which unpacks whatever a bag holds. Needs the extra `log`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, Self

from coopenv.backends.mcap.container import AT_ONCE, Allowance, TooLargeError
from coopenv.base.errors import CoopenvError

_allowance: ContextVar[Allowance | None] = ContextVar("_allowance", default=None)
"""What the bag that is read now may still unpack to; None: rosbags reads for another program."""


@contextmanager
def limited(allowance: Allowance) -> Iterator[None]:
    """Let rosbags unpack no more than is allowed, and SQLite return no value above `AT_ONCE`.

    Raises:
        CoopenvError: this version of rosbags unpacks in another way.
    """
    _guard_rosbags()
    token = _allowance.set(allowance)
    try:
        yield
    finally:
        _allowance.reset(token)


def each_limited(messages: Iterator[Any], allowance: Allowance) -> Iterator[Any]:
    """Yield messages, each of them read within an allowance."""
    while True:
        with limited(allowance):
            message = next(messages, None)
        if message is None:
            return
        yield message


def is_too_large(error: Exception) -> bool:
    """Return whether an error is about a part of a bag that is too large."""
    import apsw

    return isinstance(error, TooLargeError | apsw.TooBigError)


@cache
def _guard_rosbags() -> None:
    """Replace the functions with which rosbags unpacks by some that respect `_allowance`."""
    try:
        import apsw
        from rosbags.rosbag1.reader import decompressors
        from rosbags.rosbag2 import reader as rosbag2_reader
        from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

        reader: Any = rosbag2_reader
        unpack_message, open_file = reader.zstd.decompress, reader.zstd.open
    except (ImportError, AttributeError):
        raise CoopenvError(
            "this version of rosbags would unpack without limits; pip install 'rosbags==0.11.9'"
        ) from None

    def message(data: bytes) -> bytes:
        allowance = _allowance.get()
        return unpack_message(data) if allowance is None else allowance.unpack("zstd", data)

    def file(stream: Any, mode: str) -> Any:
        return open_file(stream, mode) if _allowance.get() is None else _Counted(open_file(stream, mode))

    def chunk(original: Callable[..., bytes], compression: str, data: bytes, size: int) -> bytes:
        allowance = _allowance.get()
        return original(data, size) if allowance is None else allowance.unpack(compression, data, size)

    def ros1_chunk(original: Callable[..., bytes], compression: str, data: bytes) -> bytes:
        if _allowance.get() is None:
            return original(data)
        return Allowance(len(data)).unpack(compression, data)  # rosbags holds one at a time, and may come back to it

    def connected(database: Any) -> None:
        if _allowance.get() is not None:
            database.limit(apsw.SQLITE_LIMIT_LENGTH, AT_ONCE)

    reader.zstd = SimpleNamespace(decompress=message, open=file)
    tables: tuple[tuple[Any, Any], ...] = ((DECOMPRESSORS, chunk), (decompressors, ros1_chunk))
    for table, limited_form in tables:
        table.update({name: partial(limited_form, original, name) for name, original in table.items()})
    apsw.connection_hooks.append(connected)


class _Counted:
    """A file that is unpacked while it is read; what it gives is counted."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *unused: object) -> None:
        self._stream.close()

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes. Raises TooLargeError: there are more than the bag may unpack to."""
        data = bytes(self._stream.read(size))
        allowance = _allowance.get()
        if allowance is not None:
            allowance.take(len(data))
        return data
