"""The first hour with a real device: compare what a person sees with what the driver reports.

Each step is small and announces its action. Its findings confirm or refute assumptions on the
device's page; the person can send the report to the project.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Sequence

import numpy as np

from rtee import monotonic
from rtee.buses.retry import patiently
from rtee.drivers.assumptions import Topic
from rtee.drivers.base import Driver
from rtee.drivers.diagnosis.contact_report import (
    Conclusion,
    ContactQuestion,
    ContactReport,
    Finding,
    Sample,
)
from rtee.errors import BusError, DeviceFault, NotConnected, RteeError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import ActuatorSpec, JointKind, Reference

_PERIOD = 0.05
"""Time between two references [s]: long enough for every bus, short enough to be smooth."""
_REST = 2.0
"""Time for which the hand is observed at rest [s]: long enough for about forty readings."""
_SLOW = 0.1
"""Speed of an actuator [share of its travel per second]: slow enough to get out of its way."""
_ARRIVES = 8.0
"""Longest time from the last reference until the hand is at rest [s]; some devices grip slowly."""
_PLACES = (0.25, 0.75)
"""Fractions of the travel at which a person measures."""
_NEAR = 0.15
"""Error of a scale that measuring by hand explains [share]: 2 mm of 13 mm."""
_ZERO = 0.08
"""Error of a zero that measuring by hand explains [share of the travel]."""
_HARDLY = (0.005, 0.01, 0.02, 0.04, 0.08)
"""Steps of the search for the smallest motion [share of the travel]."""
_STOPS = 0.05
"""Largest motion after a stop that confirms it [share of the travel]: 0.5 s at the test's speed."""
_LEAST_FORCE, _MOST_FORCE = 0.4, 2.5
"""Range of the ratio of measured to reported force in which a rough gauge confirms the force."""


Ask = Callable[[ContactQuestion], Awaitable[str]]
"""Puts a question to the person and returns the answer."""


def _ends(one: ActuatorSpec) -> tuple[float, float]:
    """Return the limits at which an actuator is open and closed: it rests where it is open."""
    opens_low = one.rest - one.lower <= one.upper - one.rest
    return (one.lower, one.upper) if opens_low else (one.upper, one.lower)


class _Ended(Exception):
    """The person has ended the procedure."""


class ContactGuide:
    """Leads a person through the first hour with a device.

    Args:
        driver: The device's driver, not yet connected; it is closed afterwards.
        ask: Puts a question to the person.
        unplug: Cuts (true) or restores (false) the link of an emulator; ``None``: the person does.
    """

    def __init__(
        self, driver: Driver, ask: Ask, *, unplug: Callable[[bool], None] | None = None
    ) -> None:
        self._driver = driver
        self._ask = ask
        self._unplug = unplug
        self._step = ""
        self._connected = False
        self.report = ContactReport(driver.spec.name, driver.spec.driver)

    async def run(self) -> ContactReport:
        """Go through all steps; a report that ends early covers the steps done so far."""
        steps: Sequence[tuple[str, Callable[[], Awaitable[None]]]] = (
            ("identify", self._identify),
            ("rest", self._rest),
            ("limits", self._limits),
            ("activate", self._activate),
            ("smallest motion", self._smallest),
            ("measure", self._measure),
            ("force", self._force),
            ("stop", self._stop),
            ("unplug", self._cut),
        )
        try:
            for self._step, step in steps:
                await step()
        except _Ended:
            self.report.ended = f"ended by the person at '{self._step}'"
        except RteeError as error:
            self.report.ended = f"at '{self._step}': {error}"
        finally:
            with contextlib.suppress(RteeError, OSError):
                await self._driver.stop()
            await self._driver.close()
        return self.report

    # --- asking and finding --------------------------------------------------------------------

    async def _put(self, question: ContactQuestion) -> str:
        asked = asyncio.ensure_future(self._ask(question))
        # A device that hears nothing while a person measures may stop or leave its mode.
        while not asked.done():
            if self._connected:
                with contextlib.suppress(RteeError):
                    await self._driver.sense()
            await asyncio.wait({asked}, timeout=_PERIOD)
        answer = asked.result().strip().lower()
        self.report.answers.append((question, answer))
        if answer in ("q", "quit"):
            raise _Ended
        return answer

    async def _enter(self, topic: Topic, text: str, actuator: str = "") -> str:
        return await self._put(ContactQuestion(topic, text, "enter", actuator))

    async def _yes(self, topic: Topic, text: str, actuator: str = "") -> bool | None:
        """Return whether a person says yes; ``None``: no answer."""
        answer = await self._put(ContactQuestion(topic, text, "yes", actuator))
        return {"y": True, "n": False}.get(answer[:1])

    async def _number(self, topic: Topic, text: str, actuator: str, unit: str) -> float | None:
        """Return a number that a person measured, or ``None``."""
        while True:
            answer = await self._put(ContactQuestion(topic, text, "number", actuator, unit))
            if not answer:
                return None
            with contextlib.suppress(ValueError):
                number = float(answer.replace(",", "."))
                if math.isfinite(number):
                    return number
            text = f"'{answer}' is not a number; give a number in {unit}, or Enter to skip"

    def _find(self, topic: Topic, confirmed: bool | None, text: str, actuator: str = "") -> None:
        verdict = {True: Conclusion.CONFIRMED, False: Conclusion.REFUTED, None: Conclusion.OPEN}[
            confirmed
        ]
        self.report.findings.append(Finding(topic, verdict, text, actuator))

    # --- measuring and moving ------------------------------------------------------------------

    async def _sense(self, reference: FloatArray | None = None) -> ActuatorState:
        state = await patiently(self._driver.sense)
        sent = () if reference is None else tuple(reference.tolist())
        self.report.samples.append(Sample(monotonic.now(), self._step, state, sent))
        return state

    @property
    def _actuators(self) -> Sequence[ActuatorSpec]:
        return self._driver.spec.actuators

    async def _glide(self, index: int, goal: float, *, until: Callable[[], bool] = bool) -> float:
        """Move one actuator slowly to a position; return its position afterwards."""
        one = self._actuators[index]
        state = await self._sense()
        start = float(state.position[index])
        travel = one.upper - one.lower
        speed = min(_SLOW * travel, one.velocity)
        begun, lasts = monotonic.now(), abs(goal - start) / speed
        mask = [i == index for i in range(len(self._actuators))]
        fastest = [2.0 * speed if i == index else math.inf for i in range(len(mask))]
        before, still = math.nan, 0.0
        while True:
            now = monotonic.now()
            part = min((now - begun) / lasts, 1.0) if lasts > 0.0 else 1.0
            target = np.nan_to_num(np.array(state.position, dtype=np.float64))
            target[index] = start + part * (goal - start)
            with contextlib.suppress(BusError):
                # A loose limit: the exact speed may be less than the device accepts.
                await self._driver.move(Reference.at(target, mask=mask, max_velocity=fastest))
            with contextlib.suppress(BusError):
                state = await self._sense(target)
            here = float(state.position[index])
            moved = not abs(here - before) < 0.001 * travel
            if moved:
                before, still = here, now
            if until() or now > begun + lasts + _ARRIVES:
                return here
            if part >= 1.0 and now - max(still, begun + lasts) > 1.0:
                return here
            await asyncio.sleep(_PERIOD)

    # --- the steps -------------------------------------------------------------------------------

    async def _identify(self) -> None:
        await patiently(self._driver.configure)
        self._connected = True
        identity = self.report.identity = dict(self._driver.capabilities.identity)
        reported = ", ".join(f"{name} {value}" for name, value in identity.items()) or "nothing"
        said = await self._yes(
            Topic.IDENTITY, f"It reports: {reported}. Is that the device in front of you?"
        )
        self._find(Topic.IDENTITY, said, f"it reports: {reported}")

    async def _rest(self) -> None:
        await self._enter(
            Topic.REST,
            "Let nothing touch it, and do not move it. Press Enter; the program reads it for "
            f"{_REST:g} s and moves nothing.",
        )
        end, states = monotonic.now() + _REST, []
        while monotonic.now() < end:
            states.append(await self._sense())
            await asyncio.sleep(_PERIOD)
        travels = np.array([one.upper - one.lower for one in self._actuators])
        # A device that is not homed measures no positions.
        known = np.isfinite(np.array([state.position for state in states])).all(axis=0)
        if known.any():
            positions = np.array([state.position for state in states])[:, known]
            noise = float((positions.std(axis=0) / travels[known]).max())
            self._find(
                Topic.REST, noise < 0.01, f"positions have a noise of {noise:.2%} of their travel"
            )
        holding = [state for state in states if any(state.grasped or ())]
        if holding:
            self._find(Topic.REST, False, "it reports that it holds something, though it is empty")
        touch = [state.touch.values for state in states if state.touch is not None]
        if touch:
            # A driver may take its rest values from the first readings.
            largest = float(np.nan_to_num(np.array(touch[len(touch) // 4 :])).max())
            self._find(Topic.REST, largest < 0.2, f"touch sensors read up to {largest:.2f} at rest")
        for text in sorted({text for state in states for text in state.warnings}):
            self._find(Topic.POWER_UP, None, f"it warns: {text}")

    async def _limits(self) -> None:
        state = await self._sense()
        for one, here in zip(self._actuators, state.position.tolist(), strict=True):
            if not math.isfinite(here):
                self._find(Topic.LIMITS, None, "its position is not known before homing", one.name)
                continue
            ends = self._driver.spec.mechanism(one)
            slack = 0.05 * (ends.upper - ends.lower)
            inside = ends.lower - slack <= here <= ends.upper + slack
            self._find(
                Topic.LIMITS,
                inside,
                f"it stands at {here:.4f}, between {ends.lower:.4f} and {ends.upper:.4f}"
                + ("" if inside else ": beyond the model's limits"),
                one.name,
            )

    async def _activate(self) -> None:
        needs = await patiently(self._driver.examine)
        self._find(Topic.POWER_UP, True, f"it is {needs or 'ready'} when it is connected")
        if needs:
            await self._enter(
                Topic.POWER_UP,
                f"It is {needs}: press Enter, and it moves over its full travel. Keep clear.",
            )
            await patiently(self._driver.recover)
        else:
            await self._enter(
                Topic.POWER_UP,
                "The program now powers it and moves it slowly, one actuator after the other. "
                "Keep clear and press Enter; q quits.",
            )
        await patiently(self._driver.activate)

    async def _smallest(self) -> None:
        for index, one in enumerate(self._actuators):
            state = await self._sense()
            start, travel = float(state.position[index]), one.upper - one.lower
            onward = 1.0 if start < 0.5 * (one.lower + one.upper) else -1.0
            for step in _HARDLY:
                here = await self._glide(index, start + onward * step * travel)
                if (here - start) * onward > 0.4 * step * travel:
                    self._find(
                        Topic.LIMITS,
                        True,
                        f"it follows steps of {step:.1%} of its travel",
                        one.name,
                    )
                    break
            else:
                self._find(
                    Topic.LIMITS, False, "it follows no step up to 8% of its travel", one.name
                )

    async def _measure(self) -> None:
        """Have a person measure where each actuator is: direction, scale and zero follow."""
        for index, one in enumerate(self._actuators):
            linear = one.kind is JointKind.PRISMATIC
            unit, per = ("mm", 1e3) if linear else ("degrees", math.degrees(1.0))
            tool, part_of = (
                ("ruler or gauge block", "finger") if linear else ("protractor", "joint")
            )
            opened, closed = _ends(one)
            # A person measures from where the mechanism ends, not from hand.yaml's limit.
            ends = self._driver.spec.mechanism(one)
            stop = ends.lower if opened == one.lower else ends.upper
            reported, measured = [], []
            for part in _PLACES:
                here = await self._glide(index, opened + part * (closed - opened))
                number = await self._number(
                    Topic.SCALE,
                    f"Measure {one.name} with a {tool}: how far is the {part_of} itself from its "
                    f"open end? [{unit}, Enter to skip]",
                    one.name,
                    unit,
                )
                if number is None:
                    break
                reported.append(abs(here - stop) * per)
                measured.append(number)
            await self._glide(index, opened + 0.02 * (closed - opened))
            if len(measured) == len(_PLACES):
                self._compare(one, reported, measured, (one.upper - one.lower) * per, unit)
            else:
                self._find(Topic.SCALE, None, "not measured", one.name)

    def _compare(
        self,
        one: ActuatorSpec,
        reported: Sequence[float],
        measured: Sequence[float],
        travel: float,
        unit: str,
    ) -> None:
        """Judge direction, scale and zero from two positions, reported and measured."""
        ratio = (measured[1] - measured[0]) / (reported[1] - reported[0])
        if ratio < -0.2:
            self._find(Topic.DIRECTION, False, "it opened where it was told to close", one.name)
        elif ratio > 0.2:
            self._find(Topic.DIRECTION, True, "it closed where it was told to close", one.name)
        size = abs(ratio)
        self._find(
            Topic.SCALE,
            abs(size - 1.0) <= _NEAR,
            f"{reported[1] - reported[0]:.1f} {unit} reported, "
            f"{abs(measured[1] - measured[0]):.1f} {unit} measured: "
            f"{size:.2f} times",
            one.name,
        )
        # By the measured scale, so that a wrong scale is not reported as a wrong zero, too.
        zero = measured[0] - ratio * reported[0] if ratio > 0.0 else math.nan
        if math.isfinite(zero):
            self._find(
                Topic.OFFSET,
                abs(zero) <= _ZERO * travel,
                f"where it reports its open end, it is {zero:+.1f} {unit} from that end",
                one.name,
            )

    async def _force(self) -> None:
        can = self._driver.capabilities
        for index, one in enumerate(self._actuators):
            grip = can.grip.get(one.name)
            if grip is None or "max_effort" not in can.accepts:
                continue
            weakest = grip.weakest[0]
            answer = await self._enter(
                Topic.FORCE,
                "Hold a force gauge (a kitchen scale, a spring) between the fingertips. "
                f"{one.name} will close with its smallest force, {weakest:.1f} N. Press Enter "
                "when the gauge is in place, or type n to skip.",
                one.name,
            )
            if answer.startswith("n"):
                self._find(Topic.FORCE, None, "not measured", one.name)
                continue
            mask = [i == index for i in range(len(self._actuators))]
            effort = [grip.effort[0] if i == index else math.inf for i in range(len(mask))]
            state = await self._sense()
            target = np.nan_to_num(np.array(state.position))
            opened, target[index] = _ends(one)
            end = monotonic.now() + _ARRIVES
            while monotonic.now() < end:
                with contextlib.suppress(BusError):
                    await self._driver.move(Reference.at(target, max_effort=effort, mask=mask))
                    await self._sense(target)
                await asyncio.sleep(_PERIOD)
            measured = await self._number(
                Topic.FORCE, "What does the gauge show? [N, Enter to skip]", one.name, "N"
            )
            text = f"{weakest:.1f} N reported"
            if measured is None:
                self._find(Topic.FORCE, None, f"{text}, not measured", one.name)
            else:
                right = _LEAST_FORCE <= measured / weakest <= _MOST_FORCE
                self._find(Topic.FORCE, right, f"{text}, {measured:.1f} N measured", one.name)
            await self._glide(index, opened)

    async def _stop(self) -> None:
        if not self._actuators:
            return
        index, one = 0, self._actuators[0]
        travel = one.upper - one.lower
        state = await self._sense()
        start = float(state.position[index])
        far = one.upper if start < 0.5 * (one.lower + one.upper) else one.lower
        await self._enter(
            Topic.STOP,
            f"{one.name} will move slowly and stop on its way. Press Enter and watch.",
            one.name,
        )
        begun = monotonic.now()
        await self._glide(index, far, until=lambda: monotonic.now() > begun + 2.0)
        here = float((await self._sense()).position[index])
        await self._driver.stop()
        end = monotonic.now() + 2.0
        while monotonic.now() < end:
            state = await self._sense()
            await asyncio.sleep(_PERIOD)
        after = abs(float(state.position[index]) - here) / travel
        said = await self._yes(Topic.STOP, "Did it stop at once, without jumping?", one.name)
        right = None if said is None else said and after <= _STOPS
        self._find(Topic.STOP, right, f"it moved on by {after:.1%} of its travel after the stop")

    async def _cut(self) -> None:
        if self._unplug is None:
            await self._enter(Topic.LINK, "Pull its data cable now, then press Enter.")
        before = self.report.samples[-1].state.position
        if self._unplug is not None:
            self._unplug(True)
        self._connected = False
        noticed, begun = False, monotonic.now()
        while monotonic.now() < begun + 5.0 and not noticed:
            try:
                await self._driver.sense()
            except (BusError, NotConnected, DeviceFault):
                noticed = True
            await asyncio.sleep(_PERIOD)
        await self._driver.close()
        text = "the driver noticed it" if noticed else "the driver did not notice it within 5 s"
        if self._unplug is not None:
            self._unplug(False)
        else:
            await self._enter(Topic.LINK, "Plug it in again, then press Enter.")
        await asyncio.sleep(1.0)
        await patiently(self._driver.configure)
        state = await self._sense()
        gone = 0.0
        if len(before):
            travels = np.array([one.upper - one.lower for one in self._actuators])
            gone = float(np.nan_to_num(np.abs(state.position - before) / travels).max())
        self._find(
            Topic.LINK, noticed, f"{text}; meanwhile it moved by {gone:.1%} of its travel at most"
        )
