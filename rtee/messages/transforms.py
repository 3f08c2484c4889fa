"""Transforms of always the same frames as ``tf2_msgs/TFMessage``: packed once, then filled in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtee.messages.cdr import HEADER
from rtee.messages.schema import message_type
from rtee.types import FloatArray

TF_MESSAGE = message_type("tf2_msgs/msg/TFMessage")

_SECOND = 1_000_000_000
_NUMBERS = 7
"""Numbers of a transform: a position and a quaternion."""


def _fields(frame: str, child: str) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame},
        "child_frame_id": child,
        "transform": {
            "translation": dict.fromkeys("xyz", 0.0),
            "rotation": dict.fromkeys("xyzw", 0.0),
        },
    }


class TransformsEncoder:
    """Encodes where frames stand in their parents.

    Args:
        parents: The frame that each is told in.
        children: The frames.
    """

    def __init__(self, parents: Sequence[str], children: Sequence[str]) -> None:
        transforms = [_fields(*pair) for pair in zip(parents, children, strict=True)]
        ends = [
            len(TF_MESSAGE.encode({"transforms": transforms[:count]}))
            for count in range(len(transforms) + 1)
        ]
        self._data = bytearray(TF_MESSAGE.encode({"transforms": transforms}))
        # A transform begins with its stamp and ends with its numbers, with no padding around them.
        begins = np.array(ends[:-1], dtype=np.intp) - len(HEADER)
        last = np.array(ends[1:], dtype=np.intp) - len(HEADER)
        self._stamps = begins[:, None] // 4 + np.arange(2)
        self._slots = last[:, None] // 8 - _NUMBERS + np.arange(_NUMBERS)
        size = len(self._data) - len(HEADER)
        self._words = np.frombuffer(self._data, "<u4", size // 4, len(HEADER))
        self._doubles = np.frombuffer(self._data, "<f8", size // 8, len(HEADER))

    def encode(self, wall_ns: int, translation: FloatArray, rotation: FloatArray) -> bytes:
        """Return the CDR bytes of a message.

        Args:
            wall_ns: Its stamp since 1970 [ns].
            translation: Where the frames' origins are in their parents ``(n, 3)`` [m].
            rotation: How the frames are turned, unit quaternions (x, y, z, w) ``(n, 4)``.
        """
        self._words[self._stamps] = divmod(wall_ns, _SECOND)
        self._doubles[self._slots[:, :3]] = translation
        self._doubles[self._slots[:, 3:]] = rotation
        return bytes(self._data)
