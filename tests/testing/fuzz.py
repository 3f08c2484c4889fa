"""Random and mutated frames for decoders: nothing may break them, nothing may make them grow."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

_MOST = 8
"""Failures after which a trial ends, and good frames that are tried until one is found."""


@dataclass(frozen=True)
class Decoder:
    """A decoder and how to try it: a parser of a stream, or a function on one frame.

    Attributes:
        name: Its name.
        samples: Good frames.
        parser: Makes a parser with ``feed(bytes) -> list`` and ``pending``; else `decode` is tried.
        decode: Decodes one frame.
        errors: What `decode` may raise.
        limit: Most bytes that the parser may keep.
        prefix: Bytes that random frames begin with, so that they get beyond the first check.
        lost: Good frames that garbage before them may cost: one, unless a length in the garbage
            may span several.
    """

    name: str
    samples: Sequence[bytes]
    parser: Callable[[], Any] | None = None
    decode: Callable[[bytes], object] | None = None
    errors: tuple[type[Exception], ...] = ()
    limit: int = 600
    prefix: bytes = b""
    lost: int = 1


@dataclass
class Fuzzed:
    """What came of it.

    Attributes:
        frames: Frames tried.
        accepted: Frames decoded, good ones included.
        rejected: Frames refused by the decoder's own error.
        kept: Most bytes kept by the parser.
        lost: Most good frames that were lost in a row after garbage.
        failures: What should not have happened, with the bytes.
    """

    frames: int = 0
    accepted: int = 0
    rejected: int = 0
    kept: int = 0
    lost: int = 0
    failures: list[str] = field(default_factory=list)


def mutated(sample: bytes, chance: random.Random, prefix: bytes = b"") -> bytes:
    """Return a damaged frame: nearly a good one, or noise."""
    kind = chance.randrange(6)
    if kind == 0:
        return prefix + chance.randbytes(chance.randrange(80))
    data = bytearray(sample)
    if kind == 1:
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == 2:
        del data[chance.randrange(len(data)) :]
    elif kind == 3:
        at = chance.randrange(len(data) + 1)
        data[at:at] = chance.randbytes(chance.randint(1, 6))
    elif kind == 4:
        data[chance.randrange(len(data))] = chance.choice((0, 0xFF, 0x7F, 0x80))
    else:
        start = chance.randrange(len(data))
        data += data[start:]
    return bytes(data)


def fuzz(decoder: Decoder, frames: int, seed: int = 0) -> Fuzzed:
    """Try a decoder with so many frames, and return what came of it."""
    chance = random.Random(seed)
    found = Fuzzed()
    trial = _try_parser if decoder.parser is not None else _try_function
    trial(decoder, frames, chance, found)
    return found


def _try_function(decoder: Decoder, frames: int, chance: random.Random, found: Fuzzed) -> None:
    decode = decoder.decode
    if decode is None:
        raise ValueError(f"{decoder.name} has neither a parser nor a function")
    for _ in range(frames):
        data = mutated(chance.choice(decoder.samples), chance, decoder.prefix)
        found.frames += 1
        try:
            decode(data)
            found.accepted += 1
        except decoder.errors:
            found.rejected += 1
        except Exception as error:
            found.failures.append(f"{type(error).__name__}: {error} ({data.hex(' ')})")
            if len(found.failures) >= _MOST:
                return


def _try_parser(decoder: Decoder, frames: int, chance: random.Random, found: Fuzzed) -> None:
    make = decoder.parser
    if make is None:
        return
    parser = make()
    while found.frames < frames and len(found.failures) < _MOST:
        burst = [
            mutated(chance.choice(decoder.samples), chance, decoder.prefix)
            for _ in range(chance.randint(1, 8))
        ]
        found.frames += len(burst)
        try:
            for data in burst:
                found.accepted += len(parser.feed(data))
                found.kept = max(found.kept, parser.pending)
            lost = _resynchronised(parser, chance.choice(decoder.samples))
        except Exception as error:
            found.failures.append(f"{type(error).__name__}: {error} ({burst[-1].hex(' ')})")
            parser = make()
            continue
        found.accepted += 1
        found.lost = max(found.lost, lost)
        if lost > decoder.lost:
            found.failures.append(f"{lost} good frames were lost after {burst[-1].hex(' ')}")
            parser = make()
        if parser.pending > decoder.limit:
            found.failures.append(f"{parser.pending} bytes are kept")
            parser = make()


def _resynchronised(parser: Any, good: bytes) -> int:
    """Return how many good frames were lost before one was found."""
    for lost in range(_MOST):
        if parser.feed(good):
            return lost
    return _MOST
