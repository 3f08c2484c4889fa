"""Panels that edit actions: jog, save a posture, compose, sequence, rename, delete, undo."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.actions.types import Action, CustomAction, Primitive
from rtee.gui.bridge import Bridge
from rtee.gui.panels.jog import JogPanel
from rtee.gui.panels.parts import PartsPanel
from rtee.gui.panels.tuning import TuningPanel
from rtee.gui.wording import NOTHING, offer
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.remote.monitoring import HandStatus


class EditPanel:
    """Rename and delete custom actions; a deletion can be undone."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Add the panel to the current container."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._custom: dict[str, CustomAction] = {}
        self._deleted: list[CustomAction] = []
        self._which = gui.add_dropdown("Action", (NOTHING,), hint="Composed, timed or generic")
        self._name = gui.add_text("New name", "", hint="Letters, digits, _ - .")
        self._do = gui.add_button_group(
            "", ("Rename", "Delete", "Undo"), hint="Undo brings back what was deleted last"
        )
        bridge.need(Role.MAINTAINER, self._name, self._do)
        self._do.on_click(lambda event: self._clicked(str(event.target.value)))

    def offer(self, actions: Sequence[Action]) -> None:
        """Offer the custom actions among these."""
        # Primitives are left out: `rtee extract` writes them, and would write them again.
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
        self._deleted.pop()  # only now: if the hand refuses it, the user may try again
        self._bridge.notify("Undone", f"action '{action.name}' is there again", "green")


class MakingPanel:
    """The panels of the tab "Make"; `jog` is the first of them."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand) -> None:
        """Add the panel to the current container."""
        gui = bridge.server.gui
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
            save = gui.add_button(
                "Save as generic action", hint="Save the measured posture of all actuators"
            )
        with gui.add_folder("Compose or put in sequence", expand_by_default=False):
            self._parts = PartsPanel(bridge, remote)
        with gui.add_folder("Rename or delete", expand_by_default=False):
            self._edit = EditPanel(bridge, remote)
        with gui.add_folder("Tune", expand_by_default=False):
            self._tuning = TuningPanel(bridge, remote)
        bridge.need(Role.MAINTAINER, self._name, self._store, save)
        save.on_click(lambda _: bridge.call(self._save))

    async def _save(self) -> None:
        if self._state is None:
            return
        measured = {
            name: float(value)
            for name, value in zip(self._state.names, self._state.position, strict=True)
        }
        # A measured position may lie a little beyond a limit, which the hand would refuse.
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
