"""Panel that grasps an object of a given width with a force, with the action that suits it best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from rtee.gui.bridge import Bridge
from rtee.gui.panels.execution import Execution
from rtee.gui.wording import offer
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.openings import OpeningRange

_ANY: Final = "any"
"""Choice that leaves the fingers to the hand."""

_JOINED: Final = " + "
"""Separator of the fingers of a choice."""


class HoldingPanel:
    """Width, force, speed and fingers, and a button that grasps."""

    def __init__(self, bridge: Bridge, hand: RemoteHand) -> None:
        """Add the panel to the current container, hidden until the hand has openings."""
        gui = bridge.server.gui
        self._bridge, self._hand = bridge, hand
        self._openings: tuple[OpeningRange, ...] = ()
        self._folder = gui.add_folder("Hold an object", expand_by_default=False, visible=False)
        with self._folder:
            self._width = gui.add_slider(
                "Width [mm]", 0.0, 1.0, 0.1, 0.0, hint="Width of the object [mm]", order=0
            )
            self._force = gui.add_slider(
                "Force [N]",
                0.0,
                1.0,
                0.1,
                0.0,
                hint="Force to hold it with [N]; 0: as hard as the hand closes",
                order=1,
            )
            self._speed = gui.add_slider(
                "Closing [mm/s]",
                0.0,
                200.0,
                5.0,
                0.0,
                hint="How fast the fingertips close [mm/s]; 0: as fast as the force allows",
                order=2,
            )
            self._fingers = gui.add_dropdown(
                "Fingers",
                (_ANY,),
                hint="Fingers to hold it with; any: those that suit it best",
                order=3,
            )
            self._button = gui.add_button(
                "Grasp", hint="Open wider than the object, close on it, keep the force", order=4
            )
            self._execution = Execution(bridge, hand, ())
        bridge.need(Role.OPERATOR, self._button)
        self._width.on_update(lambda _: self._offer_forces())
        self._fingers.on_update(lambda _: self._offer_widths())
        self._button.on_click(bridge.clicked(self._grasp))

    def offer(self, openings: Sequence[OpeningRange]) -> None:
        """Offer the openings and forces that goals may ask for."""
        self._openings = tuple(openings)
        self._folder.visible = bool(openings)
        if not openings:
            return
        groups = [_JOINED.join(each.elements) for each in openings if each.elements]
        offer(self._fingers, (_ANY, *dict.fromkeys(groups)))
        self._offer_widths()

    @property
    def _chosen(self) -> list[OpeningRange]:
        """The openings of the chosen fingers."""
        fingers = str(self._fingers.value)
        if fingers == _ANY:
            return list(self._openings)
        return [each for each in self._openings if _JOINED.join(each.elements) == fingers]

    def _offer_widths(self) -> None:
        """Limit the width to what the fingers reach around."""
        chosen = self._chosen
        # Round inwards to 0.1 mm, so that the hand refuses neither end. The fingers must open
        # wider than the object to get around it, hence 0.1 mm less than the widest opening.
        least = math.ceil(min(each.narrowest for each in chosen) * 1e4 - 1e-6) / 10.0
        most = math.floor(max(each.widest for each in chosen) * 1e4 + 1e-6) / 10.0 - 0.1
        most = max(most, least + 0.1)
        if (self._width.min, self._width.max) != (least, most):
            value = min(max(float(self._width.value), least), most)
            # The value last, since viser clips it to the range.
            self._width.max, self._width.min = most, least
            self._width.value = value
        self._offer_forces()

    def _offer_forces(self) -> None:
        """Limit the force to the largest that any of the actions exerts at the width."""
        width = float(self._width.value) / 1e3
        strongest = max(
            (
                each.forces_at(width)[1]
                for each in self._chosen
                if each.narrowest <= width < each.widest
            ),
            default=0.0,
        )
        most = math.floor(strongest * 10.0) / 10.0
        self._force.visible = most > 0.0
        if most <= 0.0:
            self._force.value = 0.0
        elif self._force.max != most:
            value = min(float(self._force.value), most)
            self._force.max = most
            self._force.value = value

    async def _grasp(self) -> None:
        fingers = str(self._fingers.value)
        # A force or speed of 0 is left out of the goal: the hand then uses its own.
        await self._execution.follow(
            self._hand.start_grasp(
                float(self._width.value) / 1e3,
                float(self._force.value) or None,
                float(self._speed.value) / 1e3 or None,
                None if fingers == _ANY else fingers.split(_JOINED),
            ),
            width=True,
        )
