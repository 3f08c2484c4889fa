"""`rtee doctor`, `rtee locate` and `rtee calibrate`: check, find and calibrate a hand's devices."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Coroutine
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rtee.cli._common import (
    EmulatedOption,
    Hand,
    IdealOption,
    JsonOption,
    complete_hand,
    hand_folder,
    owned,
)

if TYPE_CHECKING:
    from rtee.deploy.needs import Needs
    from rtee.drivers.diagnosis.checks import Check
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
    from rtee.errors import ConfigError, suggestion
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
    """Return what some work results in; emulated devices alone need not be waited for."""
    from rtee.buses.simulated_time import SimulatedTimeLoop

    with asyncio.Runner(loop_factory=SimulatedTimeLoop if simulated else None) as runner:
        return runner.run(work)


def _with_options(spec: DeviceSpec, **options: Any) -> DeviceSpec:
    """Return a device with some of its options replaced; ``None`` removes one."""
    merged = {**spec.options, **options}
    return replace(spec, options={k: v for k, v in merged.items() if v is not None})


def doctor(
    hand: Annotated[
        str | None,
        typer.Argument(
            metavar="[HAND]",
            help="Name of a hand, or its folder; without it only this computer is checked.",
            autocompletion=complete_hand,
        ),
    ] = None,
    device: DeviceOption = None,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    first_contact: Annotated[
        bool,
        typer.Option(
            "--first-contact",
            help="Lead through the first hour with a real device: it asks, moves little by little, "
            "and writes a report.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of that report; by default logs/."),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Only write the files for a robot PC: udev rule, limits, service."
        ),
    ] = None,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Also check the ROS 2 graph: who does not hear whom.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check this computer and a hand's devices; each line is ok, or says what to type."""
    if files is not None:
        from rtee.deploy.files import write_files

        for path in write_files(files):
            print(path)
        return

    if first_contact:
        from rtee.errors import ConfigError

        if hand is None:
            raise ConfigError("give the hand: rtee doctor --first-contact HAND")
        raise typer.Exit(_first_contact(_devices_of(hand, device, emulated, ideal), out))

    from rtee.buses.pool import BusPool
    from rtee.cli.secure import checks as check_certificates
    from rtee.drivers.diagnosis.checks import Verdict
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
        print(json.dumps({k: [asdict(c) for c in v] for k, v in results.items()}, indent=2))
    else:
        for name, checks in results.items():
            _print(name, checks)
    wrong = any(check.verdict is Verdict.WRONG for checks in results.values() for check in checks)
    raise typer.Exit(1 if wrong else 0)


def _first_contact(specs: list[DeviceSpec], out: Path | None) -> int:
    """Go through the first contact with each device; return the exit status."""
    from rtee.buses.pool import BusPool
    from rtee.drivers.connection import owner_of
    from rtee.drivers.diagnosis.contact_report import Question, Verdict
    from rtee.drivers.diagnosis.first_contact import FirstContact
    from rtee.drivers.registry import find_driver
    from rtee.log.first_contact import write

    async def ask(question: Question) -> str:
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

                def unplug(off: bool, owner: str = owner_of(spec)) -> None:
                    wire = pool.simulation(owner)
                    wire.unplug() if off else wire.replug()

                print(f"{spec.name}: first contact; q ends it at every question", flush=True)
                contact = FirstContact(driver, ask, unplug=unplug if spec.emulated else None)
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
                    one.verdict is Verdict.REFUTED for one in report.findings
                )
        return refuted

    return 1 if asyncio.run(execute()) else 0


def _running(hand: str) -> str | None:
    """Return the name of a hand if it runs on this computer."""
    from rtee.errors import RteeError
    from rtee.hand.load import load_configured
    from rtee.remote.directory import running

    try:
        name = load_configured(hand)[1].name
    except RteeError:  # the check of the model says what is wrong with it
        return None
    return name if name in running() else None


async def _asked(name: str, only: str | None) -> dict[str, list[Check]]:
    """Query a running hand for its devices, or the one named."""
    from rtee.drivers.diagnosis.checks import wrong
    from rtee.errors import ConfigError, RemoteError, suggestion
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
    return {each.name: [_told(name, each)] for each in chosen}


def _told(hand: str, device: DeviceStatus) -> Check:
    """Return a check of a device from what the running hand says of it."""
    from rtee.drivers.diagnosis.checks import ok, wrong
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
    from rtee.errors import RteeError
    from rtee.running.run import RunOptions, prepare

    try:
        needs = Needs.of(prepare(hand, RunOptions(driver="devices")), {})
    except RteeError:  # the check of the model says what is wrong with it
        return [], None
    return check_service(needs), needs if is_installed(needs.hand) else None


async def _graph(hand: str | None) -> list[Check]:
    """Return the checks of the ROS graph that a hand's settings lead to."""
    from rtee.errors import RteeError
    from rtee.hand.config_schema import Ros2Settings
    from rtee.ros2.diagnosis import check_graph
    from rtee.running.run import RunOptions, prepare

    settings, name = Ros2Settings(), None
    if hand is not None:
        try:
            prepared = prepare(hand, RunOptions())
        except RteeError:  # the check of the model says what is wrong with it
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
    device: DeviceOption = None,
    times: Annotated[int, typer.Option(min=1, max=50, help="How often it twitches.")] = 3,
    share: Annotated[
        float, typer.Option(min=0.01, max=0.3, help="Part of the range that it moves.")
    ] = 0.06,
    home: Annotated[
        bool, typer.Option("--home", help="Home a device that needs it, which moves it fully.")
    ] = False,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask for confirmation.")] = False,
) -> None:
    """Move a hand's actuators a little and back, one device after the other."""
    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis.locate import twitch
    from rtee.drivers.registry import find_driver
    from rtee.errors import DeviceFault

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

    _finished(execute(), simulated=emulated)


def calibrate(
    hand: Hand,
    actions: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ACTION…",
            help="With --opening: ACTION or ACTION:ELEMENT,ELEMENT; all unless given.",
        ),
    ] = None,
    opening: Annotated[
        bool,
        typer.Option(
            "--opening", help="Measure openings of the running hand with gauge blocks instead."
        ),
    ] = False,
    device: DeviceOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File to write; by default that in hand.yaml, or one beside it."
        ),
    ] = None,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't wait for Enter.")] = False,
) -> None:
    """Find a device's offsets or end stops and store them; it may move fully.

    With --opening, the running hand closes on gauge blocks, and hand.yaml keeps what was measured.

    Example: rtee calibrate robotiq_2f_85 --opening PinchTight
    """
    if opening:
        from rtee.cli.calibrate_opening import calibrate_opening

        calibrate_opening(hand, actions or ())
        return
    if actions:
        from rtee.errors import ConfigError

        raise ConfigError("actions go with --opening")
    from rtee.buses.pool import BusPool
    from rtee.cli.calibrate_opening import typed_line
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
                    print(f"  to use it, add to the device's options: calibration: {path}")

    # A person is waited for, whose time is real.
    _finished(execute(), simulated=emulated and yes)
