"""The layout of a recording: its channels, and the records before the first message."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import PurePosixPath

from mcap.records import Attachment, Channel, Schema

from rtee.hand.config_schema import ActuatorDynamics
from rtee.hand.embedded_meshes import MEDIA_TYPES, EmbeddedMeshes, with_mesh_addresses
from rtee.hand.frames import JointFrames
from rtee.hand.model import Hand
from rtee.log.chunks import ChunkBuilder, PackedChunk
from rtee.log.mcapfile import Preamble
from rtee.log.rotation import MESHES, METADATA
from rtee.loop.settings import LoopSettings
from rtee.messages.convert import encode_string
from rtee.messages.layout import TransformsEncoder
from rtee.messages.schema import message_type
from rtee.messages.topics import LATCHED, ROBOT_DESCRIPTION, TF_STATIC, TYPES, URDF, log_topic
from rtee.types import ActuatorSpec

FORMAT = "1"
"""Version of the layout of recordings."""

CHANNELS: Mapping[str, int] = {name: number for number, name in enumerate(TYPES, start=1)}
"""Identifiers of channels by name of the topic."""

REPLAY = "replay.json"
"""Name of the attachment with the settings needed to recompute the references."""

STATE = "controller.json"
"""Name of the attachment with a state of the controller, from which a part can be recomputed."""

RUN_BEGINS = "run_begins"
"""Kind of the event at which another run, with a new controller, begins in a recording."""

_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline: {sec: 0, nsec: 0}\n"
    "  lifespan: {sec: 0, nsec: 0}\n  liveliness: 1\n"
    "  liveliness_lease_duration: {sec: 0, nsec: 0}\n  avoid_ros_namespace_conventions: false\n"
)
_MEDIA_TYPES = {
    ".urdf": "application/xml",
    ".srdf": "application/xml",
    ".yaml": "application/yaml",
    ".json": "application/json",
    **MEDIA_TYPES,
}


@dataclass(frozen=True, slots=True)
class Replayable:
    """Settings needed, besides the messages, to recompute the references of a recording.

    Attributes:
        settings: The loop's settings.
        actuators: The actuators with the limits and rest positions used at the time.
        rules: Version of the rules of contact (`rtee.loop.contact_rules`); 1 in recordings from
            before it was written.
        dynamics: The dynamics of the actuators by name, from hand.yaml; empty in recordings from
            before they were written.
    """

    settings: LoopSettings
    actuators: tuple[ActuatorSpec, ...]
    rules: int = 1
    dynamics: Mapping[str, ActuatorDynamics] = field(default_factory=dict)


def library_name() -> str:
    """Return the name and the version of this software."""
    # Only here: it takes 1.5 MB, and hands without recordings need none.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"rtee {version('rtee')}"
    except PackageNotFoundError:
        return "rtee"


@dataclass(frozen=True)
class Contents:
    """Content common to all recordings of a hand; ``rate`` is that of its loop [Hz].

    Attributes:
        attachments: Files to attach, by name: hand.yaml, SRDF, actions; the URDF always is.
        metadata: Further metadata.
        meshes: Meshes of the hand, to attach.
        latched: Messages by topic that stay valid until the next one; every file begins with them.
    """

    hand: Hand
    rate: float
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    meshes: EmbeddedMeshes = field(default_factory=lambda: EmbeddedMeshes({}, {}))
    latched: dict[str, bytes] = field(default_factory=dict)

    @cached_property
    def _descriptions(self) -> Mapping[str, bytes]:
        """The robot's descriptions by topic: with embedded meshes, and with paths to meshes."""
        text, meshes = self.hand.urdf.text, self.meshes.meshes
        # Viewers on other computers need the meshes inside; RViz needs files.
        inside = {address: url for address, mesh in meshes.items() if (url := mesh.data_url)}
        paths = {address: mesh.path.as_uri() for address, mesh in meshes.items()}
        return {
            ROBOT_DESCRIPTION: encode_string(with_mesh_addresses(text, inside)),
            URDF: encode_string(with_mesh_addresses(text, paths)),
        }

    @cached_property
    def _files(self) -> Mapping[str, bytes]:
        return {
            f"{self.hand.name}.urdf": self.hand.urdf.text.encode(),
            **self.attachments,
            **{name: mesh.data for name, mesh in self.meshes.files.items()},
        }

    def prepare(self) -> None:
        """Compute the slow parts in advance, before the loop runs."""
        _ = self._descriptions, self._files

    def _values(self, **more: str) -> dict[str, str]:
        return {
            "hand": self.hand.name,
            "format": FORMAT,
            "rate": repr(self.rate),
            "actuators": json.dumps(self.hand.actuator_names, ensure_ascii=False),
            **self.metadata,
            **more,
        }

    def preamble(self, wall_ns: int, **more: str) -> Preamble:
        """Return the records before the first chunk of a file, at a time [ns since 1970].

        ``more`` is further metadata of this file.
        """
        names = sorted(set(TYPES.values()))
        # Identifiers begin with 1, since 0 means "no schema" in MCAP.
        schemas = [
            Schema(
                id=number, name=name, encoding="ros2msg", data=message_type(name).schema.encode()
            )
            for number, name in enumerate(names, start=1)
        ]
        channels = [
            Channel(
                id=CHANNELS[topic],
                topic=log_topic(self.hand.name, topic),
                message_encoding="cdr",
                metadata={"offered_qos_profiles": _LATCHED if topic in LATCHED else ""},
                schema_id=names.index(kind) + 1,
            )
            for topic, kind in TYPES.items()
        ]
        metadata = {METADATA: self._values(**more)}
        # Addresses of meshes hold on one computer only; the attachments move with the file.
        if self.meshes.meshes:
            metadata[MESHES] = {old: mesh.name for old, mesh in self.meshes.meshes.items()}
        return Preamble(
            library=library_name(),
            metadata=metadata,
            attachments=[
                Attachment(
                    create_time=wall_ns,
                    log_time=wall_ns,
                    name=name,
                    media_type=_MEDIA_TYPES.get(PurePosixPath(name).suffix, "text/plain"),
                    data=data,
                )
                for name, data in self._files.items()
            ],
            schemas=schemas,
            channels=channels,
        )

    def description(self, wall_ns: int) -> PackedChunk:
        """Return the first chunk of every file, with the robot's description."""
        # The high level is slow, but used once per file, most of which are meshes.
        builder = ChunkBuilder(level=9)
        for topic, data in {**self._descriptions, **self.latched}.items():
            builder.add(CHANNELS[topic], 0, wall_ns, data)
        frames = JointFrames(self.hand)
        if frames.fixed:
            encoder = TransformsEncoder(*zip(*frames.fixed, strict=True))
            builder.add(CHANNELS[TF_STATIC], 0, wall_ns, encoder.encode(wall_ns, *frames.still))
        chunk = builder.pack()
        assert chunk is not None  # noqa: S101 - narrows the type
        return replace(chunk, digest=())
