"""The messages of the chosen topics of one file, read and checked."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from coopenv.backends.bags.clocks import Delays
from coopenv.backends.bags.files import BagFile
from coopenv.backends.bags.selection import Chosen
from coopenv.backends.bags.values import Values
from coopenv.errors import CoopenvError
from coopenv.svea.codec import stamp_of
from coopenv.svea.samples import Value
from coopenv.svea.topics import Role

WILD = 10_000_000_000  # ns by which a stamp may be ahead of the others of its topic before it is left out


@dataclass(frozen=True, slots=True)
class Entry:
    """A message that was read."""

    stamp: int  # ns, clock of its source; 0: none
    received: int  # ns, clock of the recorder
    value: Value


@dataclass
class Track:
    """The messages of one topic, and why some were left out."""

    chosen: Chosen
    entries: list[Entry] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def delays(self) -> list[int]:
        """By how many ns its messages were received after their stamps."""
        return [entry.received - entry.stamp for entry in self.entries if entry.stamp]


def tracks_of(file: BagFile, chosen: Mapping[str, Chosen], values: Values, stamped: bool) -> dict[str, Track]:
    """Return what a file has on the chosen topics, by topic; `stamped`: whether stamps count."""
    wanted = {name for name, entry in chosen.items() if entry.role is not Role.CAMERA_INFO and name in file.topics}
    tracks = {name: Track(chosen[name]) for name in sorted(wanted)}
    for raw in file.messages(wanted):
        track = tracks[raw.topic]
        try:
            message = raw.decode()
            stamp = stamp_of(message) if stamped else 0
            track.entries.append(Entry(stamp, raw.received, values.read(track.chosen, message)))
        except CoopenvError as error:
            track.refused[str(error)] += 1
        except (AttributeError, TypeError, ValueError) as error:  # a definition with other fields than ours
            track.refused[f"{raw.type} has other fields than expected ({error})"] += 1
    for track in tracks.values():
        _leave_out_wild(track)
    return tracks


def delays_of(tracks: Mapping[str, Track]) -> Delays:
    """Return by how many ns each source is behind the recorder of a file."""
    least: dict[str, int] = {}
    for track in tracks.values():
        for delay in track.delays:
            source = track.chosen.source
            least[source] = min(delay, least.get(source, delay))
    return least


def _leave_out_wild(track: Track) -> None:
    """Drop messages whose stamps are far ahead of those of the others."""
    if not (delays := track.delays):
        return
    least = float(np.median(delays)) - WILD
    kept = [entry for entry in track.entries if not entry.stamp or entry.received - entry.stamp >= least]
    if len(kept) < len(track.entries):
        track.refused["its stamp is far in the future"] += len(track.entries) - len(kept)
        track.entries = kept
