"""Jog panel: a slider per actuator."""

from __future__ import annotations

import contextlib

import anyio
import viser

from rtee.errors import RemoteError
from rtee.gui.bridge import Bridge
from rtee.gui.wording import short_names
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.messages.state import State
from rtee.remote.client import RemoteHand

_FOLD = 12
"""Most actuators whose folder of sliders is open at first: more would fill the panel."""

_RATE = 30.0
"""Samples per second while the hand follows the sliders [Hz]: browsers report hardly more."""

_LEAVE_WITHIN = 0.5
"""Longest time to wait for the release of the lease [s]: the hand may already be gone."""

_STEPS = {"rad": 0.001, "m": 0.0001}
"""Step of a slider by unit [rad | m]: finer than the repeatability of a hand."""


class JogPanel:
    """A slider per actuator; moves the hand while this GUI holds the lease."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand) -> None:
        """Add the panel to the current container."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        self._quiet = False
        self._hold = gui.add_checkbox(
            "Jog (holds the hand)", False, hint="While ticked, nobody else can move the hand"
        )
        self._speed = gui.add_slider(
            "Jog speed [%]", 5, 100, 5, 25, hint="Share of the actuators' velocity limits [%]"
        )
        self._follow = gui.add_checkbox(
            "Follow the sliders",
            False,
            hint="Stream the sliders' positions: the hand follows them at once, as fast as its "
            "limits allow",
        )
        self._wanted: dict[str, float] = {}
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        with gui.add_folder("Actuators", expand_by_default=len(hand.actuators) <= _FOLD):
            names = short_names(hand.actuator_names)
            for index, actuator in enumerate(hand.actuators):
                # A continuous joint has no limits, or wide ones; one turn is enough for its slider.
                lower = actuator.lower if actuator.lower > -7.0 else -3.1416
                upper = actuator.upper if actuator.upper < 7.0 else 3.1416
                unit = "m" if actuator.kind == "prismatic" else "rad"
                slider = gui.add_slider(
                    f"{names[index]} [{unit}]",
                    lower,
                    upper,
                    _STEPS[unit],
                    min(max(actuator.rest, lower), upper),
                    disabled=True,
                    hint=f"Position of {actuator.name} [{unit}]; moves it while Jog is ticked",
                )
                slider.on_update(lambda _, at=index: self._moved(at))
                self._sliders.append(slider)
        bridge.need(Role.OPERATOR, self._hold, self._speed, self._follow)
        self._hold.on_update(lambda _: bridge.call(self._acquire_or_release))
        self._follow.on_update(lambda _: bridge.call(self._stream))

    async def _acquire_or_release(self) -> None:
        try:
            await (self._remote.acquire() if self._hold.value else self._remote.release())
        except RemoteError:
            self._hold.value = False
            raise
        finally:
            # A slider that works without the lease would only cause refusals.
            for slider in self._sliders:
                slider.disabled = not self._hold.value
        await self._stream()

    async def _stream(self) -> None:
        """Stream the positions of moved sliders while both boxes are ticked."""
        if not (self._hold.value and self._follow.value):
            return
        self._wanted.clear()  # sliders moved earlier must not move the hand now
        try:
            async with self._remote.stream(_RATE) as stream:
                while self._hold.value and self._follow.value:
                    if self._wanted:
                        await stream.send(dict(self._wanted))
                    await anyio.sleep(1.0 / _RATE)
        except RemoteError:
            self._follow.value = False
            raise

    def _moved(self, index: int) -> None:
        if self._quiet or not self._hold.value:
            return
        actuator = self._hand.actuators[index]
        value = float(self._sliders[index].value)
        if self._follow.value:
            self._wanted[actuator.name] = value
            return
        speed = actuator.velocity * self._speed.value / 100.0
        self._bridge.call(lambda: self._remote.jog({actuator.name: value}, speed))

    @property
    def holding(self) -> bool:
        """Whether this GUI holds the hand for jogging."""
        return bool(self._hold.value)

    def give_back(self) -> None:
        """Untick the box, which releases the lease and ends the stream of the sliders."""
        self._hold.value = False

    async def leave(self) -> None:
        """Release the lease if it is held; do not wait long for a hand that has gone."""
        if self._hold.value:
            with contextlib.suppress(RemoteError), anyio.move_on_after(_LEAVE_WITHIN):
                await self._remote.release()

    def follow(self, state: State) -> None:
        """Move the sliders with the hand while nobody jogs."""
        if self._hold.value:
            return
        self._quiet = True  # or the callbacks would take these moves for the user's
        try:
            for slider, position in zip(self._sliders, state.position, strict=True):
                value = min(max(float(position), slider.min), slider.max)
                # Skip NaN, and changes within the noise of a measurement.
                if value == value and abs(value - slider.value) > 2.0 * slider.step:
                    slider.value = value
        finally:
            self._quiet = False
