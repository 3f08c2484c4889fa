"""Frames of a tracker: JSON lines, live or from a file, and NumPy arrays."""

from __future__ import annotations

import json
import logging
import math
import zipfile
from collections.abc import (
    AsyncIterable,
    AsyncIterator,
    Awaitable,
    Callable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import anyio
import numpy as np

from rtee import monotonic
from rtee.errors import GoalRejected, LogError, UserError
from rtee.hand.files import reason
from rtee.retarget.layouts import Layout, Side, layout_named
from rtee.retarget.retargeter import Retargeter, TrackingError
from rtee.sample import FloatArray

log = logging.getLogger(__name__)

Send = Callable[[Mapping[str, float], float], Awaitable[None]]
"""Sends positions by actuator [rad | m], and their time [s]."""

_RATE: Final = 30.0
"""Frame rate of an array without times [Hz]: that of a webcam."""

_LONGEST: Final = 65536
"""Longest line [characters]: a frame with MediaPipe's whole output takes 10,000."""

_LARGEST: Final = 200_000_000
"""Largest file, also unpacked [bytes]: hours of frames."""

_MOST_LEFT_OUT: Final = 30
"""Most frames in a row that are left out: those of a second of a webcam."""


class Patience:
    """Leaves out single frames of a tracker that cannot be used, each in a block of its own.

    An error of one of the given classes ends a block quietly, unless it is the first block, where
    it shows a wrong layout or unit, or one of more than 30 in a row.
    """

    def __init__(self, *errors: type[UserError]) -> None:
        self._errors = errors
        self._began = False
        self._row = 0

    def __enter__(self) -> None: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        if error is None:
            self._began, self._row = True, 0
            return False
        self._row += 1
        if not (self._began and isinstance(error, self._errors) and self._row <= _MOST_LEFT_OUT):
            return False
        if self._row == 1:
            log.warning("%s; left out", error)
        return True


@dataclass(frozen=True, slots=True)
class TrackerFrame:
    """The output of a tracker at one time.

    Attributes:
        stamp: Time of the frame, by any monotonic clock [s].
        points: The points in MediaPipe's order ``(21, 3)`` [m]; ``None`` if no hand was found.
    """

    stamp: float
    points: FloatArray | None


class FrameReader:
    """Reads frames of a person's left or right hand, each from a line of JSON.

    A line has the time, ``t`` [s] or ``timestamp_ms``, and the ``points``, rows of three numbers,
    or MediaPipe's ``hand_world_landmarks`` and ``handedness``. If the points are null or empty, the
    tracker has found no hand. A line ``{"layout": …}`` names the layout, or describes it by the
    indices of its points in MediaPipe's order: ``{"order": […], "count": 25, "unit": 0.001}``.
    """

    def __init__(self, layout: Layout, side: Side, path: Path | str) -> None:
        self._layout = layout
        self._side, self._path, self._number = side, path, 0
        self._last = -math.inf

    def read(self, line: str) -> TrackerFrame | None:
        """Return the frame in a line; ``None`` if the line has none.

        Raises:
            LogError: if the line is not valid.
        """
        self._number += 1
        if not line.strip():
            return None
        try:
            if len(line) > _LONGEST:
                raise ValueError(f"it has more than {_LONGEST} characters")
            entry = json.loads(line)
            if not isinstance(entry, dict):
                raise ValueError(
                    'a frame must be an object such as {"t": 0.033, "points": [[x, y, z], …]}'
                )
            if "layout" in entry:
                self._layout = _layout(entry["layout"])
                return None
            return self._frame(entry)
        except RecursionError:
            raise self._error("it is nested too deeply") from None
        except UserError as error:
            raise self._error(error.message) from None
        except json.JSONDecodeError as error:
            raise self._error(f"it is not JSON from character {error.pos + 1} on") from None
        except ValueError as error:
            raise self._error(str(error)) from None

    def _error(self, why: str) -> LogError:
        return LogError(f"is not valid: {why}", path=self._path, line=self._number)

    def _frame(self, entry: Mapping[str, Any]) -> TrackerFrame:
        stamp = _time(entry)
        if not stamp > self._last:
            raise ValueError(f"its time, {stamp:g} s, is not later than that of the last frame")
        if "hand_world_landmarks" in entry:
            points = self._of_mediapipe(entry)
        elif "points" in entry:
            points = entry["points"] or None
        else:
            raise ValueError("it has neither 'points' nor 'hand_world_landmarks'")
        found = None if points is None else self._layout.points(points)
        self._last = stamp
        return TrackerFrame(stamp, found)

    def _of_mediapipe(self, entry: Mapping[str, Any]) -> Any:
        """Return the points of the wanted hand in a result of MediaPipe's hand landmarker."""
        try:
            found = list(entry["hand_world_landmarks"] or ())
            said = [hand[0]["category_name"].lower() for hand in entry.get("handedness") or ()]
            if said:
                found = [f for f, s in zip(found, said, strict=True) if s == self._side]
            return [[p["x"], p["y"], p["z"]] for p in found[0]] if found else None
        except (KeyError, TypeError, IndexError, AttributeError, ValueError):
            raise ValueError(
                "it is not a result of MediaPipe's hand landmarker: lists of points with x, y and "
                "z, and of handedness with a category_name"
            ) from None


def _time(entry: Mapping[str, Any]) -> float:
    for key, unit in (("t", 1.0), ("timestamp_ms", 1e-3)):
        value = entry.get(key)
        if isinstance(value, int | float) and math.isfinite(value):
            return unit * value
    raise ValueError("it has no time, 't' in seconds or 'timestamp_ms'")


def _layout(given: Any) -> Layout:
    if isinstance(given, str):
        return layout_named(given)
    try:
        order = tuple(
            (int(i),) if isinstance(i, int) else tuple(map(int, i)) for i in given["order"]
        )
        return Layout("the layout", order, int(given["count"]), float(given.get("unit", 1.0)))
    except (KeyError, TypeError, AttributeError):
        raise ValueError(
            "a layout must be a name, or an object with the 'order', 21 indices of points, their "
            "'count' and their 'unit' in metres"
        ) from None


def read_frames(path: Path, layout: Layout, side: Side) -> list[TrackerFrame]:
    """Return the frames in a file.

    A NumPy file (``.npz``) has the array ``points`` or ``joints`` ``(k, count, 3)``, and optionally
    the times ``t`` ``(k,)`` [s]; without times, it has 30 frames per second. Other files have one
    frame per line, see `FrameReader`.

    Raises:
        LogError: if the file cannot be read, or no frame has points.
    """
    reader = FrameReader(layout, side, path)
    try:
        if path.stat().st_size > _LARGEST:
            raise LogError(f"is larger than {_LARGEST // 1_000_000} MB", path=path)
        if path.suffix.lower() == ".npz":
            frames = list(_of_arrays(path, reader))
        else:
            with path.open(encoding="utf-8") as file:
                frames = [frame for line in file if (frame := reader.read(line)) is not None]
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"cannot be read: {reason(error)}", path=path) from None
    if not any(frame.points is not None for frame in frames):
        raise LogError("contains no points of a hand", path=path)
    return frames


def _of_arrays(path: Path, reader: FrameReader) -> Iterator[TrackerFrame]:
    try:
        with zipfile.ZipFile(path) as members:
            # No more is unpacked than this, whatever the headers of the arrays say.
            unpacked = sum(member.file_size for member in members.infolist())
        if unpacked > _LARGEST:
            raise LogError(f"is larger than {_LARGEST // 1_000_000} MB unpacked", path=path)
        with np.load(path, allow_pickle=False) as arrays:
            name = next((name for name in ("points", "joints") if name in arrays), None)
            if name is None:
                raise ValueError("it has no array 'points'")
            # Neither text nor complex numbers.
            points = np.asarray(arrays[name]).astype(np.float64, casting="same_kind")
            times = arrays["t"] if "t" in arrays else np.arange(len(points)) / _RATE
        if points.ndim != 3 or times.shape != points.shape[:1]:
            raise ValueError("it should have points (frames, count, 3) and times t (frames)")
    except LogError:
        raise
    except Exception as error:  # NumPy passes on those of its parsers: of zip, zlib, even tokenize
        said = reason(error).partition("\n")[0]
        raise LogError(f"cannot be read: {said}", path=path) from None
    for stamp, each in zip(times.tolist(), points, strict=True):
        # In arrays, a frame of NaN means that no hand was found.
        lost = bool(np.isnan(each).all())
        frame = reader.read(json.dumps({"t": stamp, "points": None if lost else each.tolist()}))
        if frame is not None:
            yield frame


async def due(frames: Sequence[TrackerFrame]) -> AsyncIterator[TrackerFrame]:
    """Yield recorded frames when they are due, stamped by the clock."""
    begin = monotonic.now() - frames[0].stamp
    for frame in frames:
        stamp = begin + frame.stamp
        await anyio.sleep(max(0.0, stamp - monotonic.now()))
        yield TrackerFrame(stamp, frame.points)


async def live(lines: AsyncIterable[str], reader: FrameReader) -> AsyncIterator[TrackerFrame]:
    """Yield the frames in lines as they arrive.

    Raises:
        LogError: if the first line is not valid, or more than 30 in a row; fewer are left out.
    """
    patience = Patience(LogError)
    async for line in lines:
        frame = None
        with patience:
            frame = reader.read(line)
        if frame is not None:
            yield frame


async def follow(frames: AsyncIterable[TrackerFrame], retargeter: Retargeter, send: Send) -> int:
    """Send the positions for each frame, and return how many were sent.

    Nothing is sent until a hand is found. While the hand is lost, the last positions are sent
    again. Frames that cannot be followed are left out, such as those after a jump of the clock.

    Raises:
        TrackingError: if the first points are not those of the expected hand, or more than 30 in a
            row.
        GoalRejected: if the hand refuses as many.
    """
    sent, patience = 0, Patience(TrackingError, GoalRejected)
    async for frame in frames:
        if frame.points is None and not sent:
            continue
        with patience:
            await send(retargeter.step(frame.points, frame.stamp), frame.stamp)
            sent += 1
    return sent
