"""Tables of the fingertips, actuators, joints, loop timing and buses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np
import viser

from rtee.gui.colours import lines_of
from rtee.gui.wording import Angles, put, short_names, swatch, units
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.remote.monitoring import HandStatus
from rtee.sample import MEASURED

# Digits of equal width keep the columns from jumping as the numbers change.
_STYLE = "font-size:0.75em;border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums"
_HEAD = "text-align:right;padding-left:0.6em;vertical-align:bottom"
_NUMBER = "text-align:right;padding-left:0.6em;white-space:nowrap"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], lines: Sequence[int] = ()) -> str:
    """Return an HTML table; each row has a name and numbers.

    With ``lines``, rows start with the colours of these lines; see `rtee.gui.colours.line_numbers`.
    """
    swatches = [f"{swatch(number)} " for number in lines] or [""] * len(rows)
    styles = [f"{_HEAD};text-align:left;padding-left:0", *[_HEAD] * len(head)]
    # A screen reader would announce a heading without text.
    cells = [
        f'<th style="{style}">{title}</th>' if title else "<td></td>"
        for title, style in zip(head, styles, strict=False)
    ]
    text = [f"<tr>{''.join(cells)}</tr>"]
    for row, mark in zip(rows, swatches, strict=True):
        numbers = "".join(f'<td style="{_NUMBER}">{cell}</td>' for cell in row[1:])
        # Let long names break after an underscore, which leaves room for the last column.
        name = escape(row[0]).replace("_", "_<wbr>")
        text.append(f"<tr><td>{mark}{name}</td>{numbers}</tr>")
    return (
        f'<div style="padding:0 0.5em;overflow-x:auto"><table style="{_STYLE}">'
        f"{''.join(text)}</table></div>"
    )


class TablePanel:
    """Tables of fingertips, actuators, joints, loop and buses."""

    def __init__(self, gui: viser.GuiApi, hand: Hand, angles: Angles) -> None:
        """Add the panel to the current container."""
        self._hand, self._angles = hand, angles
        self._lines, self._joint_lines = lines_of(hand)
        self._known: set[str] = set()
        self._names = short_names(hand.actuator_names)
        self._joint_names = short_names(hand.joint_names)
        self._grip = gui.add_html("", visible=False)
        with gui.add_folder("Actuators"):
            self._actuators = gui.add_html("")
        with gui.add_folder("Joints", expand_by_default=len(hand.joints) <= 24):
            self._joints = gui.add_html("")
        with gui.add_folder("Loop"):
            self._loop = gui.add_html("")
        with gui.add_folder("Buses", expand_by_default=False):
            self._buses = gui.add_html("")

    def show_state(self, state: State) -> None:
        """Show a measured state."""
        if self._grip.visible is (state.opening is None):
            self._grip.visible = state.opening is not None
        force = (
            "–" if state.force is None else f"{state.force:.1f} ± {state.force_error or 0.0:.1f}"
        )
        width = f"{1e3 * (state.opening or 0.0):.1f}"
        grip = ["fingertips", width, force, state.force_source or "–"]
        put(self._grip, table(("", "opening [mm]", "force [N]", "by"), [grip]))
        actuators, show = self._hand.actuators, self._angles.text
        # A quantity has a column if the hand has ever measured it.
        self._known |= {name for name in MEASURED if np.isfinite(getattr(state, name)).any()}
        kinds = {actuator.kind for actuator in actuators}
        extras = [name for name in ("effort", "temperature") if name in self._known]
        rows = [
            [
                self._names[i],
                show(state.position[i], "position", actuator.kind),
                show(state.reference_position[i], "position", actuator.kind),
                *(show(getattr(state, name)[i], name, actuator.kind) for name in extras),
            ]
            for i, actuator in enumerate(actuators)
        ]
        head = [f"actuator [{self._angles.unit('position', kinds)}]", "pos", "ref"]
        head += [f"{MEASURED[n].heading or f'{n} [{units(n, kinds)}]'}" for n in extras]
        put(self._actuators, table(head, rows, self._lines))
        # By name, since the hand may order its joints differently from the model here.
        by_name = dict(zip(state.joint_names, state.joint_position, strict=True))
        speeds = self._hand.transmission.velocities(state.position, state.velocity)
        rows = [
            [
                self._joint_names[i],
                show(float(by_name.get(joint.name, math.nan)), "position", joint.kind),
                show(float(speeds[i]), "velocity", joint.kind),
                show(joint.lower, "position", joint.kind),
                show(joint.upper, "position", joint.kind),
            ]
            for i, joint in enumerate(self._hand.joints)
        ]
        kinds = {joint.kind for joint in self._hand.joints}
        unit, speed = (self._angles.unit(name, kinds) for name in ("position", "velocity"))
        head = [f"joint [{unit}]", "pos", f"vel [{speed}]", "min", "max"]
        put(self._joints, table(head, rows, self._joint_lines))

    def show_status(self, status: HandStatus) -> None:
        """Show the timing of the loop and the counters of the buses."""
        s = status.statistics
        rows = [
            ["rate [Hz]", f"{s.measured_rate:.1f}", f"{s.rate:g}", ""],
            ["missed ticks", str(s.missed), f"of {s.ticks}", ""],
            ["lateness [µs] p50, p99, max"]
            + [f"{1e6 * v:.0f}" for v in (s.lateness_p50, s.lateness_p99, s.lateness_max)],
            ["busy [µs] p50, p99, max"]
            + [f"{1e6 * v:.0f}" for v in (s.busy_p50, s.busy_p99, s.busy_max)],
            ["log records dropped", str(s.dropped), "", ""],
        ]
        put(self._loop, table(("", "", "", ""), rows))
        counters = [
            [f"{device.name}: {name}", str(count)]
            for device in status.devices
            for name, count in sorted(device.counters.items())
        ]
        rates = [
            [f"{device.name}: exchanges [Hz]", f"{device.rate:.0f}"] for device in status.devices
        ]
        put(self._buses, table(("device", ""), rates + counters))
