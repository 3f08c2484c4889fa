"""Measure streams of set-points beside jogging and beside raw steps; print Markdown tables.

    python benchmarks/streams.py [--hand schunk_svh] [--seconds 20] [--live]

Every actuator of a hand follows a sine of 0.5 Hz, below its limits, from samples at 30 and 50 Hz
that arrive 0.5 ms and up to 0, 5 or 20 ms of jitter (uniform, in order) later, 2 % of them never.
The controller is ticked at 1 kHz without waiting, so that all methods get the same samples:

- `stream`: as `hand.stream`;
- `jog`: as `hand.jog` with each sample: a motion to a stop there, all actuators together;
- `steps`: each sample is the set-point until the next one, as of a program that sends set-points to
  devices itself; no limits.

In the second table one actuator is slowed down to a twentieth of its velocity; it shows the others.

- lag: displacement of the sine that fits best;
- amplitude: remaining amplitude;
- error: RMS after removing the lag, in per cent of the amplitude;
- jerk: RMS, in multiples of the sine's own.

`--live` also streams over the network into `rtee run`, and takes the references from the recording.
"""

from __future__ import annotations

import math
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import anyio
import numpy as np
from common import Table, command_line

import rtee
from rtee.commands import BeginStream, Command, Jog, SetActive, StreamSample
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log import read
from rtee.loop.controller import Controller
from rtee.loop.measured import Measured
from rtee.loop.settings import LoopSettings
from rtee.sample import FloatArray

TICK = 1e-3
"""Period of the loop [s]."""

FREQUENCY = 0.5
"""Frequency of the sine [Hz]: within the velocity limits of most hands."""

DELAY = 0.5e-3
"""Delay of every sample [s]: that of the network inside one computer."""

SETTLED = 4.0
"""Time before the evaluation begins [s]: the stream takes over, and learns the jitter."""

SHARE = 0.25
"""Amplitude as a share of the range, unless that needs more than half the velocity limit."""

Sine = Callable[[float], list[float]]


def sine_of(hand: Hand) -> tuple[Sine, FloatArray]:
    """Return the positions over time, and their amplitudes."""
    omega = 2.0 * math.pi * FREQUENCY
    centre, amplitude = [], []
    for spec in hand.actuators:
        low, high = max(spec.lower, -math.pi), min(spec.upper, math.pi)
        centre.append(0.5 * (low + high))
        # Far enough below the limits that only the way of sending limits the motion.
        most = min(0.5 * spec.velocity / omega, 0.25 * spec.acceleration / omega**2)
        amplitude.append(min(SHARE * (high - low), most))

    def at(t: float) -> list[float]:
        s = math.sin(omega * t)
        return [c + a * s for c, a in zip(centre, amplitude, strict=True)]

    return at, np.array(amplitude)


def samples(rate: float, seconds: float, jitter: float, loss: float) -> list[tuple[float, float]]:
    """Return stamps and arrivals of the samples [s]."""
    chance, last, found = random.Random(7), 0.0, []
    for k in range(round(seconds * rate)):
        stamp = 0.1 + k / rate
        # In order, as over TCP: a sample waits for the one before it.
        arrival = last = max(last, stamp + DELAY + chance.uniform(0.0, jitter))
        if chance.random() >= loss:
            found.append((stamp, arrival))
    return found


def played(
    hand: Hand, at: Sine, way: str, rate: float, seconds: float, found: list[tuple[float, float]]
) -> FloatArray:
    """Return the references at every tick."""
    names = hand.actuator_names
    unknown = [math.nan] * len(names)
    positions = at(0.0)
    controller = Controller(hand, LoopSettings())
    controller.apply(SetActive(dict.fromkeys(names, True)), 0.0)
    controller.apply(BeginStream("s", rate, 0.1), 0.0)
    rows, waiting = [], iter(found)
    next_one = next(waiting, None)
    for k in range(round(seconds / TICK)):
        now = k * TICK
        while next_one is not None and next_one[1] <= now:
            stamp, arrival = next_one
            positions = at(stamp)
            to = dict(zip(names, positions, strict=True))
            command: Command = Jog(to)
            if way == "stream":
                without = dict.fromkeys(names, math.nan)
                # The client's clock is another one, 10,000 s behind: the offset must not matter.
                command = StreamSample("s", stamp - 1e4, arrival, to, {}, to, without)
            if way != "steps":
                controller.apply(command, now)
            next_one = next(waiting, None)
        if way == "steps":
            rows.append(positions)
            continue
        here = list(controller.reference_position) if k else at(0.0)
        grasped, fresh = [-1] * len(names), [True] * len(names)
        controller.step(now, Measured(here, unknown, unknown, fresh, grasped))
        # Emptied as the loop does; it would grow for the whole run.
        controller.outbox.items.clear()
        rows.append(list(controller.reference_position))
    return np.array(rows)


def figures(
    times: FloatArray, found: FloatArray, at: Sine, amplitude: FloatArray, columns: list[int]
) -> tuple[str, ...]:
    """Return lag, amplitude, error and jerk in words, each the worst of some actuators."""
    kept = times > SETTLED
    t, omega = times[kept], 2.0 * math.pi * FREQUENCY
    lags, shares, errors, jerks = [], [], [], []
    for i in columns:
        values = found[kept, i]
        # The best sine by least squares: its phase is the lag, its amplitude what is left.
        basis = np.stack([np.sin(omega * t), np.cos(omega * t), np.ones_like(t)], axis=1)
        sine, cosine, _ = np.linalg.lstsq(basis, values, rcond=None)[0]
        lags.append((-math.atan2(cosine, sine) / omega) % (1.0 / FREQUENCY))
        shares.append(math.hypot(sine, cosine) / amplitude[i])
        meant = at(0.0)[i] + amplitude[i] * np.sin(omega * (t - lags[-1]))
        errors.append(float(np.sqrt(np.mean((values - meant) ** 2))) / amplitude[i])
        # The sine's own jerk has an RMS of amplitude · ω³ / √2, the unit of this column.
        third = np.diff(values, 3) / TICK**3
        jerks.append(float(np.sqrt(np.mean(third**2))) * math.sqrt(2) / (amplitude[i] * omega**3))
    return (
        f"{max(lags) * 1e3:.1f} ms",
        f"{min(shares) * 100:.1f} %",
        f"{max(errors) * 100:.2f} %",
        f"{max(jerks):.3g}",
    )


HEAD = ("samples", "jitter", "lost", "way", "lag", "amplitude", "error", "jerk")


def simulated(hand: Hand, seconds: float) -> None:
    """Print the figures for samples of all rates, with all disturbances, by all methods."""
    at, amplitude = sine_of(hand)
    everyone = list(range(len(hand.actuators)))
    table = Table(*HEAD)
    for rate in (30.0, 50.0):
        for jitter, loss in ((0.0, 0.0), (5e-3, 0.0), (20e-3, 0.0), (20e-3, 0.02)):
            sent = samples(rate, seconds, jitter, loss)
            for way in ("stream", "jog", "steps"):
                found = played(hand, at, way, rate, seconds, sent)
                times = np.arange(len(found)) * TICK
                words = figures(times, found, at, amplitude, everyone)
                how = (f"{rate:g} Hz", f"{jitter * 1e3:g} ms", f"{loss:.0%}", way)
                table.row(*how, *words)


def slowed(hand: Hand, seconds: float) -> None:
    """Print the figures of the other actuators beside one that is too slow."""
    at, amplitude = sine_of(hand)
    first, *others = hand.actuators
    specs = (replace(first, velocity=first.velocity / 20.0), *others)
    slow = replace(hand, actuators=specs)
    table = Table("way", "lag", "amplitude", "error", "jerk")
    sent = samples(50.0, seconds, 0.0, 0.0)
    assert specs[0].velocity < 2.0 * math.pi * FREQUENCY * amplitude[0]
    for way in ("stream", "jog"):
        # The same sine as before, which the first actuator cannot follow.
        found = played(slow, at, way, 50.0, seconds, sent)
        times = np.arange(len(found)) * TICK
        columns = list(range(1, len(hand.actuators)))
        table.row(way, *figures(times, found, at, amplitude, columns))


async def streamed(name: str, seconds: float, rate: float, jitter: float) -> None:
    """Stream the sine over the network, its stamps from this computer's clock."""
    at, _ = sine_of(load_hand(name))
    chance = random.Random(3)
    async with (
        rtee.connect(name, wait=30.0) as hand,
        hand.stream(rate=rate, deadline=0.3) as stream,
    ):
        names = [actuator.name for actuator in (await hand.info()).actuators]
        begin = time.monotonic()
        for k in range(round(seconds * rate)):
            stamp = begin + k / rate
            await anyio.sleep(max(0.0, stamp + chance.uniform(0.0, jitter) - time.monotonic()))
            await stream.send(dict(zip(names, at(k / rate), strict=True)), stamp=stamp)
        status = await stream.status()
        print(
            f"<!-- {status.samples} samples, lag {status.lag * 1e3:.1f} ms, jitter "
            f"{status.jitter * 1e3:.2f} ms, late {status.late}, pauses {status.pauses} -->"
        )


def live(name: str, seconds: float) -> None:
    """Print the figures of a stream over the network, from the recording."""
    hand = load_hand(name)
    at, amplitude = sine_of(hand)
    table = Table("samples", "jitter", "lag", "amplitude", "error", "jerk")
    for rate, jitter in ((50.0, 0.0), (50.0, 5e-3), (30.0, 0.0)):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "rtee", "run", name, "--realtime", "--log", folder]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            try:
                anyio.run(streamed, name, seconds, rate, jitter)
            finally:
                process.terminate()
                process.wait(20)
            recording = read(Path(folder))
        first = recording.stream_samples[0].value.command
        assert isinstance(first, StreamSample)
        times = recording.actuator_states.time - first.stamp
        within = times < seconds
        found = recording.reference.position
        words = figures(
            times[within], found[within], at, amplitude, list(range(len(hand.actuators)))
        )
        table.row(f"{rate:g} Hz", f"{jitter * 1e3:g} ms", *words)


def main() -> None:
    parser = command_line(__doc__, hand="schunk_svh", seconds=20.0, live=False)
    given = parser.parse_args()
    hand = load_hand(given.hand)
    simulated(hand, given.seconds)
    print()
    slowed(hand, given.seconds)
    if given.live:
        print()
        live(given.hand, given.seconds)


if __name__ == "__main__":
    main()
