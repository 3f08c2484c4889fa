"""Settings and status of the recorder: plain data without pydantic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtee.hand.config_schema import LogSection


@dataclass(frozen=True, slots=True)
class RecorderSettings(LogSection):
    """How a hand is recorded: as hand.yaml says, and some settings that it does not have.

    Attributes:
        flight_size: Memory that the flight recorder may take [bytes].
        chunk_time: A chunk is written after this time [s]; what a killed process loses.
        queue_time: Ticks that may wait for the writer, as time [s]; more are dropped and counted.
        sync: Flush every chunk to the disk, so that it also survives a power cut.
        level: Level of zstd compression.
    """

    flight_size: float = 64e6
    chunk_time: float = 0.5
    queue_time: float = 5.0
    sync: bool = True
    level: int = 3

    @property
    def part_size(self) -> float:
        """Size at which a file is followed by the next part, so that old ones can make room."""
        return min(self.max_file_size, self.max_total_size / 4)


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """How the recorder is doing.

    Attributes:
        recording: A recording is being written, or will be as soon as the disk takes it.
        path: The file that is written, ``None`` if none is.
        size: Its size [bytes].
        ticks: Ticks written to the disk.
        dropped: Records dropped because the writer fell behind.
        lost: Ticks lost because the disk did not take them.
        problem: Why the disk does not take them now, empty if it does.
        flight_seconds: What the flight recorder holds [s].
        flight_files: Files that the flight recorder has written, the last ones.
    """

    recording: bool = False
    path: Path | None = None
    size: int = 0
    ticks: int = 0
    dropped: int = 0
    lost: int = 0
    problem: str = ""
    flight_seconds: float = 0.0
    flight_files: tuple[Path, ...] = ()

    @property
    def trouble(self) -> str:
        """What is not recorded and why, in words; empty if everything is."""
        words = []
        if self.recording and self.problem:
            words.append(f"not written: {self.problem}")
        if self.lost:
            words.append(f"{self.lost} ticks lost because the disk did not take them")
        if self.dropped:
            words.append(f"{self.dropped} records dropped because the disk was too slow")
        return "; ".join(words)
