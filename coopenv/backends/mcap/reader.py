"""Read a recording back from an MCAP file, or say what is wrong with it. Nothing in the file is believed."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from coopenv.backends.mcap.header import Header
from coopenv.backends.mcap.messages import ATTACHMENT, EXACT, FORMAT, LANDMARKS, LANDMARKS_TYPE, PAN, codec, topic
from coopenv.backends.mcap.ticks import TickArrays
from coopenv.base.errors import CoopenvError, DataError, shown
from coopenv.observers.recording import Recording, check_recording

if TYPE_CHECKING:
    from coopenv.backends.mcap.container import Container


def read_recording(path: str | Path) -> Recording:
    """Read what `write_recording` wrote.

    Raises:
        CoopenvError: the extra `log` is not installed.
        DataError: no such file, not an MCAP file, cut off, damaged, not a recording of coopenv, or one that contradicts
            itself.
    """
    codec()
    from coopenv.backends.mcap.container import Container

    where = str(path)
    try:
        recording = _read(Container(Path(path)), where)
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror or error})") from None
    except DataError:
        raise
    except CoopenvError as error:
        raise DataError(f"{where}: {error}") from None
    except Exception as error:  # whatever the libraries raise at bytes that make no sense
        raise DataError(f"{where}: damaged MCAP file ({str(error) or type(error).__name__})") from None
    check_recording(recording, where)
    return recording


def _read(container: Container, where: str) -> Recording:
    header = _header(container, where)
    constants = header.constants(f"{where}: {ATTACHMENT}")
    names = [setup.name for setup in header.setups]
    scenario, first = constants["scenario"], header.setups[0]
    pan = scenario is not None and scenario.action.pan is not None
    exact = EXACT | PAN if pan else EXACT
    ticks = TickArrays(header.ticks, names, len(first.target_names), first.landmarks, pan)
    kinds = {LANDMARKS: LANDMARKS_TYPE} | {topic(name, field): exact[field] for name in names for field in exact}
    for channel, schema, message in container.messages():
        kind = kinds.get(channel.topic)
        if kind is None:
            continue
        try:
            found = f"{schema.name} ({schema.encoding}, {channel.message_encoding})" if schema else "no schema"
            if found != f"{kind} (ros2msg, cdr)":
                raise ValueError(f"holds {found}, expected {kind} (ros2msg, cdr)")
            ticks.put(channel.topic, message.sequence, codec().deserialize_cdr(message.data, kind))
        except Exception as error:  # of the codec too, which has its own
            reason = str(error) or type(error).__name__
            raise DataError(f"{where}: {channel.topic}, tick {message.sequence}: {reason}") from None
    try:
        return Recording(**ticks.complete(), **constants)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None


def _header(container: Container, where: str) -> Header:
    metadata, attachments = container.extras()
    found = metadata.get("coopenv")
    if found is None:
        raise DataError(f"{where}: an MCAP file, but no recording of coopenv (metadata 'coopenv' is missing)")
    if found.get("format") != FORMAT:
        raise DataError(f"{where}: format {shown(found.get('format'))} is not known; known: {FORMAT}")
    if ATTACHMENT not in attachments:
        raise DataError(f"{where}: attachment '{ATTACHMENT}' is missing")
    if hashlib.sha256(attachments[ATTACHMENT]).hexdigest() != found.get("sha256"):
        raise DataError(f"{where}: {ATTACHMENT} is damaged, its check sum differs")
    return Header.read(attachments[ATTACHMENT], f"{where}: {ATTACHMENT}")
