"""The panel above the tabs: open the hand, cancel, and recover devices that do not follow."""

from __future__ import annotations

from html import escape
from typing import Final

import viser

from rtee.gui.bridge import Bridge
from rtee.gui.wording import WRAPS, put
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.truth import Truth
from rtee.types import DeviceStatus, Lifecycle

# Colours that people with any colour vision can distinguish; the shapes carry the meaning, too.
_SIGNS = {
    Lifecycle.ACTIVE: ("●", "#009e73"),
    Lifecycle.INACTIVE: ("○", "var(--rtee-faint)"),
    Lifecycle.UNCONFIGURED: ("◌", "#e69f00"),
    Lifecycle.FAULT: ("▲", "#d55e00"),
    Lifecycle.CLOSED: ("✕", "var(--rtee-faint)"),
}

_GREY: Final = (90, 96, 104)


def device_line(device: DeviceStatus) -> str:
    """Return a device's status as HTML: sign, name, state and remarks."""
    sign, colour = _SIGNS[device.lifecycle]
    words = [f"<b>{escape(device.name)}</b> {escape(str(device.lifecycle))}"]
    if device.remarks and device.lifecycle is not Lifecycle.ACTIVE:
        words.append(escape(device.remarks))
    return f'<span style="color:{colour}">{sign}</span> ' + " · ".join(words)


class HeaderPanel:
    """The buttons Open, Cancel and Recover, and the state of the devices."""

    def __init__(self, bridge: Bridge, hand: RemoteHand) -> None:
        """Add the controls to the current container."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._hand = hand
        self._move = gui.add_button_group(
            "",
            ("Open hand", "Cancel"),
            hint="Open hand: go to the rest posture (key: O). Cancel: end the running action and "
            "hold the present posture (key: C)",
        )
        self._state = gui.add_html("")
        self._recover = gui.add_button(
            "Recover …",
            color=(140, 80, 0),
            icon=viser.Icon.FIRST_AID_KIT,
            hint="Make the devices follow again; you are asked first, and see what may move",
            visible=False,
        )
        self._sure = gui.add_folder("Recover the devices?", visible=False)
        with self._sure:
            self._moves = gui.add_html("")
            yes = gui.add_button("Recover now", hint="Recover; STOP works meanwhile")
            no = gui.add_button("Not now", color=_GREY, hint="Leave the devices as they are")
        self._admit = gui.add_button(
            "Let agents in",
            icon=viser.Icon.ROBOT,
            hint="Let language models move the hand again, within the limits of their gate",
            visible=False,
        )
        self._recover.on_click(bridge.clicked(self._ask))
        yes.on_click(bridge.clicked(self._do_recover))
        no.on_click(bridge.clicked(self._hide))
        self._admit.on_click(bridge.clicked(hand.admit_agents))
        # The same buttons as commands, which have keys and work in every tab.
        self._commands = [
            gui.add_command("Open the hand", description="Go to the rest posture", hotkey="O"),
            gui.add_command("Cancel", description="End the action; hold the posture", hotkey="C"),
        ]
        moving = (self._move, self._recover, yes, self._admit, *self._commands)
        bridge.need(Role.OPERATOR, *moving)
        self._move.on_click(
            lambda event: bridge.call(
                hand.open if event.target.value == "Open hand" else hand.cancel
            )
        )
        self._commands[0].on_trigger(bridge.clicked(hand.open))
        self._commands[1].on_trigger(bridge.clicked(hand.cancel))

    async def _ask(self) -> None:
        self._sure.visible = True

    async def _hide(self) -> None:
        self._sure.visible = False

    async def _do_recover(self) -> None:
        self._sure.visible = False
        await self._hand.recover()

    def show(self, truth: Truth, *, jogs: bool = False) -> None:
        """Show the devices, and whether this window controls the hand for jogging."""
        status = truth.status
        if status is None:
            return
        lines = [device_line(device) for device in status.devices]
        if truth.stale:
            lines = [f'<span style="color:var(--rtee-warn)">old:</span> {line}' for line in lines]
        if jogs:  # visible in every tab
            lines.append("<b>Jog is on</b> (tab Teach): nobody else can move the hand")
        if not self._bridge.may(Role.MAINTAINER):
            lines.append(f"this GUI's certificate: <b>{self._bridge.role.name.lower()}</b>")
        if status.agents_out:
            lines.append(f"agents locked out: {escape(status.agents_out)}")
        if status.recording_trouble:
            lines.append(f"recording: {escape(status.recording_trouble)}")
        put(self._state, _text("<br>".join(lines)))
        ill = bool(truth.ill) and not truth.stale and not truth.homing
        if ill:
            names = ", ".join(escape(device.name) for device in truth.ill)
            put(
                self._moves,
                _text(
                    f"{names} will be powered, and hold the hand's present position. A "
                    "device that must be homed first moves through its range: keep clear."
                ),
            )
        shown = ((self._recover, ill), (self._admit, bool(status.agents_out)))
        for button, wanted in shown:
            if button.visible != wanted:  # viser sends each assignment
                button.visible = wanted
        if not ill and self._sure.visible:
            self._sure.visible = False

    def remove(self) -> None:
        """Remove everything."""
        controls = (self._move, self._recover, self._admit, self._sure)
        for handle in (*controls, self._state, *self._commands):
            handle.remove()


def _text(html: str) -> str:
    return f'<div role="status" style="font-size:0.85em;padding:0 0.75em;{WRAPS}">{html}</div>'
