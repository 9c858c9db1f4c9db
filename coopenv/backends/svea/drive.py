"""A recorded drive of cars in their place: the same messages, the same ticks."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from coopenv.backends.base import Capabilities, Episode, TickGenerator
from coopenv.backends.mcap.container import Container
from coopenv.backends.svea.assembler import Assembler
from coopenv.backends.svea.binding import Binding, bind
from coopenv.backends.svea.intake import Intake
from coopenv.backends.svea.options import wishes_of
from coopenv.backends.svea.tape import ATTACHMENT, FORMAT, NAME
from coopenv.errors import CoopenvError, DataError
from coopenv.scenario.files import override, parse_scenario
from coopenv.scenario.own_terms import without_own_terms
from coopenv.svea.codec import decode, stamp_of
from coopenv.svea.definitions import TICK
from coopenv.svea.deployment import Deployment, parse_deployment
from coopenv.svea.topics import TICK_TOPIC
from coopenv.svea.transport.base import Arrival


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
    try:
        metadata, _ = Container(Path(path)).extras()
    except Exception:  # of whatever kind of file it is
        return False
    return NAME in metadata


class Drive(TickGenerator):
    """A drive as a backend: actions change nothing. Every reset goes on to its next episode, and round again."""

    def __init__(self, path: str | Path, overrides: Mapping[str, Any] | None = None) -> None:
        """Open a file that `coopenv svea run --record` has written.

        Args:
            path: the file.
            overrides: dotted keys of its environment, for example another observer's name.

        Raises:
            DataError: it is none, or is damaged.
            CoopenvError: an override is not valid.
        """
        self._where = str(path)
        try:
            container = Container(Path(path))
            metadata, attachments = container.extras()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        except DataError:
            raise
        except Exception as error:  # whatever the libraries raise at bytes that make no sense
            raise DataError(f"{path}: damaged MCAP file ({type(error).__name__})") from None
        if metadata.get(NAME, {}).get("format") != FORMAT or ATTACHMENT not in attachments:
            raise DataError(f"{path}: no recorded drive of coopenv (format '{FORMAT}')")
        self._deployment, self.binding = self._read_head(attachments[ATTACHMENT], overrides or {})
        self._messages = list(self._read(container))
        ends = [n for n, (topic, _, index) in enumerate(self._messages) if topic == TICK_TOPIC and index == 0]
        if not ends:
            raise DataError(f"{path}: no episode begins in it")
        last = [index for topic, _, index in self._messages if topic == TICK_TOPIC]
        self._episodes, self._next = len(ends), 0
        self.drawn = (0, 0)
        local = self.binding.local if self.binding.remote else None
        truth, ticks = self._deployment.sensors.truth, max(last) + 1
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

    def _read(self, container: Container) -> Iterator[tuple[str, Any, int]]:
        """Yield (topic, arrival or (time, key, episode), index of a tick or -1)."""
        try:
            for channel, _, message in container.messages():
                topic = channel.topic.lstrip("/")
                if topic != TICK_TOPIC:
                    yield topic, Arrival(topic, bytes(message.data), message.log_time), -1
                    continue
                mark = decode(message.data, TICK)
                yield topic, (stamp_of(mark), int(mark.key), int(mark.episode)), int(mark.index)
        except CoopenvError as error:
            raise DataError(f"{self._where}: {error}") from None
        except Exception as error:
            raise DataError(f"{self._where}: damaged MCAP file ({type(error).__name__})") from None

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the messages from the begin, giving the ticks of one episode; `arm` moves nobody."""
        wishes_of(options)
        wanted, self._next = self._next, (self._next + 1) % self._episodes
        intake, assembler = Intake(self.binding, self._deployment.sensors), Assembler(self.binding)
        number = -1
        for topic, content, index in self._messages:
            if topic != TICK_TOPIC:
                for sample in intake.samples(content):
                    assembler.put(sample)
                continue
            now, key, episode = content
            if index == 0:
                number += 1
                if number > wanted:
                    return
                self.drawn = key, episode
                tick = assembler.begin(now)
            else:
                tick = assembler.tick(index, now)
            if number == wanted:
                yield tick
