"""Probes that only the right device answers; they move nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rtee import monotonic
from rtee.buses.bus import Bus
from rtee.buses.dynamixel import DynamixelBus
from rtee.buses.modbus import ModbusBus
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import answered, heard
from rtee.buses.serial import SerialBus
from rtee.drivers.diagnosis.slaves import ANSWER, Found, slave
from rtee.errors import BusError, BusTimeout, FrameError

_NOBODYS_UNIT = 213
"""Modbus number that no known device has: a device that answers to it answers to all numbers."""
B = TypeVar("B", bound=Bus)
OWNER = "scan"
"""Owner of the buses during a scan."""
_SERVO = 0.5
"""Share of `ANSWER` in which a servo answers; an adapter holds bytes back for up to 16 ms."""
_LATE = 2.5
"""Time after which no first answer comes any more [`ANSWER`]: 0.1 s, twice what is typical."""
_LINKER_ANSWER = 0.15  # longest time for an answer in the LinkerHands' SDK [s]


@dataclass(frozen=True, slots=True)
class Probe:
    """A request for one kind of device, at one setting of the line.

    Attributes:
        name: The kind of device.
        ask: Sends the request, given the pool and the address, and returns the devices found.
    """

    name: str
    ask: Callable[[BusPool, str], Awaitable[list[Found]]]


async def ended(bus: Bus, answers: Awaitable[list[Found]]) -> list[Found]:
    """Return the devices found, after detaching from the bus."""
    try:
        return await answers
    finally:
        # The next probe opens the same port, often at another rate.
        await bus.detach(OWNER)


def probe(
    name: str,
    acquire: Callable[[BusPool, str], Awaitable[B]],
    listen: Callable[[B, str], Awaitable[list[Found]]],
) -> Probe:
    """Return a probe on the bus from ``acquire``; ``listen`` gets that bus and its address.

    It asks again where nobody was found, but something was heard: an adapter is slow and noisy when
    its port has just been opened, so that the first answer is late and damaged.
    """

    async def asked(bus: B, address: str) -> list[Found]:
        late = monotonic.now() + _LATE * ANSWER.get()
        found = await listen(bus, address)
        if found:
            return found
        await asyncio.sleep(max(0.0, late - monotonic.now()))
        return await listen(bus, address) if bus.counters.bytes_received else []

    async def ask(pool: BusPool, address: str) -> list[Found]:
        bus = await acquire(pool, address)
        return await ended(bus, asked(bus, address))

    return Probe(name, ask)


def _on_line(
    name: str,
    baudrate: int,
    listen: Callable[[SerialBus, str], Awaitable[list[Found]]],
    *,
    fresh: bool = False,
) -> Probe:
    """Return a probe on a serial line; ``listen`` gets the line and its address."""

    def line(pool: BusPool, address: str) -> Awaitable[SerialBus]:
        return pool.serial(address, owner=OWNER, baudrate=baudrate, fresh=fresh)

    return probe(name, line, listen)


# --- Modbus ----------------------------------------------------------------------------------


def modbus(baudrate: int, parity: str, units: Sequence[int], *, name: str = "Modbus") -> Probe:
    """Return a probe for Modbus slaves, which names those that it recognises."""
    return probe(
        name,
        lambda pool, at: pool.modbus(at, owner=OWNER, baudrate=baudrate, parity=parity),
        lambda bus, address: _slaves(bus, address, baudrate, parity, units),
    )


async def _slaves(
    bus: ModbusBus, address: str, baudrate: int, parity: str, units: Sequence[int]
) -> list[Found]:
    found = []
    for unit in units:
        device = await slave(bus, address, unit)
        if device is not None and bus.rtu:
            line = f"{baudrate} baud 8{parity}1"
            options = {**device.options, "baudrate": baudrate}
            found.append(Found(device.driver, f"{device.what}, {line}", options))
        elif device is not None:
            found.append(device)
    # Over TCP, many devices answer to every unit and would be listed once for each.
    if bus.rtu or len(found) < 2 or await slave(bus, address, _NOBODYS_UNIT) is None:
        return found
    return [_any_unit(found)]


def _any_unit(found: Sequence[Found]) -> Found:
    """Return the one device that answers to every unit, with its driver's default unit."""
    from rtee.drivers.registry import find_driver
    from rtee.hand.validation import defaults

    first = found[0]
    usual = defaults(find_driver(first.driver).Options)["unit"] if first.driver else None
    device = next((f for f in found if f.options["unit"] == usual), first)
    what = device.what.partition(", unit ")[0]
    return Found(device.driver, f"{what}, any unit", device.options)


def linkerhand() -> Probe:
    """Return a probe for LinkerHands on RS-485, right and left ones."""
    from rtee.drivers.linkerhand.codec import BAUDRATE, LEFT, MODELS, RIGHT
    from rtee.drivers.linkerhand.link import ModbusLink

    async def listen(bus: ModbusBus, address: str) -> list[Found]:
        found = []
        for unit in (RIGHT, LEFT):
            for name, model in MODELS.items():
                link = ModbusLink(bus, model, unit, _LINKER_ANSWER, 0, model.spacing)
                version = await heard(link.version())
                if version is not None and version.motors == model.count:
                    options = {"port": address, "model": name, "unit": unit}
                    what = f"LinkerHand {model.name}, unit {unit}"
                    found.append(Found("linkerhand", what, options))
        return found

    return probe(
        "LinkerHand", lambda pool, at: pool.modbus(at, owner=OWNER, baudrate=BAUDRATE), listen
    )


# --- serial protocols --------------------------------------------------------------------------


def svh() -> Probe:
    """Return a probe for the SCHUNK SVH."""
    from rtee.drivers.schunk_svh.codec import BAUDRATE, NAME
    from rtee.drivers.schunk_svh.link import SvhLink

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        info = await heard(SvhLink(bus, 0.15, 1).firmware())
        if info is None or info.name != NAME:
            return []
        what = f"SCHUNK SVH, firmware {info.major}.{info.minor}"
        return [Found("schunk_svh", what, {"port": address})]

    return _on_line("SCHUNK SVH", BAUDRATE, listen)


def softhand(devices: Sequence[int]) -> Probe:
    """Return a probe for qb SoftHands with the given numbers."""
    from rtee.drivers.qb_softhand.codec import BAUDRATE
    from rtee.drivers.qb_softhand.link import QbLink

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        # First one request to all, since most lines have no SoftHand and each number takes time.
        if not await QbLink(bus, 0, 0.1, 1).hears_any():
            return []
        there = [n for n in devices if await QbLink(bus, n, 0.1, 0).ping()]
        return [
            Found("qb_softhand", f"qb SoftHand, device {n}", {"port": address, "device": n})
            for n in there
        ]

    return _on_line("qb SoftHand", BAUDRATE, listen)


def ability_hand() -> Probe:
    """Return a probe for the Ability Hand at its factory address and baud rate."""
    from rtee.drivers.ability_hand.codec import ADDRESS, BAUDRATES, Command, Header, ReplyParser

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        asked = Command(ADDRESS, Header.READ).to_bytes()
        reply = await heard(bus.transact(asked, ReplyParser(), 0.1, 1))
        what = f"PSYONIC Ability Hand, address {ADDRESS}"
        return [] if reply is None else [Found("ability_hand", what, {"port": address})]

    return _on_line("PSYONIC Ability Hand", BAUDRATES[0], listen)


def rh56(units: Sequence[int]) -> Probe:
    """Return a probe for RH56 hands with the given numbers, by their own frames."""
    from rtee.drivers.inspire_rh56.codec import BAUDRATES, Register
    from rtee.drivers.inspire_rh56.link import FrameLink

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        found = []
        for unit in units:
            number = await heard(FrameLink(bus, unit, ANSWER.get(), 0).read(Register.HAND_ID, 1))
            if number == bytes([unit]):
                options = {"port": address, "unit": unit, "protocol": "frames"}
                found.append(Found("inspire_rh56", f"Inspire RH56, unit {unit}", options))
        return found

    return _on_line("Inspire RH56", BAUDRATES[0], listen)


def wsg50() -> Probe:
    """Return a probe for the WSG 50, at its own TCP port or behind a socket."""
    from rtee.drivers.wsg50.codec import PORT, Command, Frame, Info
    from rtee.drivers.wsg50.link import WsgLink

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        try:
            info = Info.from_bytes((await WsgLink(bus, 0.3).ask(Frame(Command.INFO))).payload[2:])
        except (BusError, CodecError):
            return []
        what = f"WSG 50, serial {info.serial}, firmware {info.version}"
        return [Found("wsg50", what, {"port": address})]

    async def ask(pool: BusPool, address: str) -> list[Found]:
        scheme, _, place = address.partition("://")
        if scheme == "tcp" and ":" not in place:
            place = f"{place}:{PORT}"
        elif scheme != "socket":
            return []  # a tty, or another port that was named
        try:
            bus = await pool.serial(f"socket://{place}", owner=OWNER)
        except BusError:
            return []  # the host may still serve Modbus
        return await ended(bus, listen(bus, f"socket://{place}"))

    return Probe("WSG 50", ask)


def orca_touch() -> Probe:
    """Return a probe for the ORCA hand's touch board, at the baud rate of each of its lines."""
    from rtee.drivers.orca_touch import codec

    asked = codec.Request(codec.Function.READ, codec.Register.CONNECTED, codec.CONNECTED_SIZE)

    def answers(answer: codec.Answer) -> bool:
        # A board with a running stream also sends other frames.
        return isinstance(answer, codec.Reply) and answer.address == asked.address

    async def listen(bus: SerialBus, address: str, baudrate: int) -> list[Found]:
        try:
            reply = await bus.transact(
                asked.to_bytes(), codec.AnswerParser(), ANSWER.get(), 1, accept=answers
            )
            tips = codec.connected(reply.data) if isinstance(reply, codec.Reply) else ()
        except (BusTimeout, FrameError, CodecError):
            return []
        what = f"ORCA touch board, fingertips {', '.join(tips) or 'none'}, {baudrate} baud"
        return [Found("orca_touch", what, {"port": address, "baudrate": baudrate})]

    async def ask(pool: BusPool, address: str) -> list[Found]:
        for baudrate in codec.BAUDRATES:
            bus = await pool.serial(address, owner=OWNER, baudrate=baudrate, fresh=True)
            found = await ended(bus, listen(bus, address, baudrate))
            if found:
                return found
        return []

    return Probe("ORCA touch board", ask)


def dynamixel(baudrate: int) -> Probe:
    """Return a probe for Dynamixel servos at one baud rate.

    On a line that carries every rate, such as an emulated one, servos answer at all of them; they
    are then listed with the rate that they report.
    """
    from rtee.drivers.dynamixel.codec import ALERT
    from rtee.drivers.dynamixel.table import BAUD_RATE, BAUD_RATES, model_of

    # The SDK waits as long as the answers of 252 servos of 14 bytes would take on the line, and 3
    # ms for each [s].
    ping = 252 * (140 / baudrate + 0.003)

    def reported_rate(bus: DynamixelBus, number: int) -> int:
        value, result, error = bus.packets.read1ByteTxRx(bus.port, number, BAUD_RATE.address)
        heard = result == 0 and not error & ~ALERT and value < len(BAUD_RATES)
        return BAUD_RATES[value] if heard else baudrate

    def everybody(bus: DynamixelBus) -> list[tuple[int, int, int, int]]:
        data, _ = bus.packets.broadcastPing(bus.port)
        if data:  # again, since the answer of the first one may have been damaged
            data |= bus.packets.broadcastPing(bus.port)[0]
        return [(n, *data[n], reported_rate(bus, n)) for n in sorted(data)]

    async def listen(bus: DynamixelBus, address: str) -> list[Found]:
        return [
            Found(
                "dynamixel",
                f"{model_of(model).name}, id {number}, firmware {firmware}, {rate} baud",
                {"port": address, "baudrate": rate, "id": number},
            )
            for number, model, firmware, rate in await bus.run(
                lambda: everybody(bus), 2 * ping + 1.0
            )
        ]

    return probe(
        "Dynamixel", lambda pool, at: pool.dynamixel(at, owner=OWNER, baudrate=baudrate), listen
    )


def feetech(baudrate: int) -> Probe:
    """Return a probe for Feetech servos at one baud rate.

    All servos answer a broadcast ping at the same time, which shows only whether there are any;
    then the probe reads every id. On a line that carries every rate, servos answer at all of them;
    they are then listed with the rate that they report.
    """
    from rtee.drivers.feetech.codec import BROADCAST, LARGEST_ID, Frame, Instruction, ReplyParser
    from rtee.drivers.feetech.identity import recognise
    from rtee.drivers.feetech.link import FeetechLink
    from rtee.drivers.feetech.table import BAUD_RATE, BAUD_RATES, FAMILIES

    async def listen(bus: SerialBus, address: str) -> list[Found]:
        ping = Frame(BROADCAST, Instruction.PING).to_bytes()
        if not await answered(bus.transact(ping, ReplyParser(), ANSWER.get(), 0)):
            return []
        # Any family will do: only the raw bytes of the model count, and their order identifies the
        # family.
        link, found = FeetechLink(bus, FAMILIES["sts"], _SERVO * ANSWER.get(), 0), []
        for number in range(LARGEST_ID + 1):
            about = await heard(link.data(number, 0, 7))
            if about is None:
                continue
            model = recognise(about[3:5])
            family = "" if model is None else model.family
            what = f"servo with model bytes {about[3:5].hex(' ').upper()}"
            name = what if model is None else model.name
            code = about[BAUD_RATE.address]
            rate = BAUD_RATES[code] if code < len(BAUD_RATES) else baudrate
            options = {"port": address, "baudrate": rate}
            options |= {"family": family} if family else {}
            text = f"{name}, id {number}, firmware {about[0]}.{about[1]}, {rate} baud"
            found.append(Found("feetech" if family else "", text, {**options, "id": number}))
        return found

    return _on_line("Feetech", baudrate, listen, fresh=True)
