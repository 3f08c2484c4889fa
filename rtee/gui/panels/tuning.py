"""Panel that tunes a running hand: the grip effort, and the gains of the devices."""

from __future__ import annotations

import math

from rtee.errors import RequestRejected
from rtee.gui.bridge import Bridge
from rtee.gui.wording import NOTHING
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.monitoring import HandStatus


class TuningPanel:
    """The grip effort and the devices' gains."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Add the panel to the current container."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._gains: dict[str, tuple[str, str]] = {}
        # Values by label: those that devices report, and those set here, for silent devices.
        self._reported: dict[str, float] = {}
        self._set_before: dict[str, float] = {}
        # Whether the field holds a value of its gain; the first click must not set it to 0.
        self._typed = False
        self._quiet = False
        self._holding = gui.add_slider(
            "Holding effort [%]",
            0,
            100,
            1,
            40,
            hint="Effort kept on what is held, as a share of the effort limit [%]",
        )
        self._which = gui.add_dropdown("Gain", (NOTHING,), hint="Gain of a device", visible=False)
        self._value = gui.add_number(
            "Value",
            0.0,
            step=0.001,
            hint="In the device's own unit; some devices do not tell their present value",
            visible=False,
        )
        self._set = gui.add_button("Set gain", hint="Change it now; needs the lease", visible=False)
        bridge.need(Role.MAINTAINER, self._holding, self._value, self._set)
        self._holding.on_update(lambda _: self._hold())
        self._which.on_update(lambda _: self._recall())
        self._value.on_update(lambda _: self._type())
        self._set.on_click(lambda _: bridge.call(self._change))

    def _hold(self) -> None:
        if not self._quiet:
            share = self._holding.value / 100.0
            self._bridge.call(lambda: self._remote.set_gains({"grip_effort": share}))

    def _type(self) -> None:
        self._typed = True

    def _recall(self) -> None:
        label = str(self._which.value)
        self._value.value = self._reported.get(label, self._set_before.get(label, 0.0))
        self._typed = label in self._reported

    async def _change(self) -> None:
        label, value = str(self._which.value), float(self._value.value)
        if not self._typed:
            raise RequestRejected("the device does not report its gain; type a value first")
        if label in self._gains:
            device, gain = self._gains[label]
            await self._remote.set_gains({gain: value}, device)
            self._set_before[label] = value
            self._bridge.notify("Gain set", f"{label} is {value:g}", "green")

    def show(self, status: HandStatus) -> None:
        """Show the grip effort and offer the gains of the devices."""
        share = round(100.0 * status.grip_effort)
        if share != self._holding.value:
            self._quiet = True  # or the callback would send the change back to the hand
            self._holding.value = share
            self._quiet = False
        gains = {
            f"{device.name}: {gain}": (device.name, gain)
            for device in status.devices
            for gain in device.gains
        }
        # A device that does not report its gains lists their names, but no values.
        self._reported = {
            f"{device.name}: {gain}": value
            for device in status.devices
            for gain, value in zip(device.gains, device.gain_values, strict=False)
            if not math.isnan(value)
        }
        if gains == self._gains:  # keep what the user has chosen and typed
            return
        self._gains = gains
        self._which.options = tuple(gains) or (NOTHING,)
        self._which.value = self._which.options[0]
        self._recall()
        for control in (self._which, self._value, self._set):
            control.visible = bool(gains)
