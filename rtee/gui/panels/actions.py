"""Cards of all actions of a hand, grouped by kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Final

import viser

from rtee.actions.describe import described
from rtee.actions.types import Action, ActionKind, Evidence, Posture, Primitive, Timed, kind_of
from rtee.gui.bridge import Bridge
from rtee.gui.panels.execution import Execution
from rtee.gui.trial_results import Tried, key_of, object_name, verdict
from rtee.gui.trial_results import line as tried_line
from rtee.gui.trial_results import table as tried_table
from rtee.gui.wording import JOINED, mark, offer, small
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.goal_values import GoalOptions, grasp_goal, touch_goal
from rtee.remote.openings import OpeningRange
from rtee.trials.result import TrialResult
from rtee.types import OnContact, Stage

Show = Callable[[Posture | None, float, Evidence | None], None]
"""Shows a posture at an intensity as a ghost, and the contact; ``None`` hides the ghost."""

_STAGES = {
    "to the grasp": Stage.BOTH,
    "to just before contact": Stage.PRE_GRASP,
    "from contact to grasp": Stage.GRASP,
}
"""Stages of a pinch by their labels."""

_CROWDED = 85
"""Intensity above which the contact's label would overlap the number beside the slider [%]."""

_FORCE_HINT = "Force between the fingertips [N], used with the opening; 0: up to the effort limit"


class Card:
    """Card of one action, or of all primitives of one name; the search looks in `words`."""

    def __init__(
        self,
        bridge: Bridge,
        hand: RemoteHand,
        actions: Sequence[Action],
        show: Show,
        *,
        expanded: bool,
        order: float,
        remark: Callable[[Action], str] = lambda action: "",
        fingers: Callable[[Action], Sequence[str]] = lambda action: action.fingers,
    ) -> None:
        """Add the card of the primitives of one name, or of one other action.

        ``show`` shows a posture as a ghost. ``remark`` returns a remark about an action, or ``""``;
        ``fingers`` returns the fingers that an action moves.
        """
        self.name = actions[0].name
        self._bridge = bridge
        self._hand = hand
        self._actions = tuple(actions)
        self._show = show
        self._previewing = False
        self._choice: viser.GuiDropdownHandle[str] | None = None
        self._stage: viser.GuiDropdownHandle[str] | None = None
        self._contact: float | None = None
        self._tried = Tried()
        self._openings: dict[tuple[str, tuple[str, ...]], OpeningRange] = {}
        # Whether the opening was moved last, and therefore overrides the intensity.
        self._by_opening = False
        self._remark = remark
        self._fingers = fingers
        gui = bridge.stage.gui
        self._folder = gui.add_folder(self.name, expand_by_default=expanded, order=order)
        with self._folder:
            self._describe(gui)
            self._slider = self._make_slider(gui)
            self._buttons = gui.add_button_group(
                "",
                ("Run", "Preview") if bridge.may(Role.OPERATOR) else ("Preview",),
                hint="Run: execute the action. Preview: show its posture as a ghost",
                order=2,
            )
            self._trials = gui.add_html("", visible=False, order=6)
            with gui.add_folder("More", expand_by_default=False, order=7):
                self._make_opening(gui)
                self._add_more(gui)
            first = self._actions[0]
            steps = first.steps if isinstance(first, Timed) else ()
            self._execution = Execution(bridge, hand, steps, self._asked)
            self.fade = self._execution.fade
        self._buttons.on_click(self._clicked)
        self._command = gui.add_command(
            f"Run {self.name}", description="Execute it with the settings of its card"
        )
        bridge.need(Role.OPERATOR, self._touch, self._command)
        self._command.on_trigger(lambda _: self._begin())
        elements = [element for action in actions for element in action.elements]
        self.words = " ".join((self.name, *elements)).lower()

    def _describe(self, gui: viser.GuiApi) -> None:
        action = self._actions[0]
        match action:
            case Primitive():
                noun, several = action.kind.noun, "s" * (len(action.elements) > 1)
                self._choice = gui.add_dropdown(
                    f"{noun}{several}".capitalize(),
                    tuple(JOINED.join(a.elements) for a in self._actions),
                    hint=f"The {noun}{several} that the action uses",
                    disabled=len(self._actions) == 1,
                    order=0,
                )
                self._choice.on_update(lambda _: self._on_choice())
                self._remark_line = gui.add_html("", visible=False, order=0.5)
                self._show_remark()
            case Timed():
                pass  # its steps are listed below, with their progress
            case _ if action.uses:
                gui.add_html(small(" + ".join(escape(described(u)) for u in action.uses)), order=0)
            case _:
                moved = ", ".join(escape(name) for name in action.posture.involved)
                gui.add_html(small(f"moves {moved}"), order=0)

    def _contact_marks(self) -> Sequence[tuple[float, str]]:
        return () if self._contact is None else (_contact_mark(round(100 * self._contact)),)

    def _make_slider(self, gui: viser.GuiApi) -> viser.GuiSliderHandle[int]:
        self._contact = None if self.evidence is None else self.evidence.contact_at
        slider = gui.add_slider(
            "Intensity [%]",
            0,
            100,
            1,
            100,
            hint="How far the action goes [%]: 0 is the rest posture, 100 the action's posture; "
            "the mark is where the tips touch",
            visible=not isinstance(self._actions[0], Timed),
            order=1,
        )
        mark(slider, *self._contact_marks())
        slider.on_update(self._on_intensity)
        return slider

    def _make_opening(self, gui: viser.GuiApi) -> None:
        self._width = gui.add_slider(
            "Opening [mm]",
            0.0,
            1.0,
            0.1,
            0.0,
            hint="Distance between the fingertips [mm]; the action uses this or the intensity, "
            "whichever you moved last",
            visible=False,
            order=1.2,
        )
        self._force = gui.add_slider(
            "Force [N]", 0.0, 1.0, 0.1, 0.0, hint=_FORCE_HINT, visible=False, order=1.4
        )
        self._forces = gui.add_html("", visible=False, order=1.5)
        self._width.on_update(self._on_width)
        self._force.on_update(self._on_force)

    def _add_more(self, gui: viser.GuiApi) -> None:
        self._speed = gui.add_slider(
            "Speed [%]", 5, 100, 5, 100, hint="Percentage of the hand's velocity limits [%]"
        )
        self._effort = gui.add_slider(
            "Effort [%]", 5, 100, 5, 100, hint="Percentage of the actuators' effort limits [%]"
        )
        # Only a pinch whose contact is known has a posture just before it.
        if self._contact is not None:
            self._stage = gui.add_dropdown(
                "Stage", tuple(_STAGES), hint="How far the pinch goes: up to the contact, or beyond"
            )
        self._contacts = ContactChoice(gui, self._fingers(self.action))
        self._touch = gui.add_button(
            "Close until contact",
            hint="Close slowly until the first contact, and stop there",
            visible=not isinstance(self._actions[0], Timed),
        )
        self._touch.on_click(self._bridge.clicked(self._close_to_touch))

    # --- millimetres and newtons

    def show_openings(self, openings: Mapping[tuple[str, tuple[str, ...]], OpeningRange]) -> None:
        """Offer the openings and forces that goals may request, by action and elements."""
        self._openings = dict(openings)
        self._show_opening()

    @property
    def _opening(self) -> OpeningRange | None:
        return self._openings.get(key_of(self.action))

    def _show_opening(self) -> None:
        opening = self._opening
        self._width.visible = self._force.visible = opening is not None
        if opening is None:
            self._by_opening = False
            self._show_forces()
            return
        # Round inwards to 0.1 mm, so that the hand accepts both ends; the 1e-6 absorbs rounding
        # errors of the multiplication.
        self._width.min = math.ceil(opening.narrowest * 1e4 - 1e-6) / 10.0
        self._width.max = math.floor(opening.widest * 1e4 + 1e-6) / 10.0
        self._follow_intensity()

    def _show_forces(self) -> None:
        """Offer the forces that goals may request at the displayed opening."""
        opening = self._opening
        self._forces.visible = opening is not None
        if opening is None:
            self._contacts.limit(0.0)
            return
        width = float(self._width.value)
        low, high = opening.forces_at(width / 1e3)
        # Round inwards to 0.1 N, so that the hand accepts both ends.
        low, high = math.ceil(low * 10.0) / 10.0, math.floor(high * 10.0) / 10.0
        self._contacts.limit(high)
        self._force.disabled = high <= 0.0
        if high <= 0.0:
            self._force.value = 0.0
            reason = opening.unlimited or f"no force can be limited at {width:g} mm"
            self._forces.content = small(escape(reason))
            return
        self._force.max = high
        self._force.value = min(float(self._force.value), high)
        self._forces.content = small(f"{low:g} to {high:g} N at {width:g} mm")

    def _follow_intensity(self) -> None:
        """Set the opening from the intensity or vice versa, from the one that was moved last."""
        opening = self._opening
        if opening is None:
            return
        if self._by_opening:
            width = min(max(float(self._width.value), self._width.min), self._width.max)
            self._slider.value = round(100.0 * opening.intensity_at(width / 1e3))
        else:
            width = round(1e3 * opening.at(self._slider.value / 100.0), 1)
            width = min(max(width, self._width.min), self._width.max)
        self._width.value = width
        self._show_forces()

    async def _on_intensity(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # moved by a person, not by the other slider
            self._by_opening = False
            self._force.value = 0.0  # a goal takes a force only together with an opening
            self._follow_intensity()
        self._preview_if_shown()

    async def _on_width(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._by_opening = True
            self._follow_intensity()
            self._preview_if_shown()

    async def _on_force(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._by_opening = True

    # --- the choice

    @property
    def action(self) -> Action:
        """The chosen action."""
        if self._choice is None:
            return self._actions[0]
        at: int = self._choice.options.index(self._choice.value)
        return self._actions[at]

    @property
    def evidence(self) -> Evidence | None:
        """The first evidence of the chosen action, if it has any."""
        return next(iter(self.action.evidence), None)

    def _on_choice(self) -> None:
        evidence = self.evidence
        contact = None if evidence is None else evidence.contact_at
        if contact != self._contact:
            self._contact = contact
            mark(self._slider, *self._contact_marks())
        self._contacts.offer(self._fingers(self.action))
        self._show_opening()
        self._show_remark()
        self._show_tried()
        self._preview_if_shown()

    def _show_remark(self) -> None:
        remark = self._remark(self.action)
        self._remark_line.content = small(escape(remark))
        self._remark_line.visible = bool(remark)

    def show_trials(self, tried: Tried) -> None:
        """Show the action's results of trials."""
        self._tried = tried
        self._show_tried()

    def _show_tried(self) -> None:
        results = self._tried.results.get(key_of(self.action), ())
        own = self._tried.own.get(key_of(self.action), ())
        html = ""
        if results:
            outdated = any(result.trial.key in self._tried.outdated for result in results)
            title = "Objects on which the action was tried in simulation (rtee try --all)"
            if outdated:
                title += "; the hand, this action, or the method of the trials has changed since:"
                title += " run the trials again"
            summary = tried_line(results, outdated=outdated)
            html = small(
                f'<details><summary title="{title}">{summary}</summary>'
                f"{tried_table(results)}</details>"
            )
        for result in reversed(own):
            summary = escape(f"{object_name(result.trial.object)}: {verdict(result)}")
            html += small(f"Tried now: {summary}")
        self._trials.content = html
        self._trials.visible = bool(results or own)

    # --- clicks

    async def _clicked(self, event: viser.GuiEvent) -> None:
        match str(event.target.value):
            case "Run":
                self._begin()
            case _:
                self._previewing = not self._previewing
                self._preview_if_shown(hide=True)

    def _begin(self) -> None:
        self._bridge.call(self._do)  # first, so that drawing does not delay the hand
        self._previewing = False
        self._show(None, 0.0, self.evidence)

    def _preview_if_shown(self, *, hide: bool = False) -> None:
        if self._previewing:
            intensity = self._slider.value / 100.0
            if self._by_opening and self._opening is not None:
                intensity = self._opening.intensity_at(float(self._width.value) / 1e3)
            self._show(self.action.waypoints[-1], intensity, self.evidence)
        elif hide:
            self._show(None, 0.0, None)

    def _asked(self) -> tuple[Action, GoalOptions, float]:
        """Return the action, the options and the share of the effort limits set on the card."""
        options = GoalOptions(intensity=self._slider.value / 100.0, speed=self._speed.value / 100.0)
        if self._by_opening:
            options = GoalOptions(
                opening=float(self._width.value) / 1e3, speed=self._speed.value / 100.0
            )
            if self._force.value > 0.0:
                options["force"] = float(self._force.value)
        elif self._stage is not None:
            options["stage"] = _STAGES[str(self._stage.value)]
        self._contacts.add_to(options)
        # The hand derives the effort from a force, and refuses both together.
        effort = 1.0 if "force" in options else self._effort.value / 100.0
        return self.action, options, effort

    async def _do(self) -> None:
        await self._execution.do(*self._asked())

    async def _close_to_touch(self) -> None:
        name, elements = key_of(self.action)
        goal = touch_goal(fingers=elements, action=name)
        await self._execution.follow(self._hand.start_goal(goal))

    # --- place among the cards

    @property
    def visible(self) -> bool:
        """Whether the card is shown."""
        return bool(self._folder.visible)

    @visible.setter
    def visible(self, shown: bool) -> None:
        if self._folder.visible != shown:
            self._folder.visible = shown

    def place(self, order: float) -> None:
        """Move the card to another position."""
        if self._folder.order != order:
            self._folder.order = order

    def remove(self) -> None:
        """Remove the card."""
        self._execution.remove()
        self._command.remove()
        self._folder.remove()


def _contact_mark(intensity: int) -> tuple[int, str]:
    """Return a slider's mark at the contact [%]; near the end, its label lies left of the mark."""
    # A label is centred on its mark; spaces as wide as the word shift the word to the left.
    spaces = "\N{NO-BREAK SPACE}" * 12 if intensity > _CROWDED else ""
    return intensity, f"contact{spaces}"


_AS_CONFIGURED: Final = "as configured"
"""Choice that leaves the setting out of the goal, so that ``hand.yaml`` applies."""

_ALL: Final = "all fingers"
"""Choice of all fingers without their own setting."""

_SLIP_HINT: Final = (
    "Largest force after a slip [N]; 0: slips do not raise the force. Used together with a force"
)


class ContactChoice:
    """Settings for contact, for all fingers or single ones, and the largest force after a slip."""

    def __init__(self, gui: viser.GuiApi, fingers: Sequence[str]) -> None:
        """Add the controls to the current container, for the action's fingers if they are known."""
        # Settings by finger; the empty name means all fingers.
        self._words: dict[str, OnContact] = {}
        self._finger = gui.add_dropdown(
            "Contact of", (_ALL,), hint="Fingers to which the next field applies"
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
        """Limit the force after a slip to the largest that a goal may request [N]; 0 hides it."""
        self._slip.visible = most > 0.0
        if most > 0.0:
            self._slip.max = most
        self._slip.value = min(float(self._slip.value), max(most, 0.0))

    def add_to(self, options: GoalOptions) -> None:
        """Add the settings to the options of a goal."""
        if self._words:
            options["on_contact"] = dict(self._words)
        if "force" in options and self._slip.value > 0.0:
            options["max_force"] = float(self._slip.value)

    @property
    def _chosen(self) -> str:
        """The finger whose setting is edited, or the empty name for all fingers."""
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


_FEW = 1
"""Number of primitive cards that are open at first; the others fit on the screen while folded."""


def grouped(actions: Sequence[Action]) -> dict[tuple[ActionKind, str], list[Action]]:
    """Return the actions by kind and name, so that the primitives of one name share a card."""
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
        """Return the hand's current actions; rebuild the cards of those that have changed."""
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
            # Rebuilding a card would reset its controls. Compare as text, since postures hold
            # arrays, whose comparison gives an array instead of a bool.
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
        """Show stored results of trials next to those of this page."""
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
        """Mark outdated results as old."""
        self._holding.fade()
        for card in self._cards.values():
            card.fade()

    def remove(self) -> None:
        """Remove the cards and their commands, which are not part of any folder."""
        while self._cards:
            self._cards.popitem()[1].remove()

    def _filter(self) -> None:
        wanted = str(self._search.value).lower().split()
        # In one message; otherwise the cards would appear or vanish one by one.
        with self._bridge.stage.atomic():
            for card in self._cards.values():
                card.visible = all(word in card.words for word in wanted)
            for kind, folder in self._folders.items():
                folder.visible = any(
                    card.visible for key, card in self._cards.items() if key[0] is kind
                )


_WIDTH: Final = 30.0
"""Initial width of the object [mm]: that of a bottle's neck, within reach of most hands."""

_ANY: Final = "any"
"""Choice that lets the hand choose the fingers."""


class HoldingPanel:
    """Controls for width, force, speed and fingers, and a button that grasps."""

    def __init__(self, bridge: Bridge, hand: RemoteHand) -> None:
        """Add the panel to the current container; it stays hidden until the hand has openings."""
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
                hint="Force to hold the object with [N]; 0: automatic, as hard as the hand closes",
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
                    hint="Fingers to hold the object with; any: those that suit it best",
                )
            self._execution = Execution(bridge, hand, asked=self._asked)
            self.fade = self._execution.fade
        bridge.need(Role.OPERATOR, self._button)
        self._width.on_update(lambda _: self._offer_forces())
        self._fingers.on_update(lambda _: self._offer_widths())
        self._button.on_click(bridge.clicked(self._grasp))

    def offer(self, openings: Sequence[OpeningRange]) -> None:
        """Offer the openings and forces that goals may request."""
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
        """Limit the width to objects that the fingers reach around."""
        chosen = self._chosen
        # Round inwards to 0.1 mm, so that the hand accepts both ends. The fingers must open wider
        # than the object to get around it, hence 0.1 mm less than the widest opening.
        least = math.ceil(min(each.narrowest for each in chosen) * 1e4 - 1e-6) / 10.0
        most = math.floor(max(each.widest for each in chosen) * 1e4 + 1e-6) / 10.0 - 0.1
        most = max(most, least + 0.1)
        if (self._width.min, self._width.max) != (least, most):
            value = min(max(float(self._width.value), least), most)
            # Set the value last, since viser clips it to the range.
            self._width.max, self._width.min = most, least
            self._width.value = value
        self._offer_forces()

    def _offer_forces(self) -> None:
        """Limit the force to the largest that any of the actions exerts at the chosen width."""
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
        """Return the chosen width [mm], force [N], speed [mm/s] and fingers."""
        width, force, speed = (
            float(each.value) for each in (self._width, self._force, self._speed)
        )
        return width, force, speed, str(self._fingers.value)

    async def _grasp(self) -> None:
        width, force, speed, fingers = self._asked()
        # Leave a force or speed of 0 out of the goal: the hand then uses its default.
        goal = grasp_goal(
            width / 1e3,
            force=force or None,
            tip_speed=speed / 1e3 or None,
            fingers=None if fingers == _ANY else fingers.split(JOINED),
        )
        await self._execution.follow(self._hand.start_goal(goal))
