"""Files of recordings on the disk: parts, failures, and the limit of their disk space."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from rtee.hand.files import reason
from rtee.log.chunks import PackedChunk
from rtee.log.layout import STATE, Contents
from rtee.log.mcapfile import McapFile
from rtee.log.rotation import (
    FLIGHT,
    Retention,
    being_written,
    flight_path,
    next_run,
    part_path,
    session_name,
)
from rtee.log.settings import RecorderSettings
from rtee.monotonic import asked

_NAME_TRIES = 50  # most names tried, as runs may have begun in the same millisecond
_PARTIAL = ".partial"
_LOOK_EVERY = 60.0  # time between checks of the folder's size [s]: others seldom write into it


class DiskSink:
    """Writes chunks to the parts of a recording.

    Chunks that the disk refuses are lost. Each new chunk is tried, so that recording goes on as
    soon as there is space. The times of parts are by the clock ``monotonic`` [s].

    Attributes:
        wanted: Whether a recording should be written.
        problem: Reason for which the last chunk could not be written; empty if it was.
        written_ticks: Number of ticks written.
        lost_ticks: Number of ticks lost.
    """

    def __init__(
        self, contents: Contents, settings: RecorderSettings, monotonic: Callable[[], float] = asked
    ) -> None:
        self._contents = contents
        self._settings = settings
        self._monotonic = monotonic
        self._file: McapFile | None = None
        self._session = ""
        self._part = 0
        self._opened = 0.0
        self._looked = 0.0
        self._run = 0
        self._retention = Retention(settings, contents.hand.name)
        self.wanted = False
        self.begun = False  # whether the next file needs a state of the controller
        self._state = b""
        self.problem = ""
        self.written_ticks = 0
        self.lost_ticks = 0

    @property
    def path(self) -> Path | None:
        """The file being written, or ``None``."""
        return self._file.path if self._file else None

    @property
    def size(self) -> int:
        """Size of the file being written [bytes]."""
        return self._file.size if self._file else 0

    def start(self, wall_ns: int) -> None:
        """Begin a recording at a time [ns since 1970].

        Raises `OSError` if its first file cannot be made; the next chunk tries again.
        """
        if self.wanted:
            return
        # Before the file is made, which may fail: each later chunk then tries again.
        self.wanted = self.begun = True
        self._session = session_name(wall_ns)
        self._run = next_run(self._settings)
        self._part = 0
        self._open(wall_ns)

    def stop(self) -> None:
        """End the recording and close its file."""
        self.wanted = False
        self._close()
        self.problem = ""

    def _open(self, wall_ns: int) -> None:
        folder = self._settings.folder
        folder.mkdir(parents=True, exist_ok=True)
        hand = self._contents.hand.name
        for partial in folder.glob(f".{hand}_*_{FLIGHT}.mcap{_PARTIAL}"):
            if not being_written(partial):  # left behind by a process that was killed
                partial.unlink(missing_ok=True)
        for _ in range(_NAME_TRIES):
            path = part_path(folder, hand, self._session, self._part)
            preamble = self._contents.preamble(
                wall_ns, session=self._session, part=str(self._part), run=str(self._run)
            )
            try:
                file = McapFile(path, preamble, sync=self._settings.sync)
            except FileExistsError:
                if self._part == 0:
                    # Try the next millisecond, the resolution of the names.
                    wall_ns += 1_000_000
                    self._session = session_name(wall_ns)
                else:
                    self._part += 1
                continue
            break
        else:
            raise FileExistsError(f"no free name for a recording of '{hand}'")
        self._file = file
        self._part += 1
        self._opened = self._monotonic()
        self._make_room(look=True)

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            self.begun = True
            # Without its summary the file is still readable up to its last chunk.
            with contextlib.suppress(OSError):
                file.close()

    def _make_room(self, *, look: bool) -> None:
        now = self._monotonic()
        current = (self._file.path,) if self._file else ()
        if look or now - self._looked > _LOOK_EVERY:
            self._retention.look(*current)
            self._looked = now
        self._retention.keep_within(self.size, self._session, *current)

    def write(self, chunk: PackedChunk, ticks: int) -> None:
        """Write a chunk with a number of ticks, or lose it and note the problem."""
        if not self.wanted:
            return
        try:
            # A removed file would go on filling the disk without a name.
            if self._file is not None and not self._file.linked:
                self._close()
            if self._file is None:
                self._open(chunk.start)
            assert self._file is not None  # noqa: S101 - narrows the type
            if self._retention.short():
                self._make_room(look=False)
                if self._retention.short():
                    kept = f"{self._settings.reserve / 1e9:g} GB"
                    raise OSError(
                        errno.ENOSPC,
                        f"less than {kept} of the disk are free; log.reserve keeps that much",
                    )
            if not self._file.end:
                # With the first chunk instead of at the opening: a file without ticks stays small.
                self._file.write(self._contents.description(chunk.start))
            if self._state:
                self._file.attach(STATE, self._state)
                self._state = b""
            self._file.write(chunk)
        except OSError as error:
            self.problem = reason(error)
            self.lost_ticks += ticks
            return
        self.problem = ""
        self.written_ticks += ticks
        full = self._file.size >= self._settings.part_size
        if full or self._monotonic() - self._opened >= self._settings.max_file_time:
            self._close()
        # The size of a part that was just closed counts from now on. A folder that has vanished is
        # reported, or made again, with the next chunk.
        with contextlib.suppress(OSError):
            self._make_room(look=full)

    def attach(self, state: bytes) -> None:
        """Attach a state of the controller to the file, with its next chunk."""
        self._state = state

    def write_flight(self, chunks: tuple[PackedChunk, ...], wall_ns: int, cause: str) -> Path:
        """Write the flight recorder's chunks to a file and return it.

        There is at least one chunk; the time is that of the fault [ns since 1970], ``cause``
        describes it. Raises `OSError` if the file cannot be written; nothing is left of it.
        """
        settings = self._settings
        path = flight_path(settings.folder, self._contents.hand.name, session_name(wall_ns))
        # Hidden until it is complete, so that no program reads half a file.
        partial = path.with_name(f".{path.name}{_PARTIAL}")
        run = self._run or next_run(settings)
        preamble = self._contents.preamble(chunks[0].start, cause=cause, run=str(run))
        try:
            settings.folder.mkdir(parents=True, exist_ok=True)
            # A file that a killed process left here would make `McapFile` fail.
            partial.unlink(missing_ok=True)
            file = McapFile(partial, preamble, sync=False)
            try:
                file.write(self._contents.description(chunks[0].start))
                for chunk in chunks:
                    file.write(chunk)
            finally:
                file.close()
            os.replace(partial, path)
        except OSError:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise
        with contextlib.suppress(OSError):
            self._make_room(look=True)
        return path
