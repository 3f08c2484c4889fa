"""Execution of an action, with progress bars for it and its inner actions, and the result."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from html import escape
from typing import NamedTuple

import viser

from rtee.actions.describe import described
from rtee.actions.types import Action, Step
from rtee.errors import RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.colours import BAD, BAR, OLD, PREVIEW
from rtee.gui.trial_results import key_of
from rtee.gui.wording import coloured, outcome, small
from rtee.remote.client import RemoteHand
from rtee.remote.goal import RunningGoal
from rtee.remote.goal_values import GoalOptions
from rtee.remote.truth import Turn
from rtee.types import Feedback, Result


class _Shown(NamedTuple):
    """A displayed result, the settings requested, and the `Turn` at that time."""

    result: Result
    asked: object
    turn: Turn


class Execution:
    """Executes an action, and shows its progress and result."""

    def __init__(
        self,
        bridge: Bridge,
        hand: RemoteHand,
        steps: Sequence[Step] = (),
        asked: Callable[[], object] = lambda: None,
    ) -> None:
        """Add the bars to the current container, one for each inner action of a timed action.

        ``asked`` returns the present settings of the controls; results of other settings are old.
        """
        gui = bridge.stage.gui
        self._hand, self._truth, self._asked = hand, bridge.truth, asked
        self._shown: _Shown | None = None
        self._goal_id = ""
        self._removed = False
        self._inner: dict[str, viser.GuiProgressBarHandle] = {}
        for step in steps:
            margins = f"{step.before:g} s before, {step.after:g} s after"
            title = f"<b>{escape(step.alias)}</b> {escape(described(step.use))} · {margins}"
            gui.add_html(small(title), order=0)
            self._inner[step.alias] = gui.add_progress_bar(
                0.0, animated=False, color=PREVIEW, order=0
            )
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=False, color=BAR, order=5)
        self._word = gui.add_html("", order=6)

    async def do(self, action: Action, options: GoalOptions, effort: float) -> None:
        """Execute an action with a share of the effort limits, and show its progress and result."""
        if effort < 1.0:
            # A goal takes limits by actuator [N·m | N]; actuators without a limit keep none.
            limits = {a.name: a.effort for a in (await self._hand.info()).actuators}
            options["effort"] = {
                name: effort * limits[name]
                for name in dict.fromkeys(n for at in action.waypoints for n in at.involved)
                if math.isfinite(limits[name])
            }
        name, elements = key_of(action)
        await self.follow(self._hand.start(name, *elements, **options))

    async def follow(self, start: Awaitable[RunningGoal]) -> None:
        """Send a goal, and show its progress and result."""
        self._reset()
        asked = self._asked()
        # The goal that this one replaces ends before the hand answers; do not show its result.
        before, self._goal_id = self._goal_id, ""
        try:
            running = await start
        except RteeError as error:
            self._goal_id = before
            self._say(str(error), BAD)
            raise
        self._goal_id = running.goal.goal_id
        result = await running.result(self._progress)
        if result.goal_id == self._goal_id:
            self._end(result, asked)

    def _reset(self) -> None:
        self._bar.value, self._bar.visible = 0.0, True
        for bar in self._inner.values():
            bar.value = 0.0
        self._say("", "")
        self._shown = None

    def _progress(self, feedback: Feedback) -> None:
        # Ignore feedback of a replaced goal, or after the card was rebuilt.
        if feedback.goal_id != self._goal_id or self._removed:
            return
        self._bar.value = round(100.0 * feedback.progress, 1)
        for name, progress in feedback.inner_progress.items():
            if name in self._inner:
                self._inner[name].value = round(100.0 * progress, 1)

    def remove(self) -> None:
        """Stop showing the goal; the card removes the controls, but the goal may continue."""
        self._removed = True

    def _end(self, result: Result, asked: object) -> None:
        if self._removed:
            return
        if result.succeeded:
            self._bar.value = 100.0
            for bar in self._inner.values():
                bar.value = 100.0
        self._say(*outcome(result))
        self._shown = _Shown(result, asked, self._truth.turn)

    def fade(self) -> None:
        """Mark the result as old once it no longer describes the hand or the requested goal."""
        shown, turn = self._shown, self._truth.turn
        if shown is None or self._removed:
            return
        result = shown.result
        if turn is not shown.turn and turn.goal != result.goal_id:
            # The reason for a failure stays valid until another goal runs.
            old = turn.why if turn.goal or result.succeeded else ""
        else:
            old = "no data" if self._truth.stale else ""
        if not old and self._asked() != shown.asked:
            old = "other settings"
        if old:
            self._say(f"old, then {old}: {outcome(result)[0]}", OLD)
            self._bar.visible = False
            self._shown = None

    def _say(self, text: str, colour: str) -> None:
        if self._removed:
            return
        self._word.content = coloured(text, colour)
