"""Panels that edit actions: jog, save a posture, compose, sequence, rename, delete, undo."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from html import escape

import anyio
import viser

from rtee.actions.build import StepPlan
from rtee.actions.describe import described
from rtee.actions.types import Action, ActionReference, CustomAction, Primitive, Timed
from rtee.errors import RemoteError, RequestRejected
from rtee.gui.bridge import Bridge
from rtee.gui.panels.actions import Show
from rtee.gui.panels.execution import Execution
from rtee.gui.wording import NOTHING, mark, offer, short_names, small
from rtee.hand.model import Hand
from rtee.hand.names import free_name
from rtee.messages.requests import Role
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.remote.goal_values import GoalOptions
from rtee.remote.monitoring import HandStatus
from rtee.remote.truth import Turn


class EditPanel:
    """Rename and delete custom actions; a deletion can be undone."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Add the panel to the current container."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._remote = remote
        self._custom: dict[str, CustomAction] = {}
        self._deleted: list[CustomAction] = []
        self._which = gui.add_dropdown("Action", (NOTHING,), hint="Composed, timed or generic")
        self._name = gui.add_text("New name", "", hint="Letters, digits, _ - .")
        self._do = gui.add_button_group(
            "", ("Rename", "Delete", "Undo"), hint="Undo restores the action deleted last"
        )
        bridge.need(Role.MAINTAINER, self._name, self._do)
        self._do.on_click(lambda event: self._clicked(str(event.target.value)))

    def offer(self, actions: Sequence[Action]) -> None:
        """Offer the custom actions among ``actions``."""
        # Leave primitives out: `rtee extract` writes them, and would write them again.
        self._custom = {a.name: a for a in actions if not isinstance(a, Primitive)}
        offer(self._which, self._custom)

    def _clicked(self, button: str) -> None:
        work = {"Rename": self._rename, "Delete": self._delete, "Undo": self._undo}[button]
        self._bridge.call(work)

    async def _rename(self) -> None:
        if self._which.value in self._custom:
            old, name = str(self._which.value), str(self._name.value).strip()
            await self._remote.rename_action(old, name)
            self._bridge.notify("Renamed", f"'{old}' is now '{name}'", "green")

    async def _delete(self) -> None:
        action = self._custom.get(str(self._which.value))
        if action is not None:
            await self._remote.remove_action(action.name)
            self._deleted.append(action)
            self._bridge.notify("Deleted", f"'{action.name}'; Undo brings it back", "orange")

    async def _undo(self) -> None:
        if not self._deleted:
            self._bridge.notify("Undo", "nothing was deleted", "gray")
            return
        action = self._deleted[-1]
        await self._remote.add_action(action, store=True)
        self._deleted.pop()  # only now: if the hand refuses the action, the user may try again
        self._bridge.notify("Undone", f"action '{action.name}' is there again", "green")


class MakingPanel:
    """The panels of the tab "Teach"; `jog` is the first panel."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand, show: Show) -> None:
        """Add the panels to the current container; ``show`` shows a posture as a ghost."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        self._state: State | None = None
        with gui.add_folder("Jog"):
            self.jog = JogPanel(bridge, remote, hand)
        with gui.add_folder("Save this posture"):
            self._name = gui.add_text("Name", "", hint="Letters, digits, _ - .")
            self._store = gui.add_checkbox(
                "Store in the hand's folder", True, hint="As a YAML file"
            )
            save = gui.add_button("Save pose", hint="Save the measured posture of all actuators")
        with gui.add_folder("Combine actions"):
            self._parts = PartsPanel(bridge, remote, show)
        self.fade = self._parts.fade
        with gui.add_folder("Rename or delete", expand_by_default=False):
            self._edit = EditPanel(bridge, remote)
        with gui.add_folder("Tune", expand_by_default=False):
            self._tuning = TuningPanel(bridge, remote)
        # rtee/gui/fields.js takes a number in these fields only by Enter.
        at_once = json.dumps((*self.jog.labels, self._tuning.label))
        gui.add_html(f'<i data-rtee-at-once="{escape(at_once)}"></i>')
        bridge.need(Role.MAINTAINER, self._name, self._store, save)
        save.on_click(lambda _: bridge.call(self._save))

    async def _save(self) -> None:
        if self._state is None:
            return
        measured = {
            name: float(value)
            for name, value in zip(self._state.names, self._state.position, strict=True)
        }
        # The hand would refuse a measured position that lies slightly beyond a limit.
        within = dict(
            zip(measured, self._hand.clamp(list(measured.values())).tolist(), strict=True)
        )
        name = str(self._name.value).strip()
        await self._remote.add_generic(name, within, store=bool(self._store.value))
        self._bridge.notify("Saved", f"action '{name}'", "green")

    def show_actions(self, actions: Sequence[Action]) -> None:
        """Offer these actions as parts and for editing."""
        self._parts.offer(actions)
        self._edit.offer(actions)

    def show_state(self, state: State) -> None:
        """Show the measured state."""
        self._state = state
        self.jog.follow(state)

    def show_status(self, status: HandStatus) -> None:
        """Show the status of the hand."""
        self._tuning.show(status)


class TuningPanel:
    """The grip effort and the devices' gains."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Add the panel to the current container."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._remote = remote
        self._gains: dict[str, tuple[str, str]] = {}
        # Gains by label: reported by devices, and set here, for devices that do not report any.
        self._reported: dict[str, float] = {}
        self._set_before: dict[str, float] = {}
        # Whether the field holds a known value of the gain; a first click must not set it to 0.
        self._typed = False
        # Value last reported by the hand; an entered value stays until the hand reports another.
        self._said: float | None = None
        self._holding = gui.add_slider(
            "Holding effort [%]",
            0,
            100,
            1,
            40,
            hint="Effort while holding an object, as a percentage of the effort limit [%]",
        )
        self._which = gui.add_dropdown("Gain", (NOTHING,), hint="Gain of a device", visible=False)
        self._value = gui.add_number(
            "Value",
            0.0,
            step=0.001,
            hint="In the device's own unit; some devices do not report the present value",
            visible=False,
        )
        self._set = gui.add_button("Set gain", hint="Change it now; needs the lease", visible=False)
        bridge.need(Role.MAINTAINER, self._holding, self._value, self._set)
        self._holding.on_update(bridge.entered(self._hold))
        self._which.on_update(lambda _: self._recall())
        self._value.on_update(lambda _: self._type())
        self._set.on_click(lambda _: bridge.call(self._change))

    @property
    def label(self) -> str:
        """Label of the field that sets the grip effort at once."""
        return str(self._holding.label)

    def _hold(self, percent: float) -> None:
        if self._bridge.refused:
            self._said = None  # show the hand's value again
        self._bridge.call(partial(self._keep, percent / 100.0))

    async def _keep(self, share: float) -> None:
        try:
            await self._remote.set_gains({"grip_effort": share})
        except RemoteError:
            self._said = None
            raise

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
        if share != self._said:
            self._said = self._holding.value = share
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
        if gains == self._gains:  # keep the user's choice and input
            return
        self._gains = gains
        self._which.options = tuple(gains) or (NOTHING,)
        self._which.value = self._which.options[0]
        self._recall()
        for control in (self._which, self._value, self._set):
            control.visible = bool(gains)


_FOLD = 12
"""Largest number of actuators whose sliders are shown at first: more would fill the panel."""

_RATE = 30.0
"""Sample rate while the hand follows the sliders [Hz]: browsers hardly report more often."""

_LEAVE_WITHIN = 0.5
"""Longest time to wait for the release of the lease [s]: the hand may already be gone."""

_CLICK = {"rad": 0.02, "m": 0.001}
"""Step of a click on − or + by unit [rad | m]: about a degree, or a millimetre."""

_STEPS = {"rad": 0.001, "m": 0.0001}
"""Step of a slider by unit [rad | m]: finer than the repeatability of a hand."""


class JogPanel:
    """A slider per actuator, which moves the hand while this GUI holds the lease."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand) -> None:
        """Add the panel to the current container."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        self._hold = gui.add_checkbox(
            "Jog (holds the hand)", False, hint="While ticked, nobody else can move the hand"
        )
        self._speed = gui.add_slider(
            "Jog speed [%]", 5, 100, 5, 25, hint="Percentage of the actuators' velocity limits [%]"
        )
        self._follow = gui.add_checkbox(
            "Move live",
            False,
            hint="Stream the sliders' positions: the hand follows them at once, as fast as its "
            "limits allow",
        )
        self._left = False
        self._wanted: dict[str, float] = {}
        self._moved_after: Turn | None = None  # the turn in which a person last moved a slider
        self._streamed = ""
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        with gui.add_folder("Actuators", expand_by_default=len(hand.actuators) <= _FOLD):
            names = short_names(hand.actuator_names)
            for index, actuator in enumerate(hand.actuators):
                # A continuous joint has no limits or wide ones; its slider covers one turn.
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
                    hint=f"Position of {actuator.name} [{unit}]; moves it while Jog is ticked, "
                    "a typed number once you press Enter",
                )
                slider.on_update(bridge.entered(partial(self._moved, index)))
                self._sliders.append(slider)
            self._which = gui.add_dropdown(
                "Step", names, hint="The actuator that − and + move, by 0.02 rad or 1 mm"
            )
            step = gui.add_button_group(
                "", ("−", "+"), hint="Move it by a small step; needs Jog, as the sliders do"
            )
        bridge.need(Role.OPERATOR, step)
        step.on_click(lambda event: self._step(1.0 if event.target.value == "+" else -1.0))
        bridge.need(Role.OPERATOR, self._hold, self._speed, self._follow)
        self._hold.on_update(lambda _: bridge.call(self._acquire_or_release))
        self._follow.on_update(lambda _: bridge.call(self._stream))

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the sliders, whose numbers move the hand at once."""
        return tuple(slider.label for slider in self._sliders)

    async def _acquire_or_release(self) -> None:
        try:
            await (
                self._remote.acquire_lease() if self._hold.value else self._remote.release_lease()
            )
        except RemoteError:
            self._hold.value = False
            raise
        finally:
            # Without the lease, the hand would refuse every motion of a slider.
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
                self._streamed = stream.name
                while self.holding and self._follow.value:
                    if self._wanted:
                        await stream.send(dict(self._wanted))
                    await anyio.sleep(1.0 / _RATE)
        except RemoteError:
            self._follow.value = False
            raise

    def _moved(self, index: int, value: float) -> None:
        if not self._hold.value:
            return
        self._moved_after = self._bridge.truth.turn
        actuator = self._hand.actuators[index]
        if self._follow.value:
            self._wanted[actuator.name] = value
            return
        speed = actuator.velocity * self._speed.value / 100.0
        self._bridge.call(lambda: self._remote.jog({actuator.name: value}, speed))

    def _step(self, sign: float) -> None:
        index = list(self._which.options).index(self._which.value)
        slider = self._sliders[index]
        step = _CLICK["m" if slider.label.endswith("[m]") else "rad"]
        slider.value = min(max(slider.value + sign * step, slider.min), slider.max)
        self._moved(index, slider.value)

    @property
    def holding(self) -> bool:
        """Whether this GUI holds the hand for jogging."""
        return bool(self._hold.value) and not self._left

    def give_back(self) -> None:
        """Untick the box, which releases the lease and ends the stream of the sliders."""
        self._hold.value = False

    async def leave(self) -> None:
        """Release the lease if this GUI holds it; do not wait long for a hand that has gone."""
        # Not by unticking the box: its window may have gone.
        held, self._left = self.holding, True
        if held:
            with contextlib.suppress(RemoteError), anyio.move_on_after(_LEAVE_WITHIN):
                await self._remote.release_lease()

    def follow(self, state: State) -> None:
        """Mark the measured positions on the sliders.

        Sliders follow the measured positions, except those that a person has moved. A stop, or
        another motion of the hand, also resets the moved sliders.
        """
        turn = self._bridge.truth.turn
        moved = self._hold.value and (
            self._moved_after is turn or turn.goal == self._streamed != ""
        )
        if not moved:
            self._wanted.clear()
        for slider, position in zip(self._sliders, state.position, strict=True):
            value = min(max(float(position), slider.min), slider.max)
            # Skip NaN, and changes within the noise of a measurement.
            if value != value:
                continue
            off = abs(value - slider.value) > 2.0 * slider.step
            if off and not moved:
                slider.value = value
            mark(slider, *([(value, "measured")] if off and moved else ()))


class PartsPanel:
    """A list of parts, and the composed or timed action made of them."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, show: Show) -> None:
        """Add the panel to the current container; ``show`` shows a posture as a ghost."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._remote = remote
        self._show = show
        self._uses: dict[str, ActionReference] = {}
        self._parts: list[StepPlan] = []
        self._made: Action | None = None
        self._scale = gui.add_slider(
            "Scale [%]",
            0,
            100,
            1,
            100,
            hint="Percentage of the way from rest to the action's posture [%]",
        )
        margin = partial(gui.add_number, initial_value=0.0, min=0.0, max=60.0, step=0.1)
        self._before = margin("Before [s]", hint="Margin before the action, in a sequence [s]")
        self._after = margin("After [s]", hint="Margin after the action, in a sequence [s]")
        self._action = gui.add_dropdown(
            "Add", (NOTHING,), hint="The action to append to the list, with the settings above"
        )
        self._list = gui.add_html("")
        self._part = gui.add_dropdown("Part", (NOTHING,), hint="The part to move or remove")
        self._edit = gui.add_button_group(
            "", ("Up", "Down", "Remove"), hint="Move the chosen part in the list, or remove it"
        )
        self._name = gui.add_text("Name", "", hint="Letters, digits, _ - .; empty: from its parts")
        self._store = gui.add_checkbox("Store in the hand's folder", True, hint="As a YAML file")
        self._make = gui.add_button_group(
            "", ("Compose", "Sequence"), hint="Compose: all at once. Sequence: one after the other"
        )
        self._run = gui.add_button("Run it", hint="Execute the last new action", visible=False)
        self._execution = Execution(bridge, remote)
        self.fade = self._execution.fade
        bridge.need(Role.MAINTAINER, self._name, self._store, self._make)
        bridge.need(Role.OPERATOR, self._run)
        self._action.on_update(lambda _: self._append())
        self._run.on_click(bridge.clicked(self._do))
        self._edit.on_click(lambda event: self._edited(str(event.target.value)))
        self._make.on_click(
            lambda event: bridge.call(partial(self._make_action, str(event.target.value)))
        )
        self._draw()

    def offer(self, actions: Sequence[Action]) -> None:
        """Offer these actions as parts."""
        # A timed action cannot be a part of another action.
        uses = [ActionReference(a.name, a.elements) for a in actions if not isinstance(a, Timed)]
        self._uses = {described(use): use for use in uses}
        offer(self._action, (NOTHING, *self._uses))

    def _append(self) -> None:
        if self._action.value in self._uses:
            use = replace(self._uses[str(self._action.value)], scale=self._scale.value / 100.0)
            # Aliases identify the steps of a sequence, and must differ.
            alias = free_name(use.action, {part.alias for part in self._parts})
            self._parts.append(
                StepPlan(use, alias, float(self._before.value), float(self._after.value))
            )
            self._action.value = NOTHING
            self._draw(len(self._parts) - 1)

    def _edited(self, button: str) -> None:
        names = tuple(self._part.options)
        if not self._parts or self._part.value not in names:
            return
        at = names.index(self._part.value)
        to = at + {"Up": -1, "Down": 1, "Remove": 0}[button]
        if button == "Remove":
            del self._parts[at]
        elif 0 <= to < len(self._parts):
            self._parts[at], self._parts[to] = self._parts[to], self._parts[at]
        self._draw(to)

    def _draw(self, chosen: int = 0) -> None:
        lines = [
            f"{index}. {escape(described(ActionReference.of(part.use)))}"
            + (f" · {part.before:g} s before" if part.before else "")
            + (f" · {part.after:g} s after" if part.after else "")
            for index, part in enumerate(self._parts, 1)
        ]
        text = "<br>".join(lines) or "no parts yet"
        self._list.content = small(text)
        names = [f"{index}. {part.alias}" for index, part in enumerate(self._parts, 1)] or [NOTHING]
        self._part.options = names
        self._part.value = names[min(max(chosen, 0), len(names) - 1)]

    async def _make_action(self, button: str) -> None:
        parts = [ActionReference.of(part.use).action for part in self._parts]
        known = {use.action for use in self._uses.values()}
        name = str(self._name.value).strip() or free_name("_".join(parts), known)
        store = bool(self._store.value)
        if button == "Compose":
            await self._remote.add_composed(name, [part.use for part in self._parts], store=store)
        else:
            await self._remote.add_timed(name, list(self._parts), store=store)
        self._parts.clear()  # only now: after a refusal, the user can continue with the same parts
        self._draw()
        self._bridge.notify("Saved", f"action '{name}'", "green")
        (self._made,) = await self._remote.actions(name=name)
        self._run.visible = True
        self._show(self._made.waypoints[-1], 1.0, None)

    async def _do(self) -> None:
        self._show(None, 0.0, None)
        if self._made is not None:
            await self._execution.do(self._made, GoalOptions(), 1.0)
