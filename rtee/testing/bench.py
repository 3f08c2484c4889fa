"""The devices of a hand under test: the test controls cables, objects and faults.

`main` is the process that `rtee.testing.running.running_hand` starts: it runs the hand, and obeys
the lines that come over a socket, one after the other. When the socket is closed, the hand comes to
rest and ends, as it does by Ctrl-C.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import anyio
import anyio.abc
import anyio.to_thread

from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.buses.simulated import Simulation
from rtee.drivers.objects import ObjectInHand, grasping
from rtee.errors import ConfigError, RteeError, suggestion
from rtee.loop.handloop import HandLoop
from rtee.loop.realtime import backend_options
from rtee.running.prepare import RunOptions
from rtee.running.run import run_hands

_DO: Final[dict[str, Callable[[Simulation, Emulator, str], None]]] = {
    "unplug": lambda wire, _, __: wire.unplug(),
    "plug": lambda wire, _, __: wire.replug(),
    "place": lambda _, device, text: grasping(device).place_object(ObjectInHand.parse(text)),
    "take_away": lambda _, device, __: grasping(device).remove_object(),
    "fault": lambda _, device, name: device.inject(name),
    "clear": lambda _, device, __: device.clear(),
}
"""Operations on an emulated device, with one word of detail."""


class EmulatedDevices(ABC):
    """The emulated devices of a hand, which a test unplugs, fills and breaks.

    An operation on one device, or on all, is done when a method returns; the hand takes a moment to
    notice. All raise `ConfigError` if a device is not emulated, or cannot do that.
    """

    @abstractmethod
    def _act(self, what: str, detail: str, device: str | None) -> None:
        """Apply an operation of `_DO` to a device, or to all."""

    def unplug(self, device: str | None = None) -> None:
        """Unplug the cable."""
        self._act("unplug", "", device)

    def plug(self, device: str | None = None) -> None:
        """Plug the cable in again."""
        self._act("plug", "", device)

    def place(self, object: str, device: str | None = None) -> None:  # noqa: A002 - as elsewhere
        """Put an object between the fingers, as for ``rtee run --object``."""
        self._act("place", object, device)

    def take_away(self, device: str | None = None) -> None:
        """Pull the object out of the fingers."""
        self._act("take_away", "", device)

    def fault(self, name: str, device: str | None = None) -> None:
        """Inject a fault, as ``rtee emulate --fault`` does."""
        self._act("fault", name, device)

    def clear(self, device: str | None = None) -> None:
        """Clear all faults."""
        self._act("clear", "", device)


class Bench:
    """The test's side: operates the emulated devices of a running hand.

    Args:
        line: The socket to the hand's process.
    """

    def __init__(self, line: socket.socket) -> None:
        self._line, self._answers = line, line.makefile("r", encoding="utf-8")

    def do(self, what: str, detail: str = "", device: str | None = None) -> None:
        """Apply an operation to a device, or to all; return when it is done.

        Raises:
            ConfigError: if the device cannot do that, or is not emulated.
            RteeError: if the hand has ended.
        """
        try:
            self._line.sendall(f"{json.dumps([what, detail, device])}\n".encode())
            answer = self._answers.readline()
        except OSError:
            answer = ""
        if not answer:
            raise RteeError("the hand under test has ended")
        if (mistake := json.loads(answer)) is not None:
            raise ConfigError(mistake)

    def close(self) -> None:
        """Let the hand come to rest and end."""
        self._answers.close()
        self._line.close()


def main(words: Sequence[str]) -> int:
    """Run a hand until the socket closes; return the exit status of ``rtee run``.

    Args:
        words: Number of the socket's descriptor; the hand; the folder of the recordings; the
            driver, empty: emulated devices; the object in the hand, or nothing.
    """
    number, hand, folder, driver, *held = words
    line = socket.socket(fileno=int(number))
    simulated = driver == "mujoco"
    options = RunOptions(
        driver=driver or "devices",
        emulated=not driver,
        # Without wear and noise, since the tests of an application compare numbers.
        ideal=not driver,
        home=not driver,
        log=Path(folder),
        object_in_hand=held[0] if held and not simulated else None,
        driver_options={"object": held[0]} if held and simulated else {},
    )

    def say(text: str) -> None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()

    async def obey(pool: BusPool, loops: Sequence[HandLoop]) -> None:
        file = line.makefile("r", encoding="utf-8")
        # A thread that waits for the test may be left behind.
        while text := await anyio.to_thread.run_sync(file.readline, abandon_on_cancel=True):
            try:
                what, detail, device = json.loads(text)
                act(pool, loops, what, detail, device)
                answer = None
            except RteeError as error:
                answer = str(error)
            line.sendall(f"{json.dumps(answer)}\n".encode())
        os.kill(os.getpid(), signal.SIGINT)

    async def run() -> int:
        return await run_hands([hand], options, say=say, beside=obey)

    try:
        return anyio.run(run, backend_options=backend_options())
    except RteeError as error:
        say(f"rtee: {error}")
        return error.exit_status


def act(
    pool: BusPool, loops: Sequence[HandLoop], what: str, detail: str, device: str | None
) -> None:
    """Apply an operation to an emulated device, or to all.

    Raises:
        ConfigError: if the device cannot do that, or is not emulated.
    """
    for wire, emulator in _chosen(pool, loops, device):
        wire.call(partial(_DO[what], wire, emulator, detail))


def _chosen(
    pool: BusPool, loops: Sequence[HandLoop], name: str | None
) -> Iterator[tuple[Simulation, Emulator]]:
    """Yield wire and emulator of a device, or of all."""
    specs = {device: found.driver.spec for loop in loops for device, found in loop.devices.items()}
    if name is not None and name not in specs:
        raise ConfigError(f"there is no device '{name}'; {suggestion(name, specs)}")
    for device in specs if name is None else [name]:
        owner = specs[device].owner
        try:
            yield pool.simulation(owner), pool.played(owner)
        except KeyError:
            raise ConfigError(
                f"the device '{device}' is not emulated (driver {specs[device].driver})"
            ) from None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
