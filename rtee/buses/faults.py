"""Injected faults of a wire."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class Faults:
    """Faults of a wire, each with its probability per message and direction.

    Attributes:
        drop: Probability that a message is lost.
        corrupt: Probability that one to three of its bits are flipped.
        duplicate: Probability that it arrives twice.
        delay: Probability that it arrives ``delay_time`` later.
        split: Probability that it arrives in two pieces, ``split_time`` apart.
        noise: Probability that one to eight random bytes arrive before it.
        delay_time: Delay of a late message [s].
        split_time: Time between the two pieces of a message [s].
        requests: Whether the faults affect messages to the device, too, or only its answers.
        seed: Seed of the random numbers.
        injected: Number of faults so far, by name.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0
    split: float = 0.0
    noise: float = 0.0
    delay_time: float = 0.02
    split_time: float = 0.002
    requests: bool = True
    seed: int = 0
    injected: Counter[str] = field(default_factory=Counter)
    _random: random.Random = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)  # noqa: S311 - faults, not secrets

    @property
    def active(self) -> bool:
        """Whether any fault is possible."""
        return (
            self.drop + self.corrupt + self.duplicate + self.delay + self.split + self.noise
        ) > 0.0

    def apply(self, data: bytes) -> list[tuple[float, bytes]]:
        """Return the pieces in which a message arrives, each with its extra delay [s]."""
        if not self.active:
            return [(0.0, data)]
        if self._happens("drop", self.drop):
            return []
        if data and self._happens("corrupt", self.corrupt):
            data = self._flipped(data)
        late = self.delay_time if self._happens("delay", self.delay) else 0.0
        pieces = [(late, data)]
        if len(data) > 1 and self._happens("split", self.split):
            # Both pieces have at least one byte.
            cut = self._random.randrange(1, len(data))
            pieces = [(late, data[:cut]), (late + self.split_time, data[cut:])]
        if self._happens("noise", self.noise):
            pieces.insert(0, (late, self._random.randbytes(self._random.randint(1, 8))))
        if self._happens("duplicate", self.duplicate):
            pieces.append((pieces[-1][0], data))
        return pieces

    def lost(self) -> bool:
        """Return whether a CAN frame is lost: CAN controllers drop corrupted frames, too."""
        return self._happens("drop", self.drop) or self._happens("corrupt", self.corrupt)

    def copies(self) -> list[float]:
        """Return the extra delay of each copy of a CAN frame that arrives [s]."""
        if self.lost():
            return []
        late = self.delay_time if self._happens("delay", self.delay) else 0.0
        return [late, late] if self._happens("duplicate", self.duplicate) else [late]

    def _happens(self, name: str, probability: float) -> bool:
        if probability <= 0.0 or self._random.random() >= probability:
            return False
        self.injected[name] += 1
        return True

    def _flipped(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self._random.randint(1, 3)):
            changed[self._random.randrange(len(changed))] ^= 1 << self._random.randrange(8)
        # Two flips of the same bit cancel out, but "corrupt" must change the message.
        return bytes(changed) if bytes(changed) != data else bytes([data[0] ^ 1]) + data[1:]
