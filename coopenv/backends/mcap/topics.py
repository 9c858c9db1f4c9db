"""Which topics an MCAP file has, by its index."""

from pathlib import Path

from coopenv.backends.mcap.messages import codec
from coopenv.backends.mcap.peek import CUT_OFF, MENDED, is_cut_off
from coopenv.base.errors import DataError


def topics_of(path: str | Path) -> list[str]:
    """Return the names of the topics of a file, sorted.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: no such file, or it is no MCAP file with an index.
    """
    codec()
    from mcap.reader import make_reader

    try:
        cut_off = is_cut_off(Path(path))
        with Path(path).open("rb") as stream:
            summary = None if cut_off else make_reader(stream).get_summary()
    except IsADirectoryError:
        raise DataError(f"{path}: a folder; expected a log file (.mcap)") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception as error:  # whatever the library raises at bytes that make no sense
        raise DataError(f"{path}: no MCAP file with an index ({str(error) or type(error).__name__})") from None
    if cut_off:
        raise DataError(f"{path}: {CUT_OFF}; {MENDED}")
    if summary is None:
        raise DataError(f"{path}: an MCAP file without an index")
    return sorted(channel.topic for channel in summary.channels.values())
