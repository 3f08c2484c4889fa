"""Cards of all actions of a hand, grouped by kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from rtee.actions.types import Action, ActionKind, kind_of
from rtee.gui.bridge import Bridge
from rtee.gui.panels.cards import Card, Show
from rtee.gui.panels.execution import Execution
from rtee.gui.trial_results import Tried
from rtee.gui.wording import JOINED, offer
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.goal_values import grasp_goal
from rtee.remote.openings import OpeningRange
from rtee.trials.result import TrialResult

_FEW = 1
"""Number of primitives whose cards are open at first, so that all kinds of them are in sight."""


def grouped(actions: Sequence[Action]) -> dict[tuple[ActionKind, str], list[Action]]:
    """Return the actions by kind and name; the primitives of one name share a card."""
    groups: dict[tuple[ActionKind, str], list[Action]] = {}
    for kind in ActionKind:
        for action in actions:
            if kind_of(action) is kind:
                groups.setdefault((kind, action.name), []).append(action)
    return groups


class ActionsPanel:
    """The cards, with a search field above them."""

    def __init__(
        self,
        bridge: Bridge,
        hand: RemoteHand,
        show: Show,
        remark: Callable[[Action], str] = lambda action: "",
    ) -> None:
        """Add the panel to the current container; `refresh` fills it."""
        gui = bridge.stage.gui
        self._bridge = bridge
        self._hand = hand
        self._show = show
        self._remark = remark
        self._holding = HoldingPanel(bridge, hand)
        self._search = gui.add_text(
            "Search", "", hint="Show only actions whose name or elements contain this"
        )
        self._search.on_update(lambda _: self._filter())
        titles = {kind: kind.capitalize() for kind in ActionKind}
        titles[ActionKind.PRIMITIVE] = "Primitives"
        self._folders = {kind: gui.add_folder(title) for kind, title in titles.items()}
        self._cards: dict[tuple[ActionKind, str], Card] = {}
        self._known: dict[tuple[ActionKind, str], tuple[str, ...]] = {}
        self._tried = Tried()
        self._moves: dict[str, tuple[str, ...]] = {}

    @property
    def cards(self) -> dict[tuple[ActionKind, str], Card]:
        """The cards by kind and name."""
        return dict(self._cards)

    async def refresh(self) -> list[Action]:
        """Return the hand's present actions; rebuild the cards of those that have changed."""
        actions = await self._hand.actions()
        offered = await self._hand.openings()
        openings = {(each.action, each.elements): each for each in offered}
        self._holding.offer(offered)
        if not self._moves:  # which fingers an actuator moves does not change
            self._moves = {a.name: a.fingers for a in (await self._hand.info()).actuators}
        groups = grouped(sorted(actions, key=self._rank))
        for key in [key for key in self._cards if key not in groups]:
            self._cards.pop(key).remove()
            del self._known[key]
        for place, (key, group) in enumerate(groups.items()):
            # Rebuilding a card would reset what the user has set in its controls. As text, since
            # postures hold arrays, whose comparison gives an array instead of a bool.
            signature = tuple(map(repr, group))
            if self._known.get(key) == signature:
                self._cards[key].place(place)
                self._cards[key].show_openings(openings)
                continue
            if key in self._cards:
                self._cards.pop(key).remove()
            with self._folders[key[0]]:
                self._cards[key] = Card(
                    self._bridge,
                    self._hand,
                    group,
                    self._show,
                    expanded=place < _FEW or key[0] is not ActionKind.PRIMITIVE,
                    order=place,
                    remark=self._remark,
                    fingers=self._fingers,
                )
            self._cards[key].show_openings(openings)
            self._cards[key].show_trials(self._tried)
            self._known[key] = signature
        self._filter()
        return actions

    def _rank(self, action: Action) -> tuple[bool, float]:
        """Return the sort key of actions: the pinch first, then the most successful in trials."""
        results = [
            result
            for key, found in self._tried.results.items()
            if key[0] == action.name
            for result in found
        ]
        held = sum(result.held for result in results) / max(len(results), 1)
        return action.name != "PinchTight", -held

    def _fingers(self, action: Action) -> tuple[str, ...]:
        """Return the fingers that an action moves, in the hand's order of actuators."""
        involved = {name for posture in action.waypoints for name in posture.involved}
        moved = [f for name, fingers in self._moves.items() if name in involved for f in fingers]
        return tuple(dict.fromkeys(moved))

    def show_trials(self, tried: Tried) -> None:
        """Show stored results of trials beside those of this page."""
        self._tried = replace(tried, own={**self._tried.own, **tried.own})
        self._show_tried()

    def add_trial(self, result: TrialResult) -> None:
        """Show the result of a trial that was started in this page."""
        self._tried = self._tried.with_own(result)
        self._show_tried()

    def _show_tried(self) -> None:
        for card in self._cards.values():
            card.show_trials(self._tried)

    def fade(self) -> None:
        """Mark results as old that say nothing of now."""
        self._holding.fade()
        for card in self._cards.values():
            card.fade()

    def remove(self) -> None:
        """Remove the cards with their commands, which are not part of any folder."""
        while self._cards:
            self._cards.popitem()[1].remove()

    def _filter(self) -> None:
        wanted = str(self._search.value).lower().split()
        # In one message; otherwise each card would appear or vanish by itself.
        with self._bridge.stage.atomic():
            for card in self._cards.values():
                card.visible = all(word in card.words for word in wanted)
            for kind, folder in self._folders.items():
                folder.visible = any(
                    card.visible for key, card in self._cards.items() if key[0] is kind
                )


_WIDTH: Final = 30.0
"""Width of an object that is offered first [mm]: that of a bottle's neck, for most hands."""

_ANY: Final = "any"
"""Choice that leaves the fingers to the hand."""


class HoldingPanel:
    """Width, force, speed and fingers, and a button that grasps."""

    def __init__(self, bridge: Bridge, hand: RemoteHand) -> None:
        """Add the panel to the current container, hidden until the hand has openings."""
        gui = bridge.stage.gui
        self._bridge, self._hand = bridge, hand
        self._openings: tuple[OpeningRange, ...] = ()
        self._folder = gui.add_folder("Hold an object", visible=False)
        with self._folder:
            self._width = gui.add_slider(
                "Width [mm]", 0.0, _WIDTH, 0.1, _WIDTH, hint="Width of the object [mm]", order=0
            )
            self._force = gui.add_slider(
                "Force [N]",
                0.0,
                1.0,
                0.1,
                0.0,
                hint="Force to hold it with [N]; 0: automatic, as hard as the hand closes",
                order=1,
            )
            self._button = gui.add_button(
                "Grasp", hint="Open wider than the object, close on it, keep the force", order=2
            )
            with gui.add_folder("More", expand_by_default=False, order=7):
                self._speed = gui.add_slider(
                    "Closing [mm/s]",
                    0.0,
                    200.0,
                    5.0,
                    0.0,
                    hint="How fast the fingertips close [mm/s]; 0: automatic, as the force allows",
                )
                self._fingers = gui.add_dropdown(
                    "Fingers",
                    (_ANY,),
                    hint="Fingers to hold it with; any: those that suit it best",
                )
            self._execution = Execution(bridge, hand, asked=self._asked)
            self.fade = self._execution.fade
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
        groups = [JOINED.join(each.elements) for each in openings if each.elements]
        offer(self._fingers, (_ANY, *dict.fromkeys(groups)))
        self._offer_widths()

    @property
    def _chosen(self) -> list[OpeningRange]:
        """The openings of the chosen fingers."""
        fingers = str(self._fingers.value)
        if fingers == _ANY:
            return list(self._openings)
        return [each for each in self._openings if JOINED.join(each.elements) == fingers]

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

    def _asked(self) -> tuple[float, float, float, str]:
        """Return width [mm], force [N], speed [mm/s] and fingers as they are set."""
        width, force, speed = (
            float(each.value) for each in (self._width, self._force, self._speed)
        )
        return width, force, speed, str(self._fingers.value)

    async def _grasp(self) -> None:
        width, force, speed, fingers = self._asked()
        # A force or speed of 0 is left out of the goal: the hand then uses its own.
        goal = grasp_goal(
            width / 1e3,
            force=force or None,
            tip_speed=speed / 1e3 or None,
            fingers=None if fingers == _ANY else fingers.split(JOINED),
        )
        await self._execution.follow(self._hand.start_goal(goal))
