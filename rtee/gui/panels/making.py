"""Making actions: jog, save a posture, compose, put in sequence, rename, delete, undo."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from html import escape

import viser

from rtee.actions.build import StepPlan
from rtee.actions.types import (
    Action,
    ActionKind,
    ActionReference,
    Composed,
    Generic,
    Primitive,
    Timed,
    kind_of,
)
from rtee.errors import RequestRejected
from rtee.gui.bridge import Bridge
from rtee.gui.panels.cards import described
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.remote.views import HandStatus

Refresh = Callable[[], Awaitable[object]]

_FOLD = 12
_NONE = "–"


class JogPanel:
    """A slider per actuator; moves the hand while this GUI holds it."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand) -> None:
        """Put it where the GUI builds now."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        self._quiet = False
        self._hold = gui.add_checkbox(
            "Jog (holds the hand)", False, hint="While ticked, nobody else can move the hand"
        )
        self._speed = gui.add_slider(
            "Jog speed [%]", 5, 100, 5, 25, hint="Share of the actuators' velocity limits"
        )
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        with gui.add_folder("Actuators", expand_by_default=len(hand.actuators) <= _FOLD):
            for index, actuator in enumerate(hand.actuators):
                lower = actuator.lower if actuator.lower > -7.0 else -3.1416
                upper = actuator.upper if actuator.upper < 7.0 else 3.1416
                slider = gui.add_slider(
                    actuator.name,
                    lower,
                    upper,
                    (upper - lower) / 1000.0,
                    min(max(actuator.rest, lower), upper),
                    disabled=True,
                    hint=f"Position of {actuator.name} [rad | m]",
                )
                slider.on_update(lambda _, at=index: self._moved(at))
                self._sliders.append(slider)
        self._hold.on_update(lambda _: bridge.call(self._take_or_give))

    async def _take_or_give(self) -> None:
        try:
            await (self._remote.take() if self._hold.value else self._remote.release())
        except RequestRejected:
            self._hold.value = False
            raise
        finally:
            for slider in self._sliders:
                slider.disabled = not self._hold.value

    def _moved(self, index: int) -> None:
        if self._quiet or not self._hold.value:
            return
        actuator = self._hand.actuators[index]
        value = float(self._sliders[index].value)
        speed = actuator.velocity * self._speed.value / 100.0
        self._bridge.call(lambda: self._remote.jog({actuator.name: value}, speed))

    def follow(self, state: State) -> None:
        """Let the sliders follow the hand while nobody jogs."""
        if self._hold.value:
            return
        self._quiet = True
        try:
            for slider, position in zip(self._sliders, state.position, strict=True):
                value = min(max(float(position), slider.min), slider.max)
                if value == value and abs(value - slider.value) > 2.0 * slider.step:
                    slider.value = value
        finally:
            self._quiet = False


class PartsPanel:
    """Composing actions and putting them in sequence: a list of parts, then a name."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Put it where the GUI builds now."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._uses: dict[str, ActionReference] = {}
        self._parts: list[StepPlan] = []
        self._what = gui.add_dropdown("Action", (_NONE,), hint="What to add")
        self._scale = gui.add_slider(
            "Scale [%]", 0, 100, 1, 100, hint="Share of the way from rest to the action's posture"
        )
        self._before = gui.add_number(
            "Before [s]", 0.0, min=0.0, max=60.0, step=0.1, hint="Margin before it, in a sequence"
        )
        self._after = gui.add_number(
            "After [s]", 0.0, min=0.0, max=60.0, step=0.1, hint="Margin after it, in a sequence"
        )
        self._edit = gui.add_button_group(
            "", ("Add", "Move up", "Remove"), hint="Add a part; move up or remove the last one"
        )
        self._list = gui.add_html("")
        self._name = gui.add_text("Name", "", hint="Letters, digits, _ - .")
        self._store = gui.add_checkbox("Store in the hand's folder", True, hint="As a YAML file")
        self._make = gui.add_button_group(
            "", ("Compose", "Sequence"), hint="Compose: all at once. Sequence: one after the other"
        )
        self._edit.on_click(lambda event: self._edited(str(event.target.value)))
        self._make.on_click(lambda event: self._save(str(event.target.value)))
        self._draw()

    def offer(self, actions: Sequence[Action]) -> None:
        """Offer these actions as parts."""
        self._uses = {}
        for action in actions:
            elements = action.elements if isinstance(action, Primitive) else ()
            if not isinstance(action, Timed):
                use = ActionReference(action.name, elements)
                self._uses[described(use)] = use
        names = tuple(self._uses) or (_NONE,)
        if tuple(self._what.options) != names:
            kept = self._what.value if self._what.value in names else names[0]
            self._what.options = names
            self._what.value = kept

    def _edited(self, what: str) -> None:
        if what == "Add" and self._what.value in self._uses:
            use = replace(self._uses[str(self._what.value)], scale=self._scale.value / 100.0)
            alias = self._alias(use.action)
            self._parts.append(
                StepPlan(use, alias, float(self._before.value), float(self._after.value))
            )
        elif what == "Remove" and self._parts:
            self._parts.pop()
        elif what == "Move up" and len(self._parts) > 1:
            self._parts[-2:] = self._parts[:-3:-1]
        self._draw()

    def _alias(self, action: str) -> str:
        taken = {part.alias for part in self._parts}
        if action not in taken:
            return action
        return next(name for n in range(2, 1000) if (name := f"{action}_{n}") not in taken)

    def _draw(self) -> None:
        lines = [
            f"{index}. {escape(described(part.use))}"
            + (f" · {part.before:g} s before" if part.before else "")
            + (f" · {part.after:g} s after" if part.after else "")
            for index, part in enumerate(self._parts, 1)
        ]
        text = "<br>".join(lines) or "no parts yet"
        self._list.content = f'<div style="font-size:0.8em;padding:0 0.75em">{text}</div>'

    def _save(self, what: str) -> None:
        self._bridge.call(lambda: self._make_action(what))

    async def _make_action(self, what: str) -> None:
        name, store = str(self._name.value).strip(), bool(self._store.value)
        if what == "Compose":
            await self._remote.add_composed(name, [part.use for part in self._parts], store=store)
        else:
            await self._remote.add_timed(name, list(self._parts), store=store)
        self._parts.clear()
        self._draw()
        self._bridge.tell("Saved", f"action '{name}'", "green")


class EditPanel:
    """Rename and delete custom actions; a deletion can be undone."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Put it where the GUI builds now."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._custom: dict[str, Action] = {}
        self._deleted: list[Action] = []
        self._which = gui.add_dropdown("Action", (_NONE,), hint="Composed, timed or generic")
        self._name = gui.add_text("New name", "", hint="Letters, digits, _ - .")
        self._do = gui.add_button_group(
            "", ("Rename", "Delete", "Undo"), hint="Undo brings back what was deleted last"
        )
        self._do.on_click(lambda event: self._clicked(str(event.target.value)))

    def offer(self, actions: Sequence[Action]) -> None:
        """Offer the custom actions among these."""
        self._custom = {a.name: a for a in actions if kind_of(a) is not ActionKind.PRIMITIVE}
        names = tuple(self._custom) or (_NONE,)
        if tuple(self._which.options) != names:
            kept = self._which.value if self._which.value in names else names[0]
            self._which.options = names
            self._which.value = kept

    def _clicked(self, what: str) -> None:
        work = {"Rename": self._rename, "Delete": self._delete, "Undo": self._undo}[what]
        self._bridge.call(work)

    async def _rename(self) -> None:
        if self._which.value in self._custom:
            name = str(self._name.value).strip()
            await self._remote.rename_action(str(self._which.value), name)

    async def _delete(self) -> None:
        action = self._custom.get(str(self._which.value))
        if action is not None:
            await self._remote.remove_action(action.name)
            self._deleted.append(action)
            self._bridge.tell("Deleted", f"'{action.name}'; Undo brings it back", "orange")

    async def _undo(self) -> None:
        if not self._deleted:
            self._bridge.tell("Undo", "nothing was deleted", "gray")
            return
        action = self._deleted[-1]
        match action:
            case Composed():
                await self._remote.add_composed(
                    action.name,
                    action.parts,
                    independent=action.independent,
                    description=action.description,
                    store=True,
                )
            case Timed():
                steps = [StepPlan(s.use, s.alias, s.before, s.after) for s in action.steps]
                await self._remote.add_timed(
                    action.name, steps, description=action.description, store=True
                )
            case Generic():
                points = {name: action.posture.position[name] for name in action.posture.involved}
                await self._remote.add_generic(
                    action.name, points, description=action.description, store=True
                )
        self._deleted.pop()


class MakingPanel:
    """Everything with which people make actions."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand, refresh: Refresh) -> None:
        """Put the panel where the GUI builds now."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        self._state: State | None = None
        with gui.add_folder("Jog"):
            self._jog = JogPanel(bridge, remote, hand)
        with gui.add_folder("Save this posture"):
            self._name = gui.add_text("Name", "", hint="Letters, digits, _ - .")
            self._store = gui.add_checkbox(
                "Store in the hand's folder", True, hint="As a YAML file"
            )
            save = gui.add_button(
                "Save as generic action", hint="Save the measured posture of all actuators"
            )
        with gui.add_folder("Compose or put in sequence", expand_by_default=False):
            self._parts = PartsPanel(bridge, remote)
        with gui.add_folder("Rename or delete", expand_by_default=False):
            self._edit = EditPanel(bridge, remote)
        save.on_click(lambda _: bridge.call(self._save))

    async def _save(self) -> None:
        if self._state is None:
            return
        measured = {
            name: float(value)
            for name, value in zip(self._state.names, self._state.position, strict=True)
        }
        within = dict(
            zip(measured, self._hand.clamp(list(measured.values())).tolist(), strict=True)
        )
        name = str(self._name.value).strip()
        await self._remote.add_generic(name, within, store=bool(self._store.value))
        self._bridge.tell("Saved", f"action '{name}'", "green")

    def show_actions(self, actions: Sequence[Action]) -> None:
        """Offer these actions."""
        self._parts.offer(actions)
        self._edit.offer(actions)

    def show_state(self, state: State) -> None:
        """Take the measured state."""
        self._state = state
        self._jog.follow(state)

    def show_status(self, status: HandStatus) -> None:
        """Take how the hand is doing."""
