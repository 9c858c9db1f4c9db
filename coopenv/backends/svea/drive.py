"""A recorded drive of cars in their place: the same messages, the same ticks."""

import json
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.backends.base import Capabilities, Episode, TickGenerator
from coopenv.backends.mcap.messages import codec
from coopenv.backends.mcap.peek import CUT_OFF, metadata_names
from coopenv.backends.svea.assembler import Assembler
from coopenv.backends.svea.binding import Binding, bind
from coopenv.backends.svea.intake import Intake
from coopenv.backends.svea.options import OPTIONS, wishes_of
from coopenv.backends.svea.tape import ATTACHMENT, FORMAT, NAME
from coopenv.errors import CoopenvError, DataError, DataWarning
from coopenv.scenario.files import override, parse_scenario
from coopenv.scenario.own_terms import without_own_terms
from coopenv.svea.codec import decode, stamp_of
from coopenv.svea.definitions import STOPPED, TICK
from coopenv.svea.deployment import Deployment, parse_deployment
from coopenv.svea.topics import STOPPED_TOPIC, TICK_TOPIC
from coopenv.svea.transport.base import Arrival

if TYPE_CHECKING:
    from coopenv.backends.mcap.container import Container


def head_of(deployment: Deployment, binding: Binding, only: str | None) -> bytes:
    """Return what a tape says of the fleet: JSON."""
    head = {
        "deployment": deployment.model_dump(mode="json", exclude={"security", "network"}),
        "scenario": binding.scenario.model_dump(mode="json"),
        "only": only,
    }
    return json.dumps(head).encode()


def is_drive(path: str | Path) -> bool:
    """Return whether a file is a recorded drive; False where it cannot be read."""
    return NAME in (metadata_names(path) or ())


@dataclass(frozen=True)
class Mark:
    """That a tick was made, at a time in ns; the key of the draws and the number of the episode count at its start."""

    index: int
    time: int
    key: int
    episode: int


@dataclass(frozen=True)
class Stopped:
    """That the watchdog stopped the cars."""

    reason: str
    time: int


class Drive(TickGenerator):
    """A drive as a backend: actions change nothing. Every reset goes on to its next episode, and round again.

    Of one whose end is missing, as the process that wrote it was killed, what is whole is replayed.
    """

    options = OPTIONS

    def __init__(self, path: str | Path, overrides: Mapping[str, Any] | None = None) -> None:
        """Open a file that `coopenv svea run --record` has written.

        Args:
            path: the file.
            overrides: dotted keys of its environment, for example another observer's name.

        Raises:
            DataError: it is none, or is damaged.
            CoopenvError: an override is not valid, or the extra is missing.
        """
        codec()  # says which extra is missing
        from coopenv.backends.mcap.container import Container

        self._where = str(path)
        try:
            container = Container(Path(path), forgiving=True)
            metadata, attachments = container.extras()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        except DataError:
            raise
        except Exception as error:  # whatever the libraries raise at bytes that make no sense
            raise DataError(f"{path}: damaged MCAP file ({type(error).__name__})") from None
        nothing = f"{path}: {f'{CUT_OFF}, and ' if container.cut_off else ''}no episode begins in it"
        if container.cut_off and ATTACHMENT not in attachments:
            raise DataError(nothing)
        if metadata.get(NAME, {}).get("format") != FORMAT or ATTACHMENT not in attachments:
            raise DataError(f"{path}: no recorded drive of coopenv (format '{FORMAT}')")
        self._deployment, self.binding = self._read_head(attachments[ATTACHMENT], overrides or {})
        self._messages = list(self._read(container))
        indices = [message.index for message in self._messages if isinstance(message, Mark)]
        if 0 not in indices:
            raise DataError(nothing)
        if container.cut_off:
            self._warn()
        self._episodes, self._next = indices.count(0), 0
        self.drawn = (0, 0)
        self.stopped = ""
        local = self.binding.local if self.binding.remote else None
        truth, ticks = self._deployment.sensors.truth, max(indices) + 1
        super().__init__(
            self.binding.scenario,
            Capabilities(truth, False, False, ticks, batched=False, recorded=True, estimated=local),
        )

    def _read_head(self, text: bytes, overrides: Mapping[str, Any]) -> tuple[Deployment, Binding]:
        try:
            head = json.loads(text)
            raw, given, only = head["scenario"], head["deployment"], head["only"]
        except (ValueError, TypeError, LookupError):
            raise DataError(f"{self._where}: {ATTACHMENT} is damaged") from None
        raw = without_own_terms(raw)
        for key, value in overrides.items():
            override(raw, key, value)
        scenario = parse_scenario(raw, f"{self._where}: {ATTACHMENT}")
        deployment = parse_deployment(given, Path(self._where))
        return deployment, bind(scenario, deployment.cars, deployment.markers, self._where, only)

    def _warn(self) -> None:
        """Say from where on the file is missing."""
        times = [message.received if isinstance(message, Arrival) else message.time for message in self._messages]
        seconds = (max(times) - min(times)) * 1e-9
        warnings.warn(
            f"{self._where}: {CUT_OFF}: of what came after {seconds:.1f} s nothing is replayed",
            DataWarning,
            stacklevel=3,
        )

    def _read(self, container: "Container") -> Iterator[Arrival | Mark | Stopped]:
        try:
            for channel, _, message in container.messages():
                topic = channel.topic.lstrip("/")
                if topic == TICK_TOPIC:
                    mark = decode(message.data, TICK)
                    yield Mark(int(mark.index), stamp_of(mark), int(mark.key), int(mark.episode))
                elif topic == STOPPED_TOPIC:
                    stop = decode(message.data, STOPPED)
                    yield Stopped(stop.reason, stamp_of(stop))
                else:
                    yield Arrival(topic, bytes(message.data), message.log_time)
        except CoopenvError as error:
            raise DataError(f"{self._where}: {error}") from None
        except Exception as error:
            raise DataError(f"{self._where}: damaged MCAP file ({type(error).__name__})") from None

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the messages from the begin, giving the ticks of one episode; `arm` moves nobody."""
        wishes_of(options)
        wanted, self._next = self._next, (self._next + 1) % self._episodes
        intake, assembler = Intake(self.binding, self._deployment.sensors), Assembler(self.binding)
        number, self.stopped = -1, ""
        for message in self._messages:
            if isinstance(message, Arrival):
                for sample in intake.samples(message):
                    assembler.put(sample)
                continue
            if isinstance(message, Stopped):
                self.stopped = message.reason if number == wanted else ""
                continue
            if message.index == 0:
                number += 1
                if number > wanted:
                    return
                self.drawn = message.key, message.episode
                tick = assembler.begin(message.time)
            else:
                tick = assembler.tick(message.index, message.time)
            if number == wanted:
                yield tick
