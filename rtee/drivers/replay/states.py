"""The recorded states of a hand, read block by block."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from numpy.typing import NDArray

from rtee.errors import LogError, MessageError
from rtee.messages import convert
from rtee.messages.codec import channels_of
from rtee.messages.mcap_chunk import HEAD, MAGIC, decompressed, records_of
from rtee.messages.schema import MessageType, message_type, recorded_type
from rtee.messages.tick_columns import decode_ticks
from rtee.messages.topics import (
    ACTUATOR_STATES,
    CHANNELS,
    OBJECT,
    TICKS,
    TOUCH,
    TOUCH_SENSORS,
    TYPES,
    log_topic,
)
from rtee.messages.touch import sensors_of, touch_of
from rtee.objects.description import ObjectDescription
from rtee.sample import COLUMNS, MEASURED, FloatArray
from rtee.touch import TouchSensor, TouchState

Extras = Mapping[str, FloatArray]

_DAMAGE = (McapError, struct.error, ValueError, EOFError, OverflowError, MemoryError)
"""Exceptions for damaged bytes: those of the mcap package, of decompression, and of sizes beyond
any memory."""


@dataclass(frozen=True, slots=True)
class Block:
    """A block of ``k`` consecutive states of ``n`` actuators.

    Attributes:
        stamp: Times of measurement ``(k,)`` [s].
        values: The ``m`` quantities of `rtee.sample.MEASURED`, in its order ``(k, m, n)``.
        grasped: The devices' grasp detection ``(k, n)``: 1 holding, 0 not holding, -1 unknown.
        extras: Further channels such as pressure, for each state.
        touch: The newest readings of the touch sensors by device, for each state.
    """

    stamp: FloatArray
    values: FloatArray
    grasped: np.ndarray[Any, np.dtype[np.int8]]
    extras: tuple[Extras, ...]
    touch: tuple[Mapping[str, TouchState], ...]


class RecordedStates:
    """Reads the states of some actuators from a recording; all methods may block.

    Reading a damaged part of the file raises `LogError`.

    Args:
        path: The recording.
        hand: Name of the hand; a recording of a single other hand is accepted, too, if it has the
            actuators.
        actuators: Names of the actuators, in the order of the states' columns.

    Raises:
        LogError: if the file cannot be read, or has no states of these actuators.
    """

    def __init__(self, path: Path, hand: str, actuators: tuple[str, ...]) -> None:
        self.path = path
        if path.exists() and not path.is_file():  # opening a named pipe would wait for its writer
            raise LogError("is not a file", path=path)
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise LogError(f"cannot be opened: {error.strerror}", path=path) from error
        try:
            self._check_ends()
            # Only for the summary: the package's reader of messages decompresses to any size.
            self._summary = make_reader(self._file).get_summary()
            self._topic = self._choose(hand)
            before = self._topic.removesuffix(ACTUATOR_STATES)
            self._extras_topic = f"{before}{CHANNELS}"
            self._touch_topics = (f"{before}{TOUCH}", f"{before}{TOUCH_SENSORS}")
            self._columns = self._find(actuators)
        except LogError:
            self._file.close()
            raise
        except (*_DAMAGE, MessageError) as error:
            self._file.close()
            raise LogError(f"is not a recording: {error}", path=path) from error

    def _check_ends(self) -> None:
        """Tell a file of another kind from a recording whose writer was killed."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise LogError("is not an MCAP file", path=self.path)
        self._file.seek(-len(MAGIC), os.SEEK_END)
        if self._file.read() != MAGIC:
            raise LogError("was not closed; `rtee log recover` repairs it", path=self.path)
        self._file.seek(0)

    def _choose(self, hand: str) -> str:
        summary = self._summary
        if summary is None:
            raise LogError("was not closed; `rtee log recover` repairs it", path=self.path)
        topics = sorted(
            channel.topic
            for channel in summary.channels.values()
            if channel.topic.endswith(f"/{ACTUATOR_STATES}")
        )
        wanted = log_topic(hand, ACTUATOR_STATES)
        if wanted in topics:
            return wanted
        # With several other hands in the recording, there is no reason to choose one.
        if len(topics) != 1:
            raise LogError(f"contains no states of the hand '{hand}'", path=self.path)
        return topics[0]

    def _find(self, actuators: tuple[str, ...]) -> list[int]:
        # A channel may have no messages, and only a message holds the names of the actuators.
        first = next(self._messages(), None)
        if first is None:
            raise LogError(f"contains no states in {self._topic}", path=self.path)
        names = list(first[0]["name"])
        missing = [name for name in actuators if name not in names]
        if missing:
            raise LogError(f"has no states of the actuator '{missing[0]}'", path=self.path)
        return [names.index(name) for name in actuators]

    def _stored(self, topics: Sequence[str]) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Yield the encoded messages of some topics; raises `LogError`."""
        summary = self._summary
        if summary is None:
            return
        channels = {c.id: c for c in summary.channels.values() if c.topic in topics}
        ticks = f"{self._topic.removesuffix(ACTUATOR_STATES)}{TICKS}"
        packed = {c.id for c in summary.channels.values() if c.topic == ticks}
        try:
            # Chunks do not overlap in recordings of rtee.
            for place in sorted(summary.chunk_indexes, key=lambda each: each.message_start_time):
                known = place.message_index_offsets
                if known and (channels.keys() | packed).isdisjoint(known):
                    continue
                self._file.seek(place.chunk_start_offset + HEAD.size)
                data = decompressed(Chunk.read(ReadDataStream(self._file)))
                for message in _messages_in(data, channels, packed):
                    channel = channels[message.channel_id]
                    yield summary.schemas.get(channel.schema_id), channel, message
        except (*_DAMAGE, OSError) as error:
            text = f"is damaged: {error}; `rtee log recover` keeps the rest"
            raise LogError(text, path=self.path) from error

    def _messages(self) -> Iterator[tuple[dict[str, Any], Extras, Mapping[str, TouchState]]]:
        """Yield every state, with the latest further channels and touch readings."""
        extras: Extras = {}
        channels: Extras = {}
        sensors: dict[str, tuple[TouchSensor, ...]] = {}
        touch: Mapping[str, TouchState] = {}
        topics = [self._topic, self._extras_topic, *self._touch_topics]
        kinds: dict[str, MessageType] = {}
        for schema, channel, message in self._stored(topics):
            topic = channel.topic
            if topic not in kinds:
                kinds[topic] = _recorded(TYPES[topic.rpartition("/")[2]], schema)
            fields = kinds[topic].decode(message.data)
            if topic == self._topic:
                yield fields, extras, touch
            elif topic in self._touch_topics:
                with contextlib.suppress(MessageError):
                    if topic == self._touch_topics[1]:
                        sensors |= sensors_of(fields)
                    else:
                        state = touch_of(fields, sensors)
                        # A new mapping, since states yielded before refer to the old one.
                        touch = {**touch, state.device: state}
            else:
                channels = {**channels, **_channels(fields)}  # a message has only changed channels
                extras = _short(channels)

    def blocks(self, size: int = 500) -> Iterator[Block]:
        """Read the states from the beginning, in blocks of at most ``size``."""
        messages = self._messages()
        while found := list(islice(messages, size)):
            rows = [row for row, *_ in found]
            yield Block(
                stamp=np.array([row["time"] for row in rows]),
                values=np.array([[self._column(row, name) for name in MEASURED] for row in rows]),
                grasped=np.array([self._column(row, "grasped") for row in rows]),
                extras=tuple(extras for _, extras, _ in found),
                touch=tuple(touch for *_, touch in found),
            )

    def _column(self, row: dict[str, Any], name: str) -> NDArray[Any]:
        """Return a quantity of the actuators, or its default if the recording lacks it."""
        if name in row:
            values: NDArray[Any] = row[name][self._columns]
            return values
        return np.full(len(self._columns), COLUMNS[name].default)

    def touch_sensors(self) -> dict[str, tuple[TouchSensor, ...]]:
        """Return the touch sensors by device, as first recorded."""
        found: dict[str, tuple[TouchSensor, ...]] = {}
        # All messages, since each device adds one when it measures for the first time.
        for schema, _, message in self._stored([self._touch_topics[1]]):
            with contextlib.suppress(MessageError):
                kind = _recorded(TYPES[TOUCH_SENSORS], schema)
                # The first description of a device takes precedence.
                found = {**sensors_of(kind.decode(message.data)), **found}
        return found

    def object_description(self) -> ObjectDescription | None:
        """Return the shape of the object that a simulated device grasped, if it is recorded."""
        topic = f"{self._topic.removesuffix(ACTUATOR_STATES)}{OBJECT}"
        found = next(self._stored([topic]), None)
        return None if found is None else convert.OBJECT.decode(found[2].data)

    def close(self) -> None:
        """Close the file; idempotent."""
        self._file.close()


def _messages_in(
    data: bytes, channels: Collection[int], packed: Collection[int] = ()
) -> list[Message]:
    """Return the messages of some channels among the records of a chunk, by their log time.

    A message of a ``packed`` channel holds many ticks, column by column, and replaces the single
    messages of their channels.
    """
    messages: list[Message] = []
    ticks: list[Message] = []
    for _, content in records_of(data, Opcode.MESSAGE):
        message = Message.read(ReadDataStream(BytesIO(content)), len(content))
        if message.channel_id in channels:
            messages.append(message)
        elif message.channel_id in packed:
            ticks += _messages_in(decode_ticks(message.data)[0].tobytes(), channels)
    whole = {message.channel_id for message in ticks}
    messages = [each for each in messages if each.channel_id not in whole] + ticks
    return sorted(messages, key=lambda message: message.log_time)


def _recorded(name: str, schema: Schema | None) -> MessageType:
    """Return a message type by the schema in the recording, which may be of another version."""
    text = schema.data.decode("utf-8", "replace") if schema else ""
    return recorded_type(name, text) if text else message_type(name)


def _channels(fields: dict[str, Any]) -> Extras:
    try:
        return channels_of(fields["name"], fields["length"], fields["value"])
    except MessageError:
        return {}


def _short(found: Extras) -> Extras:
    """Return further channels without the prefix ``DEVICE/``, if the names remain distinct."""
    short = {name.rpartition("/")[2]: values for name, values in found.items()}
    return short if len(short) == len(found) else found
