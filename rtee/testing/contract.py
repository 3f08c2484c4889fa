"""The suite that every driver passes: one test for each failure that users of hands have met."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from typing import Any, ClassVar

import pytest

from rtee import monotonic
from rtee.buses.faults import Faults
from rtee.buses.retry import patiently
from rtee.drivers.emulator_server import WIRE_FAULTS
from rtee.errors import (
    BusError,
    BusTimeout,
    DeviceFault,
    DriverError,
    FrameError,
    HandshakeError,
    NotConnected,
    RteeError,
)
from rtee.sample import ActuatorState
from rtee.testing.case import DeviceCase
from rtee.testing.session import Session, open_files, simulated_time
from rtee.types import Reference

NEEDS_CHECKSUMS = frozenset({"corrupt", "noise"})
"""The faults that a driver can detect only if frames have checksums."""

_DEAF = 0.06
"""Time for which all answers are lost [s]: longer than most drivers wait for an answer."""

_AGAIN = 0.1
"""Additional time that a lost answer may cost a stop [s]: stops have 0.15."""

_LOOK = 0.0005
"""Interval of checks for lost bytes on a wire [s]: less than a device takes to answer."""

_UNPLUGGED = 5
"""Fewest unplugs of a device: a leak of one file each time then shows as five."""

_APPROACH = 0.1
"""Share of the path between two postures at which a device is stopped."""

_SHARE = 0.05
"""Fraction of the messages that a faulty wire damages: more than even a real wire in need of
repair."""


class DriverContract:
    """Derive from this, set `case`, and pytest runs the suite on your driver.

    Attributes:
        case: The device.
    """

    case: ClassVar[DeviceCase]

    pytestmark = pytest.mark.anyio

    @pytest.fixture
    def anyio_backend(self) -> tuple[str, dict[str, Any]]:
        """Run the tests in asyncio, as the loop runs drivers, but on simulated time."""
        return simulated_time()

    @asynccontextmanager
    async def session(self, within: float = 55.0) -> AsyncIterator[Session]:
        """Yield a session; fails if it lasts longer than ``within`` [s] or leaves a task behind."""
        before = asyncio.all_tasks()
        async with asyncio.timeout(within), Session(self.case) as session:
            yield session
        await asyncio.sleep(0)
        # One turn of the event loop lets tasks that were cancelled end.
        left = asyncio.all_tasks() - before
        assert not left, f"tasks left behind: {left}"

    @asynccontextmanager
    async def _session_at(
        self, posture: Sequence[float], within: float = 55.0
    ) -> AsyncIterator[tuple[Session, ActuatorState]]:
        """Yield a session whose device is active and at a posture, and its state there."""
        async with self.session(within) as session:
            await session.start()
            state = await session.reach(posture)
            session.check(state, posture, "it does not get where it is sent")
            yield session, state

    def needed(self, name: str) -> Any:
        """Return an attribute of the case, or skip the test if it is ``None``."""
        value = getattr(self.case, name)
        if value is None:
            pytest.skip(f"the case gives no '{name}'")
        return value

    def wired(self) -> None:
        """Skip the test if the device has no wire."""
        if not self.case.wire:
            pytest.skip("this driver has no wire")

    def moving(self) -> None:
        """Skip the test if the device only measures."""
        if not self.case.actuators:
            pytest.skip("this device drives no actuators")

    # --- connecting --------------------------------------------------------------------------

    async def test_connecting_identifies_and_moves_nothing(self) -> None:
        """`configure` identifies the device and sends no motion command."""
        async with self.session() as session:
            await session.connect()
            assert session.driver.capabilities.identity, "`configure` has identified no device"
            positions = (await session.sense()).position
            n = len(self.case.actuators)
            assert positions.shape == (n,), f"{positions.shape} positions for {n} actuators"
            assert all(map(math.isfinite, positions)), f"not all positions are numbers: {positions}"
            assert session.driver.capabilities.best_rate > 0.0, "it has no best rate"
            self._check_commands(session, 0)

    async def test_a_wrong_device_is_refused(self) -> None:
        """Another device at the address is an error, and is not driven."""
        self.wired()
        async with self.session() as session:
            await session.before(lambda emulator: emulator.inject("wrong_device"))
            with pytest.raises((HandshakeError, NotConnected)):
                await session.driver.configure()
            self._check_commands(session, 0)

    def _check_commands(self, session: Session, allowed: int) -> None:
        if self.case.commands is not None:
            sent = self.case.commands(session.emulator) - allowed
            assert not sent, f"it has sent {sent} motion commands where it should send none"

    async def test_no_device_is_a_clear_error(self) -> None:
        """A missing port and a silent device raise an error with a message, and do not hang."""
        self.wired()
        async with self.session() as session:
            await session.before(lambda emulator: None)
            session.wire.unplug()
            with pytest.raises((BusError, NotConnected)) as caught:
                await session.driver.configure()
            assert str(caught.value), "the error for a missing port says nothing"
            session.wire.replug()
            # Now the port exists but nothing answers: the other kind of absence.
            session.wire.faults = Faults(drop=1.0)
            with pytest.raises((BusTimeout, NotConnected)):
                await session.driver.configure()

    async def test_attaching_to_a_holding_device_moves_nothing(self) -> None:
        """Connecting to a device that is active and holds something sends no motion command."""
        self.moving()
        grip_object, commands = self.needed("grip_object"), self.needed("commands")
        async with self.session() as session:
            await session.before(grip_object)
            heard = commands(session.emulator)
            state = await session.start()
            here = Reference.at(state.position)
            # Several cycles, since repeating the same reference must send nothing, either.
            for _ in range(5):
                await session.cycle(here)
                await asyncio.sleep(0.005)
            after = await session.sense()
            self._check_commands(session, heard)
            session.check(after, state.position.tolist(), "connecting has moved it")

    async def test_the_first_state_is_measured(self) -> None:
        """The first state after connecting again is measured, not remembered."""
        near, _ = self.case.between()
        async with self._session_at(near) as (session, _):
            await session.driver.disable()
            there = await session.at_rest()
            await session.driver.close()
            again = await session.start()
            assert again.fresh, "the first state is not marked as fresh"
            session.check(again, there.position.tolist(), "the first state is not measured")

    # --- moving ------------------------------------------------------------------------------

    async def test_a_posture_is_reached_and_measured(self) -> None:
        """Measured positions equal the reference: units, signs and the order of the actuators."""
        self.moving()
        near, far = self.case.between()
        async with self.session() as session:
            await session.start()
            for goal in (near, far, near):
                state = await session.reach(goal)
                session.check(state, goal, "it does not get where it is sent")

    async def test_references_beyond_the_limits_do_no_harm(self) -> None:
        """A reference at or past a limit is clamped or refused, never wrapped."""
        self.moving()
        near, _ = self.case.between()
        async with self._session_at(near) as (session, _):
            beyond = [a.upper + 1e-3 for a in self.case.actuators]
            try:
                state = await session.reach(beyond)
            # Refused, which is as good as clamped.
            except DriverError:
                return
            bounds = zip(near, (a.upper for a in self.case.actuators), strict=True)
            self._check_within(state, bounds, "it is sent beyond a limit and goes elsewhere")

    def _check_within(
        self, state: ActuatorState, bounds: Iterable[tuple[float, float]], wrong: str
    ) -> None:
        for q, spec, (least, most) in zip(state.position, self.case.actuators, bounds, strict=True):
            assert least - self.case.tolerance <= q <= most + self.case.tolerance, (
                f"{wrong}: {spec.name} is at {q:g}, not within {least:g} to {most:g}"
            )

    def test_no_reference_holds_nan(self) -> None:
        """A reference with NaN cannot be made."""
        self.moving()
        n = len(self.case.actuators)
        with pytest.raises(ValueError, match="reference"):
            Reference.at([math.nan] * n)
        with pytest.raises(ValueError, match="NaN"):
            Reference.at([0.0] * n, max_effort=[math.nan] * n)

    async def test_effort_limits_are_in_force_before_the_motion(self) -> None:
        """The effort limit is sent with the position or before it, never after it."""
        self.moving()
        efforts, wanted = self.needed("efforts"), self.needed("max_efforts")
        near, far = self.case.between()
        async with self._session_at(near) as (session, _):
            await session.reach(far, max_effort=list(wanted))
            found = list(efforts(session.emulator))
            assert found == pytest.approx(list(wanted), rel=0.05), (
                f"the device has the effort limits {found} during the motion, not {list(wanted)}"
            )

    async def test_stop_stops(self) -> None:
        """After `stop` during a motion, the position does not change any more."""
        self.moving()
        near, far = self.case.between()
        async with self._session_at(near) as (session, _):
            await session.leave(near, far)
            await session.driver.stop()
            await asyncio.sleep(self.case.stopping)
            there = await session.sense()
            await asyncio.sleep(0.2)
            later = await session.sense()
            session.check(later, there.position.tolist(), "it moved on after the stop")
            assert not session.near(later, far), "it went on to where it was sent"

    @pytest.mark.parametrize("seen", [False, True])
    async def test_stop_commands_no_position_that_cannot_be(self, seen: bool) -> None:
        """The device does not jump if its encoders do right before or during `stop`."""
        self.moving()
        self.wired()
        near, far = self.case.between()
        async with self._session_at(far) as (session, _):
            motors = session.emulator.axes
            if not motors:
                pytest.skip("the emulator has no motors with encoders")
            ends = [motor.position for motor in motors]
            await session.reach(near)
            # Four fifths of the distance between the postures, more than any actuator covers in a
            # cycle.
            jumps = [0.8 * (end - m.position) for end, m in zip(ends, motors, strict=True)]
            wanted = await session.approach(far, _APPROACH)
            for motor, jump in zip(motors, jumps, strict=True):
                motor.sensor.offset += jump
            if seen:
                session.driver.standstill.measured(await session.sense())
            await session.driver.stop()
            for motor, jump in zip(motors, jumps, strict=True):
                motor.sensor.offset -= jump
            bounds = ((min(n, w), max(n, w)) for n, w in zip(near, wanted, strict=True))
            self._check_within(await session.at_rest(), bounds, "it jumped with its encoders")

    async def test_stop_stops_though_answers_get_lost(self) -> None:
        """A lost answer delays `stop` little, and many do not prevent its other commands."""
        self.moving()
        self.wired()
        near, far = self.case.between()
        async with self._session_at(near) as (session, _):
            usual = await self._time_of_stop(session, near, Faults())
            late = await self._time_of_stop(session, near, Faults(drop=1.0, requests=False))
            assert late < 2.0 * usual + _AGAIN, "a lost answer delays a stop"
            for _ in range(5):
                await session.cycle(Reference.at(list(far)))
            # Only answers get lost; the commands must reach the device.
            session.wire.faults = Faults(drop=1.0, requests=False)
            # Answers return while stop still retries, as after a real disturbance.
            heal = asyncio.get_running_loop().call_later(
                _DEAF, setattr, session.wire, "faults", Faults()
            )
            await session.driver.stop()
            # `stop` may have ended before, and the timer must not change the wire later.
            heal.cancel()
            session.wire.faults = Faults()
            there = await session.sense()
            await asyncio.sleep(self.case.stopping)
            await session.sense()  # some devices leave a host that is silent for 0.3 s
            await asyncio.sleep(0.2)
            moved = (await session.sense()).position - there.position
            onward = [
                math.copysign(float(travel), travel * (f - n))
                for travel, n, f in zip(moved, near, far, strict=True)
            ]
            # Only motion towards the goal is wrong: a hand may spring back a little when it stops.
            assert max(onward) <= self.case.tolerance, "it moved on"

    async def _time_of_stop(
        self, session: Session, posture: Sequence[float], faults: Faults
    ) -> float:
        """Stop a motion; return the time until the device answers again [s].

        The wire has ``faults`` until the first answer is lost.
        """
        for _ in range(5):
            await session.cycle(Reference.at(list(posture)))
        session.wire.faults = faults
        begun = monotonic.now()
        stopping = asyncio.ensure_future(session.driver.stop())
        while not (faults.injected or stopping.done()):  # noqa: ASYNC110 - the wire has no event
            await asyncio.sleep(_LOOK)
        faults.drop = 0.0
        await stopping
        await session.sense()
        return monotonic.now() - begun

    async def test_stop_never_raises(self) -> None:
        """`stop` works before connecting, when unplugged and after closing."""
        self.wired()
        async with self.session() as session:
            await session.driver.stop()
            await session.start()
            session.wire.unplug()
            await session.driver.stop()
            await session.driver.close()
            await session.driver.stop()

    async def test_a_stuck_device_is_measured_where_it_is(self) -> None:
        """The position of a device that does not follow is measured, not assumed."""
        self.moving()
        self.wired()
        near, far = self.case.between()
        async with self._session_at(near) as (session, there):
            session.emulator.inject("stuck")
            for _ in range(20):
                await session.cycle(Reference.at(list(far)))
                state = await session.sense()
                session.check(state, there.position.tolist(), "a stuck device seems to move")
                await asyncio.sleep(0.005)

    # --- faults of the device ----------------------------------------------------------------

    async def test_a_fault_is_named_and_recovered_from(self) -> None:
        """A fault has a name and a hint; `recover` clears it without a jump."""
        fault = self.needed("fault")
        near, _ = self.case.between()
        async with self._session_at(near) as (session, _):
            session.emulator.inject(fault)
            caught = await session.fault()
            assert caught.name, "the fault has no name"
            assert caught.hint, "the fault has no hint that says what to do"
            assert caught.recoverable, "the fault is not marked as recoverable"
            # The cause still exists, so recovering must fail.
            with pytest.raises(DeviceFault):
                await self._recover(session)
            session.emulator.clear()
            await self._recover(session)
            here = (await session.sense()).position.tolist()
            session.check(await session.reach(here), here, "recovering has moved it")

    async def _recover(self, session: Session) -> None:
        await patiently(session.driver.recover)
        await patiently(session.driver.activate)

    async def test_a_power_cycle_is_noticed_or_harmless(self) -> None:
        """After a power cycle the device reports a fault or keeps its position, but never jumps."""
        self.wired()
        near, _ = self.case.between()
        async with self._session_at(near) as (session, there):
            session.wire.power_cycle()
            noticed = False
            for _ in range(20):
                try:
                    state = await session.driver.sense()
                except (DeviceFault, NotConnected, BusTimeout, FrameError):
                    noticed = True
                    break
                session.check(state, there.position.tolist(), "a power cycle changes the position")
                await asyncio.sleep(0.005)
            # A device that homes has lost its zero: without an error, its positions would be wrong.
            assert noticed or not self.case.homes, "a device that has lost its zero raises no error"

    # --- faults of the wire ------------------------------------------------------------------

    @pytest.mark.parametrize("fault", WIRE_FAULTS)
    @pytest.mark.timeout(600)
    async def test_a_faulty_wire_is_survived(self, fault: str) -> None:
        """Only timeouts and frame errors are raised at 5 % faults, and no value is wrong."""
        self.wired()
        if fault in NEEDS_CHECKSUMS and not self.case.checksums:
            pytest.skip("frames of this device carry no checksum")
        if self.case.wire_faults is not None and fault not in self.case.wire_faults:
            pytest.skip("the wire of this device has no such fault")
        near, far = self.case.between()
        # Of simulated time: a second for each cycle, as the slowest lines need.
        async with self._session_at(near, within=float(self.case.cycles)) as (session, _):
            counters = dict(session.driver.counters())
            faults = Faults(delay_time=0.003, seed=11)
            setattr(faults, fault, _SHARE)
            session.wire.faults = faults
            done = await self._cycles(session, Reference.at(list(far)))
            session.wire.faults = Faults()
            cycles = self.case.cycles
            assert done >= self.case.share * cycles, f"only {done} of {cycles} cycles succeeded"
            # In so few cycles, 5 % may be none at all.
            assert cycles < 100 or faults.injected[fault] > 0, "the driver did not use the wire"
            session.check(await session.reach(near), near, "it does not work after the faults")
            after = dict(session.driver.counters())
            self._check_counters(counters, after, fault, faults)

    async def _cycles(self, session: Session, reference: Reference) -> int:
        limits = [(a.lower, a.upper) for a in self.case.actuators]
        done = 0
        for _ in range(self.case.cycles):
            state = await session.cycle(reference)
            await asyncio.sleep(1.0 / self.case.rate)
            if state is None:
                continue
            done += 1
            self._check_within(state, limits, "damaged bytes became a position")
        return done

    def _check_counters(
        self, before: dict[str, int], after: dict[str, int], fault: str, faults: Faults
    ) -> None:
        grow = ["bytes_received"]
        if self.case.actuators:
            grow += ["transactions", "bytes_sent"]
            if fault == "drop" and faults.injected["drop"] > 20 and self.case.answers:
                grow.append("timeouts")
        for name in grow:
            assert after[name] > before[name], f"the driver does not count its {name}"

    async def test_a_cancelled_exchange_leaves_the_driver_usable(self) -> None:
        """An exchange can be cancelled at any moment, and the next one works."""
        self.wired()
        near, _ = self.case.between()
        async with self._session_at(near) as (session, _):
            session.wire.faults = Faults(delay=1.0, delay_time=0.01)
            # Before the request is sent, while it is in transit, and shortly before the answer,
            # which takes 10 ms.
            for wait in (0.0, 0.001, 0.004, 0.008):
                task = asyncio.ensure_future(session.driver.sense())
                await asyncio.sleep(wait)
                task.cancel()
                (result,) = await asyncio.gather(task, return_exceptions=True)
                assert not isinstance(result, Exception) or isinstance(result, BusTimeout), (
                    f"a cancelled exchange raises {result!r}"
                )
            session.wire.faults = Faults()
            # Longer than the delay, so that late answers of the cancelled exchanges have arrived.
            await asyncio.sleep(0.03)
            state = await session.reach(near)
            session.check(state, near, "it does not work after a cancelled exchange")

    @pytest.mark.timeout(300)
    async def test_unplugging_again_and_again_leaks_nothing(self) -> None:
        """However often it is unplugged and replugged, no file, task or thread is left behind."""
        self.wired()
        async with self.session(within=290.0) as session:
            first = await session.start()
            here = first.position.tolist()
            files, tasks = open_files(), len(asyncio.all_tasks())
            for _ in range(max(_UNPLUGGED, self.case.cycles // 100)):
                session.wire.unplug()
                await session.lost()
                await session.driver.close()
                session.wire.replug()
                state = await session.start()
                session.check(state, here, "it has moved while it was unplugged")
            more = len(asyncio.all_tasks()) - tasks
            assert not more, f"{more} tasks are left behind"
            self._check_files(files)

    def _check_files(self, before: int) -> None:
        more = open_files() - before
        # One more at most: a library may open a file of its own when it is first used.
        assert more <= 1, f"{more} files are left open"

    async def test_a_slow_device_leaves_a_fast_one_its_rate(self) -> None:
        """While one device takes 0.1 s per exchange, those of another one take no longer."""
        self.wired()
        async with self.session() as fast, Session(self.case, name="slow") as slow:
            await fast.start()
            await slow.start()
            alone = await fast.longest_exchange()
            slow.wire.faults = Faults(delay=1.0, delay_time=0.1, requests=False)
            waiting = asyncio.ensure_future(self._try(slow.driver.sense, 5))
            beside = await fast.longest_exchange()
            await waiting
            assert beside <= alone + 0.01, (
                f"an exchange takes {beside:.3f} s beside a slow device, {alone:.3f} s alone"
            )

    async def _try(self, call: Callable[[], Any], times: int) -> None:
        for _ in range(times):
            try:
                await call()
            except RteeError:
                await asyncio.sleep(0)

    # --- in real time ------------------------------------------------------------------------

    def test_it_works_over_a_real_port_in_real_time(self) -> None:
        """The device moves over a real port of this computer, and reconnects after an unplug."""
        self.wired()
        asyncio.run(self._over_a_real_port())

    async def _over_a_real_port(self) -> None:
        near, _ = self.case.between()
        async with self.session() as session:
            await session.start()
            session.check(await session.reach(near), near, "it does not get where it is sent")
            await session.driver.stop()
            files = open_files()
            for _ in range(3):
                session.wire.unplug()
                await session.lost()
                await session.driver.close()
                session.wire.replug()
                await session.start()
            session.check(await session.reach(near), near, "it does not work after an unplug")
            self._check_files(files)

    # --- closing -----------------------------------------------------------------------------

    async def test_close_is_idempotent_in_any_state(self) -> None:
        """`close` works before connecting, when connected, when active and after closing."""
        async with self.session() as session:
            await session.driver.close()
            await session.connect()
            await session.driver.close()
            await session.driver.close()
            await session.start()
            await session.driver.close()
            await session.driver.close()
            assert not session.pool.buses, "the driver has not detached from its bus"
            with pytest.raises((BusError, DriverError)):
                await session.driver.sense()
