"""`rtee doctor`, `rtee locate` and `rtee calibrate`: check, find and calibrate a hand's devices."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer

from rtee.cli._common import (
    EmulatedOption,
    Hand,
    IdealOption,
    JsonOption,
    actions_of,
    complete_hand,
    hand_folder,
    owned,
    to_json,
    with_hand,
)
from rtee.drivers.diagnosis.checks import Verdict, ok, wrong
from rtee.errors import (
    BusBusy,
    ConfigError,
    DeviceFault,
    GoalRejected,
    RemoteError,
    RequestRejected,
    RteeError,
    suggestion,
)
from rtee.hand.catalog import FILE_NAME
from rtee.hand.files import write_atomically
from rtee.hand.own_copy import own_place
from rtee.hand.yamlfile import parse_yaml, read_text
from rtee.units import LENGTH, quantity

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.openings import OpeningTable
    from rtee.actions.types import Action
    from rtee.deploy.needs import Needs
    from rtee.drivers.diagnosis.checks import Check
    from rtee.remote.client import RemoteHand
    from rtee.types import DeviceSpec, DeviceStatus


T = TypeVar("T")

DeviceOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="One device of the hand; by default all.")
]

_MODEL = "the hand"
"""Heading of the checks of the model; no device can have this name."""


def _devices_of(
    name: str, only: str | None, emulated: bool, ideal: bool = False
) -> list[DeviceSpec]:
    """Return the devices of a hand, or only the one named; raise `UserError` if there is none."""
    from rtee.running.run import RunOptions, prepare

    prepared = prepare(name, RunOptions(driver="devices", emulated=emulated, ideal=ideal))
    specs = [device.spec for device in prepared.devices]
    if only is None:
        return specs
    chosen = [spec for spec in specs if spec.name == only]
    if not chosen:
        names = [spec.name for spec in specs]
        raise ConfigError(f"hand '{name}' has no device '{only}'; {suggestion(only, names)}")
    return chosen


def _finished(work: Coroutine[Any, Any, T], *, simulated: bool) -> T:
    """Run work and return its result; in simulated time if the devices are emulated."""
    from rtee.buses.simulated_time import SimulatedTimeLoop

    with asyncio.Runner(loop_factory=SimulatedTimeLoop if simulated else None) as runner:
        return runner.run(work)


@contextmanager
def _naming_the_hand(hand: str) -> Iterator[None]:
    """Say of a port in use that the hand has it, if it runs: the doctor would only ask that."""
    try:
        yield
    except BusBusy as error:
        name = _running(hand)
        if name is None:
            raise
        raise BusBusy(error.bus, f"the running hand '{name}' has it open; end it first") from error


def _with_options(spec: DeviceSpec, **options: Any) -> DeviceSpec:
    """Return a device with some of its options replaced; ``None`` removes one."""
    merged = {**spec.options, **options}
    return replace(spec, options={k: v for k, v in merged.items() if v is not None})


def doctor(
    hand: Annotated[str | None, typer.Argument(autocompletion=complete_hand)] = None,
    *,
    device: DeviceOption = None,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    first_contact: bool = False,
    out: Path | None = None,
    files: Path | None = None,
    ros2: bool = False,
    as_json: JsonOption = False,
) -> None:
    """Check this computer and a hand's devices; each line is ok, or says what to type.

    Arguments and options:
        hand ([HAND]): Name of a hand, or its folder; without it only this computer is checked.
        device (NAME): With HAND: only this one of its devices; by default all.
        emulated: With HAND: talk to emulators instead of the real devices.
        first_contact: With HAND: lead through the first hour with a real device: it asks, moves
            little by little, and writes a report.
        out (DIR): With --first-contact: folder of the report; by default logs/.
        files (DIR): Without HAND: only write the files for a robot PC: udev rule, limits, service.
        ros2: Without --files or --first-contact: also check the ROS 2 graph: which nodes cannot
            hear each other.
        as_json (--json): Without --files or --first-contact: print one JSON object.
    """
    if files is not None:
        from rtee.deploy.files import write_files

        for path in write_files(files):
            print(path)
        return

    if first_contact:
        assert hand is not None  # noqa: S101 - its help says so, and is obeyed
        raise typer.Exit(_first_contact(_devices_of(hand, device, emulated, ideal), out))

    from rtee.buses.pool import BusPool
    from rtee.cli.secure import checks as check_certificates
    from rtee.drivers.diagnosis.device import check_device
    from rtee.drivers.diagnosis.machine import check_machine
    from rtee.drivers.diagnosis.model import check_model, has_devices

    async def execute() -> dict[str, list[Check]]:
        results = {"computer": check_machine()}
        if hand:
            results[_MODEL] = check_model(hand)
        # Services are those of systemd, which only Linux has.
        if hand and sys.platform.startswith("linux"):
            checks, service = _service(hand)
            results["computer"] += checks
            if certificates := check_certificates(hand, service):
                results["network"] = certificates
        if ros2:
            results["ROS 2"] = await _graph(hand)
        name = _running(hand) if hand and not emulated else None
        if name is not None:
            # It owns its ports: a second program would only disturb it.
            results |= await _asked(name, device)
        # A hand without devices is not a mistake, unless the user names one of them.
        elif hand and (device is not None or has_devices(hand)):
            async with BusPool() as pool:
                for spec in _devices_of(hand, device, emulated, ideal):
                    results[spec.name] = await check_device(spec, pool)
        return results

    results = _finished(execute(), simulated=emulated and not ros2)
    if as_json:
        print(to_json({k: [asdict(c) for c in v] for k, v in results.items()}, indent=2))
    else:
        for name, checks in results.items():
            _print(name, checks)
    wrong = any(check.verdict is Verdict.WRONG for checks in results.values() for check in checks)
    raise typer.Exit(1 if wrong else 0)


def _first_contact(specs: list[DeviceSpec], out: Path | None) -> int:
    """Go through the first contact with each device; return the exit status."""
    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis.contact_report import Conclusion, ContactQuestion
    from rtee.drivers.diagnosis.first_contact import ContactGuide
    from rtee.drivers.registry import find_driver
    from rtee.log.first_contact import write

    async def ask(question: ContactQuestion) -> str:
        tail = {"yes": " [y/n] ", "number": " ", "enter": " "}[question.kind]
        try:
            # In a thread: the driver goes on reading while a person thinks.
            return await asyncio.to_thread(input, f"\n{question.text}{tail}")
        except EOFError:  # nothing listens there
            return "q"

    async def execute() -> bool:
        refuted = False
        async with BusPool() as pool:
            for spec in specs:
                driver = find_driver(spec.driver, source=spec.source)(spec, pool)

                def unplug(off: bool, owner: str = spec.owner) -> None:
                    wire = pool.simulation(owner)
                    wire.unplug() if off else wire.replug()

                print(f"{spec.name}: first contact; q ends it at every question", flush=True)
                contact = ContactGuide(driver, ask, unplug=unplug if spec.emulated else None)
                report = await contact.run()
                names = [actuator.name for actuator in spec.actuators]
                recording, page = write(report, names, out or Path("logs"))
                for one in report.findings:
                    where = f" ({one.actuator})" if one.actuator else ""
                    print(f"  {one.verdict:9} {one.topic}{where}: {one.text}")
                if report.ended:
                    print(f"  it ended early, {report.ended}")
                print(f"{spec.name}: {page} and {recording.name}: please send both to the project")
                refuted |= bool(report.ended) or any(
                    one.verdict is Conclusion.REFUTED for one in report.findings
                )
        return refuted

    return 1 if asyncio.run(execute()) else 0


def _running(hand: str) -> str | None:
    """Return the name of a hand if it runs on this computer."""
    from rtee.hand.load import load_configured
    from rtee.remote.directory import hands_running

    try:
        name = load_configured(hand)[1].name
    except RteeError:  # the model check reports the error
        return None
    return name if name in hands_running() else None


async def _asked(name: str, only: str | None) -> dict[str, list[Check]]:
    """Query a running hand for its devices, or the one named."""
    from rtee.remote.client import connect

    try:
        async with connect(name, client="doctor") as remote:
            devices = {each.name: each for each in (await remote.status()).devices}
    except RemoteError as error:
        remedy = "if it hangs, end it with Ctrl-C; its service restarts by itself"
        return {f"{name}, which runs": [wrong("answer", str(error), remedy)]}
    if only is not None and only not in devices:
        raise ConfigError(f"hand '{name}' has no device '{only}'; {suggestion(only, devices)}")
    chosen = devices.values() if only is None else [devices[only]]
    return {each.name: [_status_check(name, each)] for each in chosen}


def _status_check(hand: str, device: DeviceStatus) -> Check:
    """Return a check of a device from the status of the running hand."""
    from rtee.types import Lifecycle

    text = f"{device.driver}, {device.lifecycle}, says the running hand"
    if device.lifecycle is Lifecycle.ACTIVE:
        counts = f"{device.rate:.0f} Hz, {device.errors} errors, {device.reconnects} reconnects"
        return ok("device", f"{text}: {counts}")
    why = device.fault_name or device.message
    return wrong(
        "device",
        text + (f": {why}" if why else ""),
        device.hint or f"rtee recover {hand}; to try the device alone, end the hand first",
    )


def _service(hand: str) -> tuple[list[Check], Needs | None]:
    """Return the checks of the hand's service, and the needs of the service if it is installed.

    Both are empty if the hand's files cannot be read.
    """
    from rtee.deploy.check import check_service, is_installed
    from rtee.deploy.needs import Needs
    from rtee.running.run import RunOptions, prepare

    try:
        needs = Needs.of(prepare(hand, RunOptions(driver="devices")), {})
    except RteeError:  # the model check reports the error
        return [], None
    return check_service(needs), needs if is_installed(needs.hand) else None


async def _graph(hand: str | None) -> list[Check]:
    """Return the checks of the ROS graph that a hand's settings lead to."""
    from rtee.hand.config_schema import Ros2Settings
    from rtee.ros2.diagnosis import check_graph
    from rtee.running.run import RunOptions, prepare

    settings, name = Ros2Settings(), None
    if hand is not None:
        try:
            prepared = prepare(hand, RunOptions())
        except RteeError:  # the model check reports the error
            return []
        settings, name = prepared.config.ros2, prepared.hand.name
    return await check_graph(settings, name)


def _print(name: str, checks: list[Check]) -> None:
    print(name)
    for check in checks:
        print(f"  {check.verdict:8} {check.subject}: {check.text}")
        if check.remedy:
            print(f"  {'':8} -> {check.remedy}")


def locate(
    hand: Hand,
    *,
    device: DeviceOption = None,
    times: int = 3,
    share: float = 0.06,
    home: bool = False,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    yes: bool = False,
) -> None:
    """Move a hand's actuators a little and back, one device after the other.

    Arguments and options:
        times (1..50): How often it twitches.
        share (0.01..0.3): Part of the range that it moves.
        home: Home a device that needs it, which moves it fully.
        yes (--yes; -y): Don't ask for confirmation.
    """
    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis.locate import twitch
    from rtee.drivers.registry import find_driver

    specs = _devices_of(hand, device, emulated, ideal)
    if not yes:
        typer.confirm(f"{hand} will move; is it free?", abort=True)

    async def execute() -> None:
        async with BusPool() as pool:
            for spec in specs:
                configured = _with_options(spec, home="on_connect") if home else spec
                driver = find_driver(spec.driver, source=spec.source)(configured, pool)
                # Printed before it moves, so that people look in time.
                print(f"{spec.name}: twitching", flush=True)
                try:
                    await twitch(driver, times=times, share=share)
                except DeviceFault as fault:
                    if home or not fault.name.startswith("not "):  # homed, or activated
                        raise
                    hint = f"rtee locate {hand} --home   # which moves it fully"
                    raise DeviceFault(spec.name, fault.code, fault.name, hint=hint) from fault
                identity = driver.capabilities.identity
                print(f"{spec.name}: that was {', '.join(identity.values()) or 'it'}")

    with _naming_the_hand(hand):
        _finished(execute(), simulated=emulated)


def calibrate(
    hand: Hand,
    actions: list[str] | None = None,
    *,
    opening: bool = False,
    device: DeviceOption = None,
    out: Path | None = None,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    yes: bool = False,
) -> None:
    """Find a device's offsets or end stops and store them; it may move fully.

    With --opening, the running hand closes on gauge blocks, and hand.yaml keeps what was measured.

    Example: rtee calibrate robotiq_2f_85 --opening PinchTight

    Arguments and options:
        actions (ACTION…): With --opening: ACTION or ACTION:ELEMENT,ELEMENT; all unless given.
        opening: Measure openings of the running hand with gauge blocks instead.
        device (NAME): Without --opening: only this device of the hand; by default all.
        out (FILE): Without --opening: file to write; by default that in hand.yaml, or one beside
            it.
        emulated: Without --opening: talk to emulators instead of the real devices.
        yes (--yes; -y): Without --opening: don't wait for Enter.
    """
    if opening:
        calibrate_opening(hand, actions or ())
        return
    from rtee.buses.pool import BusPool
    from rtee.drivers import calibration
    from rtee.drivers.registry import find_driver

    specs = _devices_of(hand, device, emulated, ideal)

    async def ready(text: str) -> None:
        print(text, flush=True)
        if not yes:
            await typed_line("Press Enter when it is so, Ctrl-C to end. ")

    def file_of(spec: DeviceSpec) -> Path:
        """Return the file for a device's values; copy a shipped hand first if it is inside."""
        stored, folder = spec.options.get("calibration"), hand_folder(hand)
        path = Path(str(stored)) if stored else folder / "calibration" / f"{spec.name}.json"
        if out is not None or not path.resolve().is_relative_to(folder.resolve()):
            return out or path
        return owned(folder) / path.resolve().relative_to(folder.resolve())

    async def execute() -> None:
        async with BusPool() as pool:
            for spec in specs:
                # Before the measurement, which would be lost if the folder cannot be written.
                path = file_of(spec)
                # The driver would apply the stored values to the measurement; they may be wrong.
                uncalibrated = _with_options(spec, calibration=None)
                driver = find_driver(spec.driver, source=spec.source)(uncalibrated, pool)
                result: object = await calibration.calibrate(driver, path, ready)
                values = result if isinstance(result, list | tuple) else [result]
                print(f"{spec.name}: {'; '.join(map(str, values))}")
                print(f"{spec.name}: stored in {path}")
                if not spec.options.get("calibration"):
                    print(
                        f"  to use it, add to the device's options: calibration: {path.resolve()}"
                    )

    with _naming_the_hand(hand):
        # This waits for a person, in real time.
        _finished(execute(), simulated=emulated and yes)


_SPEED: Final = 0.2
"""Share of the velocity limits: slow enough that a block is not pushed away."""

_EFFORT: Final = 0.25
"""Share of the effort limits: enough to overcome friction, too little to bend the fingers."""

_UNLIMITED: Final = "takes no effort limit"
"""Words by which a refusal says that a device cannot limit its effort."""

_SAME: Final = 1e-4
"""Two blocks whose widths differ by less than this are the same [m]: gauge blocks are ground."""

_BEYOND: Final = 0.01
"""Excess of a real hand's widest opening over its model's that is still believed [m]."""


def calibrate_opening(name: str, words: Sequence[str]) -> None:
    """Measure the openings of actions of a running hand, block by block.

    The actions are given as for `rtee compose`; without any, all that have an opening are measured.
    Raises `UserError` if an action has none, or hand.yaml cannot be changed.
    """
    folder = hand_folder(name)
    own_place(folder)  # a folder that cannot be written is refused before the work
    library = actions_of(name)
    chosen = _chosen(library, words)
    # Before the first block, since each pair is stored as soon as it is measured.
    home = owned(folder)

    async def execute(remote: RemoteHand) -> None:
        # A person's fingers are at the hand: no other client may move it between blocks.
        async with remote.lease():
            for action, opening in chosen:
                await _Blocks(remote, library, home, action, opening).measure()

    with_hand(library.hand.name, None, "calibrate", execute)
    print("goals use the measurements from the next `rtee run` on")


def _chosen(library: ActionLibrary, words: Sequence[str]) -> list[tuple[Action, OpeningTable]]:
    """Return the actions given on the command line, with their openings by the model."""
    from rtee.actions.types import ActionReference

    openings = library.openings
    if words:
        uses = [ActionReference.of(word) for word in words]
        named = [library.find(use.action, use.elements) for use in uses]
        return [(action, openings.of(action)) for action in named]
    return openings.known(library)


class _Blocks:
    """Measurement of one action with one block after another."""

    def __init__(
        self,
        remote: RemoteHand,
        library: ActionLibrary,
        home: Path,
        action: Action,
        opening: OpeningTable,
    ) -> None:
        self._remote, self._hand, self._home = remote, library.hand, home
        self._action, self._opening = action, opening
        self._pairs = list(library.openings.measured(action))
        self._limited = True

    async def measure(self) -> None:
        """Ask for blocks and measure them until the user enters an empty line."""
        label = self._opening.label
        words = " ".join((self._action.name, *self._action.elements))
        for at, known in self._pairs:
            print(f"{label}: measured before: {1e3 * known:g} mm at {at:.4f}")
        while True:
            width = await self._width()
            if width is None:
                return
            # Open, so that the block fits in.
            await self._go(0.0)
            await typed_line(f"{label}: hold the block between the fingertips, then press Enter. ")
            intensity = await self._contact()
            await self._go(0.0)
            if intensity is None:
                print(f"{label}: the fingertips met nothing; this block is not taken", flush=True)
                continue
            kept = [pair for pair in self._pairs if abs(pair[1] - width) > _SAME]
            self._pairs = sorted([*kept, (round(intensity, 5), round(width, 6))])
            path = write_pairs(self._home, words, self._pairs)
            print(f"{label}: {1e3 * width:g} mm at {intensity:.4f}; stored in {path}", flush=True)

    async def _width(self) -> float | None:
        """Ask for the width of the next block [m] until it is valid; ``None``: no more blocks."""
        label, widest = self._opening.label, self._opening.widest
        while True:
            line = await typed_line(
                f"{label}: width of the next block, such as 30mm; Enter to end: "
            )
            if not line:
                return None
            try:
                width = quantity(line, LENGTH, "width")
            except GoalRejected as error:
                print(error, flush=True)
                continue
            if 0.0 < width <= widest + _BEYOND:
                return width
            print(f"{label} opens to {1e3 * widest:.1f} mm, not {1e3 * width:g} mm", flush=True)

    async def _contact(self) -> float | None:
        """Close gently; return the intensity at which the fingertips stopped, if they did."""
        result = await self._go(1.0)
        if not result:
            return None
        measured, last = (await self._remote.state()).positions, self._action.waypoints[-1]
        moved = [(self._hand.actuator(name), measured[name]) for name in last.involved]
        path = [(last.position[spec.name] - spec.rest, at - spec.rest) for spec, at in moved]
        # Project the measured posture onto the straight path from rest to the last waypoint.
        return sum(whole * part for whole, part in path) / sum(whole * whole for whole, _ in path)

    async def _go(self, intensity: float) -> bool:
        """Go to an intensity of the action; return whether the fingers met an obstacle."""
        name, elements = self._action.name, self._action.elements
        limits: Mapping[str, float] = {}
        if self._limited:
            involved = self._action.waypoints[-1].involved
            known = [each for each in involved if isfinite(self._hand.actuator(each).effort)]
            limits = await self._remote.effort_limits(_EFFORT, known)
        try:
            result = await self._remote.do(
                name, *elements, intensity=intensity, speed=_SPEED, effort=limits
            )
        except RequestRejected as error:
            if not limits or _UNLIMITED not in str(error):
                raise
            # Remembered, so that the limit is not requested in vain for each block.
            self._limited = False
            print(f"{error}; it closes with its own force, at {_SPEED:.0%} speed", flush=True)
            return await self._go(intensity)
        return result.grasped or result.stalled


async def _readable(descriptor: int) -> None:
    """Wait until a file descriptor has bytes to read."""
    loop, ready = asyncio.get_running_loop(), asyncio.Event()
    try:
        loop.add_reader(descriptor, ready.set)
    except PermissionError:  # a file is always readable
        return
    try:
        await ready.wait()
    finally:
        loop.remove_reader(descriptor)


_typed = bytearray()
"""Bytes that were typed ahead of the question."""


async def typed_line(text: str) -> str:
    """Print a prompt and return the line typed; an empty line at the end of the input.

    Reads without a thread: a thread that reads the terminal would keep Ctrl-C from ending the
    command.
    """
    print(text, end="", flush=True)
    # Not through `sys.stdin`: the event loop would not notice lines in its buffer.
    stdin = sys.stdin.fileno()
    while b"\n" not in _typed:
        await _readable(stdin)
        # Ctrl-C takes back what a terminal has not handed on yet: a read that waits would then keep
        # the command from ending.
        blocking = os.get_blocking(stdin)
        os.set_blocking(stdin, False)
        try:
            chunk = os.read(stdin, 4096)  # a terminal's line has at most 4095 bytes
        except BlockingIOError:
            continue
        finally:
            os.set_blocking(stdin, blocking)
        if not chunk:
            break
        _typed.extend(chunk)
    line, _, rest = bytes(_typed).partition(b"\n")
    _typed[:] = rest
    # A byte that is not UTF-8 makes an invalid width, and the question is repeated.
    return line.decode(errors="replace").strip()


def write_pairs(home: Path, words: str, pairs: Sequence[tuple[float, float]]) -> Path:
    """Write the intensities and openings [m] measured for an action into hand.yaml; comments stay.

    The words are the action and its elements. Raises `ConfigError` if the file cannot be changed;
    its message has the line to type.
    """
    from rtee.actions.action_files import rewritten

    path = home / FILE_NAME
    text = read_text(path, FILE_NAME)
    data = dict(parse_yaml(text, path, FILE_NAME).data)
    # The file may name the same elements in another order.
    before = dict(data.get("openings") or {})
    key = next((each for each in before if _key(each) == _key(words)), words)
    data["openings"] = {**before, key: [list(pair) for pair in pairs]}
    changed = rewritten(text, data)
    if changed is None:
        line = f"openings: {{{key}: {data['openings'][key]}}}"
        raise ConfigError(
            f"cannot be changed without losing its comments; write this line yourself: {line}",
            path=path,
        )
    write_atomically(path, changed)
    return path


def _key(words: str) -> tuple[str, frozenset[str]]:
    from rtee.actions.naming import normalise

    name, *elements = words.split()
    return normalise(name), frozenset(elements)
