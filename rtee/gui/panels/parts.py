"""Panel that composes actions or puts them in sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from html import escape

from rtee.actions.build import StepPlan
from rtee.actions.types import Action, ActionReference, Timed
from rtee.gui.bridge import Bridge
from rtee.gui.wording import NOTHING, described, offer, small
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand


class PartsPanel:
    """A list of parts, and a name for the composed or timed action made of them."""

    def __init__(self, bridge: Bridge, remote: RemoteHand) -> None:
        """Add the panel to the current container."""
        gui = bridge.server.gui
        self._bridge = bridge
        self._remote = remote
        self._uses: dict[str, ActionReference] = {}
        self._parts: list[StepPlan] = []
        self._action = gui.add_dropdown("Action", (NOTHING,), hint="What to add")
        self._scale = gui.add_slider(
            "Scale [%]",
            0,
            100,
            1,
            100,
            hint="Share of the way from rest to the action's posture [%]",
        )
        self._before = gui.add_number(
            "Before [s]",
            0.0,
            min=0.0,
            max=60.0,
            step=0.1,
            hint="Margin before it, in a sequence [s]",
        )
        self._after = gui.add_number(
            "After [s]", 0.0, min=0.0, max=60.0, step=0.1, hint="Margin after it, in a sequence [s]"
        )
        self._add = gui.add_button("Add part", hint="Add it at the end of the list below")
        self._list = gui.add_html("")
        self._part = gui.add_dropdown("Part", (NOTHING,), hint="The part to move or remove")
        self._edit = gui.add_button_group(
            "", ("Up", "Down", "Remove"), hint="Move the chosen part in the list, or remove it"
        )
        self._name = gui.add_text("Name", "", hint="Letters, digits, _ - .")
        self._store = gui.add_checkbox("Store in the hand's folder", True, hint="As a YAML file")
        self._make = gui.add_button_group(
            "", ("Compose", "Sequence"), hint="Compose: all at once. Sequence: one after the other"
        )
        bridge.need(Role.MAINTAINER, self._name, self._store, self._make)
        self._add.on_click(lambda _: self._append())
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
        offer(self._action, self._uses)

    def _append(self) -> None:
        if self._action.value in self._uses:
            use = replace(self._uses[str(self._action.value)], scale=self._scale.value / 100.0)
            alias = self._alias(use.action)
            self._parts.append(
                StepPlan(use, alias, float(self._before.value), float(self._after.value))
            )
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

    def _alias(self, action: str) -> str:
        # The steps of a sequence are known by their aliases, which must differ.
        taken = {part.alias for part in self._parts}
        if action not in taken:
            return action
        return next(name for n in range(2, 1000) if (name := f"{action}_{n}") not in taken)

    def _draw(self, chosen: int = 0) -> None:
        lines = [
            f"{index}. {escape(described(part.use))}"
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
        name, store = str(self._name.value).strip(), bool(self._store.value)
        if button == "Compose":
            await self._remote.add_composed(name, [part.use for part in self._parts], store=store)
        else:
            await self._remote.add_timed(name, list(self._parts), store=store)
        self._parts.clear()  # only now: after a refusal, the user goes on with the same parts
        self._draw()
        self._bridge.notify("Saved", f"action '{name}'", "green")
