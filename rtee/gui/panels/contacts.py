"""Settings of a card for fingers that touch something: for all of them, or finger by finger."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final

import viser

from rtee.gui.wording import offer, small
from rtee.remote.goal import GoalOptions
from rtee.types import OnContact

_AS_CONFIGURED: Final = "as configured"
"""Choice that leaves the setting out of the goal, so that hand.yaml decides."""

_ALL: Final = "all fingers"
"""Choice of all fingers that have no setting of their own."""

_SLIP_HINT: Final = (
    "Force up to which a slip raises the force [N]; 0: it is not raised. It goes with a force"
)


class ContactChoice:
    """A setting for all fingers, settings of single ones, and the force after a slip."""

    def __init__(self, gui: viser.GuiApi, fingers: Sequence[str]) -> None:
        """Add the controls to the current container, for the action's fingers if they are known."""
        # By finger; the empty name stands for all fingers.
        self._words: dict[str, OnContact] = {}
        self._finger = gui.add_dropdown(
            "Contact of", (_ALL,), hint="Which fingers the next field is about"
        )
        self._word = gui.add_dropdown(
            "On contact",
            (_AS_CONFIGURED, *OnContact),
            hint="stop: the finger stays where it touches. hold: it stays, and yields to more than "
            "a light force. squeeze: it waits until enough fingers touch, then all press together",
        )
        self._list = gui.add_html("", visible=False)
        self._slip = gui.add_slider(
            "If it slips, up to [N]", 0.0, 1.0, 0.1, 0.0, hint=_SLIP_HINT, visible=False
        )
        self._finger.on_update(self._on_finger)
        self._word.on_update(self._on_word)
        self.offer(fingers)

    def offer(self, fingers: Sequence[str]) -> None:
        """Offer the fingers of another action; drop the settings of other fingers."""
        self._words = {f: word for f, word in self._words.items() if f in ("", *fingers)}
        offer(self._finger, (_ALL, *fingers))
        self._finger.visible = len(fingers) > 1
        self._show()

    def limit(self, most: float) -> None:
        """Limit the force after a slip to the largest that a goal may ask for [N]; 0 hides it."""
        # Round down to the step of the slider, so that the hand does not refuse the end.
        top = math.floor(most * 10.0) / 10.0
        self._slip.visible = top > 0.0
        if top > 0.0:
            self._slip.max = top
        self._slip.value = min(float(self._slip.value), max(top, 0.0))

    def add_to(self, options: GoalOptions) -> None:
        """Add the settings to the options of a goal."""
        if self._words:
            options["on_contact"] = dict(self._words)
        if "force" in options and self._slip.value > 0.0:
            options["max_force"] = float(self._slip.value)

    @property
    def _chosen(self) -> str:
        """The finger that is being set, or the empty name for all."""
        return "" if self._finger.value == _ALL else str(self._finger.value)

    async def _on_finger(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._show()

    async def _on_word(self, event: viser.GuiEvent) -> None:
        if event.client is None:  # set by `_show`, not by a person
            return
        if self._word.value == _AS_CONFIGURED:
            self._words.pop(self._chosen, None)
        else:
            self._words[self._chosen] = OnContact(self._word.value)
        self._show()

    def _show(self) -> None:
        self._word.value = str(self._words.get(self._chosen, _AS_CONFIGURED))
        others = "others" if any(self._words) else _ALL
        items = [f"{escape(finger or others)}: {word}" for finger, word in self._words.items()]
        self._list.content = small(" · ".join(items))
        self._list.visible = any(self._words)
