"""The panel that is always visible: stop, open, the devices, and the holder of the lease."""

from __future__ import annotations

from html import escape

import viser

from rtee.gui.bridge import Bridge
from rtee.gui.colours import STOP
from rtee.gui.wording import WRAPS
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.monitoring import HandStatus
from rtee.types import DeviceStatus, Lifecycle

# Colours that people with any colour vision tell apart; the shape of the sign says the same.
_SIGNS = {
    Lifecycle.ACTIVE: ("●", "#009e73"),
    Lifecycle.INACTIVE: ("○", "#7a7f87"),
    Lifecycle.UNCONFIGURED: ("◌", "#e69f00"),
    Lifecycle.FAULT: ("▲", "#d55e00"),
    Lifecycle.CLOSED: ("✕", "#7a7f87"),
}


def device_line(device: DeviceStatus) -> str:
    """Return a device's status as HTML: sign, name, state, fault and hint."""
    sign, colour = _SIGNS[device.lifecycle]
    words = [f"<b>{escape(device.name)}</b> {escape(str(device.lifecycle))}"]
    if device.fault_name:
        words.append(f"fault {device.fault_code}: {escape(device.fault_name)}")
    elif device.message and device.lifecycle is not Lifecycle.ACTIVE:
        words.append(escape(device.message))
    if device.hint:
        words.append(f"<i>{escape(device.hint)}</i>")
    return f'<span style="color:{colour}">{sign}</span> ' + " · ".join(words)


class Header:
    """Stop, Open, Recover, the devices and the holder of the lease."""

    def __init__(self, bridge: Bridge, hand: RemoteHand) -> None:
        """Add the controls to the current container."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._hand = hand
        self._stop = gui.add_button(
            "STOP",
            color=STOP,
            icon=viser.Icon.HAND_STOP,
            hint="Stop all devices now, whoever holds the hand (key: S). "
            "Not a safety-rated emergency stop.",
        )
        self._open = gui.add_button(
            "Open", icon=viser.Icon.HAND_FINGER, hint="Go to the rest posture (key: O)"
        )
        self._state = gui.add_html("")
        self._recover = gui.add_button(
            "Recover",
            color=(230, 159, 0),
            icon=viser.Icon.FIRST_AID_KIT,
            hint="Bring the devices out of their fault; moves only one that must be homed first",
            visible=False,
        )
        self._admit = gui.add_button(
            "Let agents in",
            icon=viser.Icon.ROBOT,
            hint="Let language models move the hand again, as far as their gate lets them",
            visible=False,
        )
        self._stop.on_click(bridge.clicked(self._do_stop))
        self._admit.on_click(bridge.clicked(hand.admit_agents))
        self._open.on_click(bridge.clicked(hand.open))
        self._recover.on_click(bridge.clicked(hand.recover))
        # The same as commands, which have keys and work while any tab is open.
        self._commands = [
            gui.add_command("Stop the hand", description="Stop all devices now", hotkey="S"),
            gui.add_command("Open the hand", description="Go to the rest posture", hotkey="O"),
            gui.add_command("Cancel", description="Cancel what runs; hold as it is", hotkey="C"),
        ]
        # Anybody who sees a hand do harm must be able to stop it.
        bridge.leave_to_everybody(self._stop, self._commands[0])
        bridge.need(Role.OPERATOR, self._open, self._recover, self._admit, *self._commands[1:])
        self._commands[0].on_trigger(bridge.clicked(self._do_stop))
        self._commands[1].on_trigger(bridge.clicked(hand.open))
        self._commands[2].on_trigger(bridge.clicked(hand.cancel))

    async def _do_stop(self) -> None:
        confirmed = await self._hand.stop()
        # A device that has not confirmed may still move, hence the red.
        silent = [name for name, done in confirmed.items() if not done]
        if silent:
            self._bridge.notify("Stop NOT confirmed", f"by {', '.join(silent)}", "red")
        else:
            self._bridge.notify("Stopped", f"confirmed by {', '.join(confirmed)}", "green")

    def show(self, status: HandStatus, *, jogs: bool = False) -> None:
        """Show the status of the hand, and whether this GUI holds it for jogging."""
        lines = [device_line(device) for device in status.devices]
        holder = "nobody" if not status.holder else escape(status.holder)
        if status.holder == self._hand.client:
            holder = "this GUI"
        doing = f" · running <b>{escape(status.action)}</b>" if status.action else ""
        doing += " · ● recording" if status.recording else ""
        lines.append(f"held by {holder}{doing}")
        if jogs:  # in sight while any tab is open, and in every window
            lines.append("<b>Jog is on</b> (tab Make): nobody else can move the hand")
        if not self._bridge.may(Role.MAINTAINER):
            lines.append(f"this GUI's certificate: <b>{self._bridge.role.name.lower()}</b>")
        if status.agents_out:
            lines.append(f"agents are out: {escape(status.agents_out)}")
        if status.recording_trouble:
            lines.append(f"recording: {escape(status.recording_trouble)}")
        self._put(lines)
        faulty = any(device.lifecycle is Lifecycle.FAULT for device in status.devices)
        for button, wanted in ((self._recover, faulty), (self._admit, bool(status.agents_out))):
            if button.visible != wanted:  # viser sends each assignment to all windows
                button.visible = wanted

    def _put(self, lines: list[str]) -> None:
        body = "<br>".join(lines)
        html = f'<div role="status" style="font-size:0.85em;padding:0 0.75em;{WRAPS}">{body}</div>'
        if self._state.content != html:  # viser sends each assignment to all windows
            self._state.content = html

    def remove(self) -> None:
        """Remove everything."""
        buttons = (self._stop, self._open, self._recover, self._admit)
        for handle in (*buttons, self._state, *self._commands):
            handle.remove()
