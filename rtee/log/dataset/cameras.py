"""Images of cameras in MCAP files: the newest image at a given time, by its recording time."""

from __future__ import annotations

import contextlib
import heapq
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Schema

from rtee.errors import LogError, MessageError
from rtee.hand.files import failing
from rtee.log.dataset.signals import Signal, Times, lasting
from rtee.log.file_index import FileIndex, index_file
from rtee.log.record_scanner import LATEST, DamagedRecordError, Record, messages_of, scan
from rtee.log.rotation import OPEN, being_written
from rtee.messages.mcap_chunk import LARGEST_CHUNK, records_of
from rtee.messages.schema import MessageType, parse

_CDR: Final[Mapping[str, str]] = {
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "foxglove_msgs/msg/CompressedImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
}
"""Definitions of messages with an image, of common_interfaces and of Foxglove's schemas."""

_PROTOBUF: Final = ("foxglove.CompressedImage", "foxglove.CompressedVideo")

_DECODERS: Final[Mapping[str, str]] = {
    "jpeg": "mjpeg",
    "jpg": "mjpeg",
    "png": "png",
    "webp": "webp",
    "h264": "h264",
    "h265": "hevc",
}
"""FFmpeg's decoders, by a word in the format of a message."""

_MOST_PIXELS: Final = 200_000_000
"""Most pixels of an image that is decoded: more than the largest cameras have."""

_MESSAGE: Final = struct.Struct("<HIQQ")
"""Head of a message: channel, number, log time, publish time [ns since 1970]."""

_VIDEO: Final = ("h264", "hevc")
"""The decoders that need every earlier message."""


@dataclass(frozen=True)
class CameraTopic:
    """A topic with images.

    Attributes:
        name: Its name in the dataset.
        topic: The topic.
        paths: The files that have it.
    """

    name: str
    topic: str
    paths: tuple[Path, ...]

    def availability(self, fps: float) -> Signal:
        """Return when there were images, without decoding any, for so many frames a second."""
        times = [time for time, _, _ in self._messages()]
        wall = np.array(times, dtype=np.int64)
        return Signal((self.name,), wall, np.ones((len(wall), 1)), lasting(wall, fps))

    def newest(self, when: Times) -> Iterator[Any]:
        """Yield the newest image at each of the given increasing times, as a frame of PyAV.

        Raises:
            LogError: if an image cannot be decoded.
        """
        decoder = _Decoder(self)
        messages = self._messages()
        following = next(messages, None)
        for time in when.tolist():
            while following is not None and following[0] <= time:
                decoder.take(*following[1:])
                following = next(messages, None)
            yield decoder.frame()

    def _messages(self) -> Iterator[tuple[int, Schema, bytes]]:
        """Yield time [ns since 1970], schema and content of the messages, in the order of time."""
        for path in self.paths:
            with _reading(path) as (file, stream):
                channels = {
                    number: file.schemas[channel.schema_id]
                    for number, channel in file.channels.items()
                    if channel.topic == self.topic and channel.schema_id in file.schemas
                }
                for time, _, channel, content in _in_order(file, stream, channels):
                    yield time, channels[channel], content


class _Decoder:
    """Decodes the images of a camera; still images only when requested."""

    def __init__(self, camera: CameraTopic) -> None:
        self._camera = camera
        self._codec = ""
        self._context: Any = None
        self._waiting: bytes | None = None
        self._frame: Any = None

    def take(self, schema: Schema, content: bytes) -> None:
        """Take a message."""
        kind, data = _image(schema, content)
        codec = next((codec for word, codec in _DECODERS.items() if word in kind.lower()), "")
        if not codec or "compressedDepth" in kind:
            raise self._error(f"an image in it has the format '{kind:.50}', which cannot be read")
        if codec != self._codec:
            import av

            self._codec, self._context = codec, av.CodecContext.create(codec, "r")
            self._context.thread_count = 1  # threads give an image one message later
            self._context.options = {"max_pixels": str(_MOST_PIXELS)}
        self._waiting = data
        if codec in _VIDEO:
            self._decode()

    def frame(self) -> Any:
        """Return the newest image."""
        self._decode()
        if self._frame is None:
            raise self._error("has no complete image by then: a video begins with a key frame")
        return self._frame

    def _decode(self) -> None:
        data, self._waiting = self._waiting, None
        if data is None:
            return
        import av

        try:
            frames = self._context.decode(av.Packet(data))
        except av.FFmpegError as error:
            # Frames of a video before the first key frame cannot be decoded.
            if self._codec not in _VIDEO:
                raise self._error(f"an image in it is damaged: {error.strerror}") from None
        else:
            self._frame = frames[-1] if frames else self._frame

    def _error(self, why: str) -> LogError:
        return LogError(f"the camera '{self._camera.topic}': {why}", path=self._camera.paths[0])


def cameras_in(paths: Iterable[Path], chosen: Sequence[str] = ()) -> list[CameraTopic]:
    """Return the cameras in files, or those chosen by ``[NAME=]TOPIC``.

    A camera is named after its topic unless given.

    Raises:
        LogError: if a file cannot be read, or there is no such topic.
    """
    topics: dict[str, dict[Path, int]] = {}
    for path in paths:
        with _reading(path) as (file, _):
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                if schema is not None and schema.name in (*_CDR, *_PROTOBUF):
                    topics.setdefault(channel.topic, {})[path] = file.start
    cameras = []
    for each in chosen or topics:
        name, _, topic = each.rpartition("=")
        if topic not in topics:
            there = ", ".join(sorted(topics)) or "none"
            raise LogError(f"there is no camera on '{topic}'; topics with images: {there}")
        name = name or topic.strip("/").removesuffix("/compressed").replace("/", "_")
        files = topics[topic]
        cameras.append(CameraTopic(name, topic, tuple(sorted(files, key=files.__getitem__))))
    return cameras


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[tuple[FileIndex, BinaryIO]]:
    """Open a file and index it; raises `LogError` if it is damaged, there or inside the block."""
    with failing("cannot be read", path, LogError), path.open("rb") as stream:
        try:
            file = index_file(path)
            if file.damage or not file.finished:
                raise DamagedRecordError(*file.damage[:1])
            yield file, stream
        except DamagedRecordError as error:
            unclosed = "is damaged, or was never closed: run `rtee log recover` first"
            raise LogError(OPEN if being_written(path) else unclosed, path=path) from error


def _in_order(
    file: FileIndex, stream: BinaryIO, channels: Iterable[int]
) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield the messages of channels by their log time: time, count, channel and content."""
    places = [(chunk.start, chunk.record) for chunk in file.chunks]
    if file.loose:
        loose = (each for each in scan(stream) if each.opcode == Opcode.MESSAGE)
        places += [(_head(each.read(stream, _MESSAGE.size))[1], each) for each in loose]
    # Chunks may overlap: a message waits for those of all chunks that begin before it.
    waiting: list[tuple[int, int, int, bytes]] = []
    count = size = 0
    for start, record in sorted(places, key=lambda place: place[0]):
        while waiting and waiting[0][0] < start:
            size -= len(waiting[0][3])
            yield heapq.heappop(waiting)
        for content in _contents(record, stream):
            channel, time = _head(content)
            if channel in channels:
                count += 1
                size += len(content) - _MESSAGE.size
                heapq.heappush(waiting, (time, count, channel, content[_MESSAGE.size :]))
        if size > 2 * LARGEST_CHUNK:
            raise LogError("its chunks overlap too much", path=file.path)
    while waiting:
        yield heapq.heappop(waiting)


def _contents(record: Record, stream: BinaryIO) -> Iterator[bytes]:
    """Yield the messages in a chunk, or a message outside of chunks."""
    content = record.read(stream)
    if record.opcode == Opcode.MESSAGE:
        yield content
    else:
        for _, message in records_of(messages_of(content)[0], Opcode.MESSAGE):
            yield message


def _head(content: bytes) -> tuple[int, int]:
    """Return channel and log time of a message."""
    if len(content) < _MESSAGE.size:
        raise DamagedRecordError("a message is shorter than its head")
    channel, _, time, _ = _MESSAGE.unpack_from(content)
    if time > LATEST:
        raise DamagedRecordError("a message has an impossible time")
    return channel, time


def _image(schema: Schema, content: bytes) -> tuple[str, bytes]:
    """Return the format and the bytes of an image in a message."""
    if schema.encoding == "protobuf":
        return _of_protobuf(schema, content)
    try:
        fields = _cdr(schema.name).decode(content)
    except MessageError as error:
        raise LogError(f"an image cannot be decoded: {error}") from None
    return str(fields["format"]), bytes(fields["data"])


@cache
def _cdr(name: str) -> MessageType:
    return parse(name, _CDR[name])


def _of_protobuf(schema: Schema, content: bytes) -> tuple[str, bytes]:
    from google.protobuf.message import DecodeError

    try:
        message = _protobuf(schema.name, schema.data).FromString(content)
        return str(message.format), bytes(message.data)
    # Definitions that contradict themselves, that lack the message, or its fields.
    except (DecodeError, TypeError, KeyError, AttributeError) as error:
        said = str(error).partition("\n")[0]
        raise LogError(f"an image cannot be decoded: {said}") from None


@cache
def _protobuf(name: str, descriptors: bytes) -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
