"""Images of cameras in MCAP files: the newest image at a given time, by its recording time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Schema

from rtee.errors import LogError, MessageError
from rtee.hand.files import failing
from rtee.log.dataset.signals import Signal, Times, lasting
from rtee.log.rotation import OPEN, being_written
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
            with _reading(path) as reader:
                for schema, _, message in reader.iter_messages(topics=[self.topic]):
                    yield message.log_time, schema, message.data


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
        with _reading(path) as reader:
            summary = reader.get_summary()
            for channel in summary.channels.values() if summary else ():
                schema = summary.schemas.get(channel.schema_id)
                if schema is not None and schema.name in (*_CDR, *_PROTOBUF):
                    start = min((c.message_start_time for c in summary.chunk_indexes), default=0)
                    topics.setdefault(channel.topic, {})[path] = start
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
def _reading(path: Path) -> Iterator[Any]:
    with failing("cannot be read", path, LogError), path.open("rb") as stream:
        try:
            yield make_reader(stream)
        except McapError as error:
            unclosed = "is damaged, or was never closed: run `rtee log recover` first"
            raise LogError(OPEN if being_written(path) else unclosed, path=path) from error


def _image(schema: Schema, content: bytes) -> tuple[str, bytes]:
    """Return the format and the bytes of an image in a message."""
    if schema.encoding == "protobuf":
        message = _protobuf(schema.name, schema.data).FromString(content)
        return str(message.format), bytes(message.data)
    try:
        fields = _cdr(schema.name).decode(content)
    except MessageError as error:
        raise LogError(f"an image cannot be decoded: {error}") from None
    return str(fields["format"]), bytes(fields["data"])


@cache
def _cdr(name: str) -> MessageType:
    return parse(name, _CDR[name])


@cache
def _protobuf(name: str, descriptors: bytes) -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
