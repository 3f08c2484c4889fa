"""Diagnose one device, check by check, up to the first obstacle."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.diagnosis.can_probe import can
from rtee.drivers.diagnosis.checks import Check, Verdict, ok, warning, wrong
from rtee.drivers.diagnosis.port import check_address
from rtee.drivers.diagnosis.scan import ScanPlan, network_probes, scan, serial_probes
from rtee.drivers.registry import find_driver
from rtee.errors import (
    BusBusy,
    DeviceFault,
    DriverError,
    HandshakeError,
    NotConnected,
    RteeError,
    UserError,
)
from rtee.hand.validation import defaults
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec

_HOT = 60.0
"""Temperature above which a hand should rest [°C]: most devices switch off at 70 to 80."""
_CAN_RATE = 1_000_000
"""CAN bit rate of devices that have no option for it [bit/s]."""


def address_of(options: Mapping[str, Any]) -> str | None:
    """Return the tty or network address in a driver's options, ``None`` if it has none."""
    if options.get("channel"):
        return None  # the device is on a CAN bus, whatever the default of its port is
    if options.get("port"):
        return str(options["port"])
    host = options.get("host")
    # On a CAN bus "host" is a number: the node id of this program.
    return f"tcp://{host}" if isinstance(host, str) and host else None


def _search(options: Mapping[str, Any]) -> ScanPlan | None:
    """Return the plan of a search at the device's address; ``None`` if a search is impossible."""
    address = address_of(options)
    if address is not None:
        network = address.startswith("tcp://")
        return ScanPlan(address, probes=network_probes() if network else serial_probes())
    if {"channel", "interface"} <= options.keys():
        # An Allegro Hand's bus has one bit rate, so it is not an option.
        probe = can(str(options["interface"]), int(options.get("bitrate", _CAN_RATE)))
        return ScanPlan(str(options["channel"]), probes=(probe,))
    return None


async def check_device(spec: DeviceSpec, pool: BusPool, *, search: bool = True) -> list[Check]:
    """Check a device, up to the first obstacle; moves nothing.

    A network address is not tried before the driver connects: many devices serve only one
    connection and need a moment before they accept the next.

    Args:
        spec: The device.
        pool: The buses.
        search: Whether to search at other rates and numbers if it does not answer.

    Raises:
        ConfigError: if its options cannot be used.
    """
    driver = find_driver(spec.driver, source=spec.source)(spec, pool)
    options = defaults(type(driver).Options) | dict(spec.options)
    address = None if spec.emulated else address_of(options)
    network = address is not None and "://" in address
    found: list[Check] = []
    if address is not None and not network:
        found += await check_address(address)
        if any(check.verdict is Verdict.WRONG for check in found):
            return found
    plan = None if spec.emulated or not search else _search(options)
    try:
        found += await _connected(driver, pool, plan)
    # The driver may have opened its bus even if a check has failed.
    finally:
        await driver.close()
    unreached = any(check.verdict is Verdict.WRONG and check.subject == "bus" for check in found)
    if address is not None and network and unreached:
        reasons = await check_address(address)
        if any(check.verdict is Verdict.WRONG for check in reasons):
            return reasons
        # The address accepts connections, but not the driver's: another program may be connected.
        busy = "end the other program that is connected; many devices serve one connection"
        return [*reasons, *(replace(check, remedy=busy) for check in found)]
    return found


async def _connected(driver: Driver, pool: BusPool, plan: ScanPlan | None) -> list[Check]:
    try:
        await driver.configure()
    except HandshakeError as error:
        return [wrong("identity", error.message, error.hint or "is it the right device?")]
    except NotConnected as error:
        text = await _elsewhere(driver, pool, plan) if plan is not None else ""
        return [wrong("answer", error.message, text or error.hint or "is its supply on?")]
    except BusBusy as error:
        return [wrong("bus", error.message, "end the other program")]
    except DriverError as error:
        return [wrong("answer", error.message, error.hint or "see the driver's page")]
    except RteeError as error:
        return [wrong("bus", str(error), "is it plugged in, and is the address right?")]
    found = [ok("answer", "it answers"), _identity(driver)]
    try:
        state = await patiently(driver.sense)
    except DeviceFault as fault:
        return [*found, wrong("fault", f"{fault.code}: {fault.name}", fault.hint or "recover it")]
    except RteeError as error:
        return [*found, wrong("state", str(error), "check the cable")]
    found += _state(state, driver.capabilities.homing)
    found.append(await _fit(driver))
    return [*found, _rate(driver), _wire(driver), _watchdog(driver)]


async def _fit(driver: Driver) -> Check:
    """Check whether the device can be activated."""
    try:
        needs = await patiently(driver.examine)
    except DeviceFault as fault:
        return wrong("fault", f"{fault.code}: {fault.name}", fault.hint or "`rtee recover`")
    except UserError as error:
        return wrong("fault", str(error), "correct its options in hand.yaml, or calibrate it")
    except RteeError as error:
        return wrong("fault", str(error), "check the cable")
    if needs:
        return warning("fault", f"none, but {needs}", "rtee recover, which moves it")
    return ok("fault", "none")


async def _elsewhere(driver: Driver, pool: BusPool, plan: ScanPlan) -> str:
    """Search for other devices at the address; return in words how to reach them."""
    # The scan has to open the same port.
    await driver.close()
    [result] = await scan([plan], pool)
    if result.problem:
        return ""
    if not result.found:
        where = " at this bit rate" if plan.probes[0].name == "CAN" else ""
        where = where or ("" if "://" in plan.address else " at any rate")
        return f"no device answers there{where}: check the supply and the wiring"
    names = ", ".join(device.what for device in result.found)
    first = result.found[0]
    settings = ", ".join(
        f"{k}: {v}" for k, v in first.options.items() if k not in ("port", "channel", "interface")
    )
    return f"found {names} there; set driver: {first.driver or '?'}, {settings or 'nothing else'}"


def _identity(driver: Driver) -> Check:
    identity = driver.capabilities.identity
    if not identity:
        return ok("identity", "it reports nothing about itself")
    return ok("identity", ", ".join(f"{name} {value}" for name, value in identity.items()))


def _state(state: ActuatorState, homing: bool) -> list[Check]:
    checks = []
    bad = [i for i, q in enumerate(state.position) if not math.isfinite(q)]
    if bad and homing:
        checks.append(ok("position", "not known before homing"))
    elif bad:
        checks.append(wrong("position", f"not measured by actuators {bad}", "recover it"))
    elif len(state.position):
        checks.append(ok("position", ", ".join(f"{q:.3f}" for q in state.position)))
    if state.touch is not None:
        taxels = state.touch.values
        largest = float(np.nanmax(taxels, initial=0.0))
        checks.append(ok("touch", f"{len(taxels)} taxels, the largest value {largest:.2f}"))
    hot = [t for t in state.temperature if t > _HOT]
    if hot:
        checks.append(warning("temperature", f"{max(hot):.0f} °C", "let it cool down"))
    for name in ("voltage", "supply"):
        values = state.extras.get(name)
        if values is not None and len(values):
            checks.append(ok("supply", f"{float(min(values)):.1f} V"))
    checks += [warning("warning", text, "see the driver's page") for text in state.warnings]
    return checks


def _rate(driver: Driver) -> Check:
    best = driver.capabilities.best_rate
    every = driver.spec.every
    if math.isinf(best):
        return ok("rate", "as fast as the loop")
    asked = driver.spec.rate / every if every else 0.0
    # With a margin of 0.1 %, so that rounding does not cause a warning.
    if asked > best * 1.001:
        return warning(
            "rate",
            f"hand.yaml asks for {asked:.0f} Hz, the wire allows {best:.0f} Hz",
            f"set every: {math.ceil(driver.spec.rate / best)} in hand.yaml, or leave it out",
        )
    return ok("rate", f"up to {best:.0f} Hz")


def _watchdog(driver: Driver) -> Check:
    if driver.capabilities.watchdog:
        return ok("watchdog", "armed: it stops by itself when this program falls silent")
    return ok("watchdog", "none armed; its page says what it does when this program falls silent")


def _wire(driver: Driver) -> Check:
    counters = driver.counters()
    errors = counters.get("retries", 0) + counters.get("checksum_errors", 0)
    if errors:
        return warning(
            "wire",
            f"{errors} of {counters.get('transactions', 0)} transactions had to be repeated",
            "check cable, shield, termination and the distance to motor cables",
        )
    return ok("wire", f"{counters.get('transactions', 0)} transactions without an error")
