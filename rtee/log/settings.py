"""Settings and status of the recorder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtee.hand.config_schema import LogSection


class RecorderSettings(LogSection, frozen=True):
    """Settings of the recorder: those of its section in hand.yaml, and some fixed ones.

    Attributes:
        flight_size: Largest memory of the flight recorder [bytes].
        chunk_time: Time after which a chunk is written [s]; a killed process loses as much.
        queue_time: Length of the queue for the writer, as time [s]; further ticks are dropped.
        sync: Flush every chunk to the disk, so that it survives a power cut.
        level: Level of zstd compression.
    """

    flight_size: float = 64e6
    chunk_time: float = 0.5
    queue_time: float = 5.0
    sync: bool = True
    level: int = 3

    @property
    def part_size(self) -> float:
        """Size of a file from which the next part begins [bytes], so that old parts can go."""
        return min(self.max_file_size, self.max_total_size / 4)


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """Status of the recorder.

    Attributes:
        recording: Whether a recording is being written, or will be once the disk accepts it.
        path: The file being written, or ``None``.
        size: Size of the file [bytes].
        ticks: Number of ticks written to the disk.
        dropped: Number of records dropped because the writer fell behind.
        lost: Number of ticks lost because the disk refused them.
        problem: Reason for which the disk refuses chunks now; empty if it accepts them.
        flight_seconds: Length of the flight recorder's memory [s].
        flight_files: The last files that the flight recorder wrote.
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
    def keeps(self) -> bool:
        """Whether messages are kept at present: on the disk, or in the flight recorder."""
        return not self.problem and (self.recording or self.flight_seconds > 0.0)

    @property
    def trouble(self) -> str:
        """Sentence on the data that is not recorded, and why; empty if all data is."""
        words = []
        if self.recording and self.problem:
            words.append(f"not written: {self.problem}")
        if self.lost:
            words.append(f"{self.lost} ticks lost because the disk did not take them")
        if self.dropped:
            words.append(f"{self.dropped} records dropped because the disk was too slow")
        return "; ".join(words)
