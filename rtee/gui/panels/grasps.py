"""Planned grasps, the best first, each with its reasons and with buttons that execute it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Final

import viser

from rtee.errors import RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.colours import BAD
from rtee.gui.trial_results import object_name
from rtee.gui.wording import coloured, outcome, small
from rtee.messages.requests import Role
from rtee.planning.result import GraspPlan, Ranking
from rtee.remote.client import RemoteHand
from rtee.remote.goal import GoalOptions

Preview = Callable[[GraspPlan | None], None]
"""Shows a planned grasp as a ghost; ``None`` hides it."""

_MOST: Final = 8
"""Most grasps listed; people rarely go further than the first few."""

_COMPOSED: Final = "Planned"
"""Name of an action that was composed for the object and is kept only in memory."""


class GraspsPanel:
    """The grasps of an object."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, preview: Preview) -> None:
        """Add the panel, empty, to the current container."""
        self._bridge, self._remote, self._preview = bridge, remote, preview
        self._ranking: Ranking | None = None
        self._folder: viser.GuiFolderHandle | None = None
        self._place = bridge.server.gui.add_folder(None)

    @property
    def verdict(self) -> str:
        """Summary of the plan in a sentence."""
        if self._ranking is None:
            return ""
        if not self._ranking.plans:
            return "no action can hold it"
        first = self._ranking.plans[0]
        held = first.check is None or first.check.held
        return f"best: {first.label}" + ("" if held else ", but it loses the object")

    def show(self, ranking: Ranking | None) -> None:
        """Show the grasps of a ranking instead of the present ones; ``None`` shows none."""
        self._ranking = ranking
        if self._folder is not None:
            self._folder.remove()
            self._folder = None
        if ranking is None:
            return
        gui = self._bridge.server.gui
        with self._place:
            self._folder = gui.add_folder(f"Grasps of {object_name(ranking.object)}")
        with self._folder:
            for note in ranking.notes:
                gui.add_html(small(escape(note)))
            for number, plan in enumerate(ranking.plans[:_MOST], 1):
                self._add(number, plan)
            if ranking.rejected:
                lines = "<br>".join(escape(f"{name}: {why}") for name, why in ranking.rejected)
                title = f"{len(ranking.rejected)} others cannot hold it"
                gui.add_html(small(f"<details><summary>{title}</summary>{lines}</details>"))

    def _add(self, number: int, plan: GraspPlan) -> None:
        gui = self._bridge.server.gui
        with gui.add_folder(f"{number}. {plan.label}", expand_by_default=number == 1):
            gui.add_html(small(summary(plan)))
            reasons = "".join(f"<li>{escape(reason)}</li>" for reason in plan.reasons)
            gui.add_html(small(f'<ul style="margin:0;padding-left:1.2em">{reasons}</ul>'))
            buttons = gui.add_button_group(
                "",
                ("Show", "Pre-shape", "Grasp") if self._bridge.may(Role.OPERATOR) else ("Show",),
                hint="Show: the grasp as a ghost. Pre-shape: open the hand for the object. Grasp: "
                "close on it, with the intensity and the effort planned",
            )
            word = gui.add_html("")
        buttons.on_click(lambda event: self._clicked(str(event.target.value), plan, word))

    def _clicked(self, button: str, plan: GraspPlan, word: viser.GuiHtmlHandle) -> None:
        if button == "Show":
            self._preview(plan)
            return
        self._bridge.call(partial(self._do, plan, word, pre=button == "Pre-shape"))
        self._preview(None)  # the ghost would hide the hand that moves

    async def _do(self, plan: GraspPlan, word: viser.GuiHtmlHandle, *, pre: bool) -> None:
        """Execute a planned grasp, or its pre-shape."""
        name, options = plan.action, GoalOptions(intensity=plan.intensity)
        if pre:
            options = GoalOptions(intensity=plan.preshape)
        elif plan.effort < 1.0:
            options["effort"] = plan.effort
        word.content = ""
        try:
            # A grasp without a name combines actions; the hand gets to know it as one action.
            if not name:
                name = _COMPOSED
                await self._remote.add_composed(
                    name, plan.parts, replace=True, description=f"Planned: {plan.label}."
                )
            result = await (await self._remote.start(name, *plan.elements, **options)).result()
        except RteeError as error:
            word.content = coloured(str(error), BAD)
            raise  # the bridge shows it as a notification, too
        word.content = coloured(*outcome(result))


def summary(plan: GraspPlan) -> str:
    """Return HTML with the numbers of a grasp."""
    words = [
        f"score {plan.score:.2f}",
        f"intensity {plan.intensity:.0%}",
        f"pre-shape {plan.preshape:.0%}",
        f"effort {plan.effort:.0%}",
    ]
    if plan.check is not None:
        words.append(f"<b>{'held' if plan.check.held else 'lost'}</b> in simulation")
    return " · ".join(words)
