"""Panel that tries actions on an object in simulation, and plans grasps for it."""

from __future__ import annotations

import asyncio
import asyncio.subprocess
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final

import anyio
import viser

from rtee.actions.types import Action, ActionReference
from rtee.errors import ConfigError, RequestRejected, RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.colours import BAD, BAR, GOOD
from rtee.gui.panels.execution import Execution
from rtee.gui.trial_results import key_of, object_name, verdict
from rtee.gui.wording import offer, small
from rtee.hand.catalog import find_hand
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.objects.shape import Table
from rtee.planning.result import GraspPlan, Ranking
from rtee.planning.result import from_document as ranking_of
from rtee.remote.client import RemoteHand
from rtee.remote.goal_values import GoalOptions, grasp_goal
from rtee.trials.job import (
    LONGEST_LINE,
    MOST_VARIATIONS,
    TrialJob,
    check_installed,
    command,
    meshes_of,
    read_line,
)
from rtee.trials.result import OBJECTS, TrialResult
from rtee.trials.store import from_document as result_of

Report = Callable[[dict[str, Any]], None]
"""Receives a line of the process: ``progress`` and ``text``, ``result`` or ``ranking``."""

_PIPE: Final = asyncio.subprocess.PIPE
_NOTHING: Final = asyncio.subprocess.DEVNULL


class Jobs:
    """Runs one job at a time, whichever window it is for; call its methods in the event loop.

    `running` is the title of the job, empty if no job runs.
    """

    def __init__(self) -> None:
        self.running = ""

    def check_free(self) -> None:
        """Raise `RequestRejected` if a job is running."""
        if self.running:
            raise RequestRejected(
                f"{self.running} is still running, here or in another window; wait for it to end, "
                "or cancel it there"
            )

    async def run(self, job: TrialJob, title: str, report: Report) -> None:
        """Run a job; cancelling it kills its process.

        Raises `RequestRejected` with the reason if another job is running, or this one fails, and
        `ConfigError` if an argument of the job is out of range.
        """
        self.check_free()
        job.check()
        self.running = title
        try:
            await self._run(job, report)
        finally:
            self.running = ""

    async def _run(self, job: TrialJob, report: Report) -> None:
        arguments, environment = command()
        process = await asyncio.create_subprocess_exec(
            *arguments,
            stdin=_PIPE,
            stdout=_PIPE,
            stderr=_NOTHING,
            env=environment,
            limit=LONGEST_LINE,
        )
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        try:
            process.stdin.write(job.to_json().encode() + b"\n")
            while line := await process.stdout.readline():
                message = read_line(line)
                if "error" in message:
                    raise RequestRejected(str(message["error"]))
                if "done" in message:
                    return
                report(message)
            # The output has ended without "done": the process crashed or was killed.
            status = await process.wait()
            raise RequestRejected(
                f"{self.running} ended with exit status {status}; see rtee try or rtee grasp-plan"
            )
        finally:
            if process.returncode is None:
                process.kill()
                with anyio.CancelScope(shield=True):
                    await process.wait()


_EVERY: Final = "all actions"
"""Choice of all actions of the hand."""

_LARGEST: Final = 2000.0
"""Largest length that a user can enter [mm], as on the command line."""

_SIZES: Final = {
    "sphere": (("Diameter [mm]", 60.0),),
    "cylinder": (("Diameter [mm]", 60.0), ("Height [mm]", 120.0)),
    "box": (("Width [mm]", 40.0), ("Depth [mm]", 40.0), ("Height [mm]", 100.0)),
}
"""Shapes whose sizes the user sets, with the labels and initial values of the sizes."""

_TABLES: Final[Mapping[str, Table | None]] = {
    "none": None,
    "below it": Table((0.0, 0.0, 1.0)),
    "y is up": Table((0.0, 1.0, 0.0)),
    "x is up": Table((1.0, 0.0, 0.0)),
    "across the weight": Table(),
}
"""Tables on which the object of a planned grasp may stand, by label."""

Found = Callable[[TrialResult], None]
"""Receives the result of a trial."""


def number(value: Any, least: float, most: float, what: str) -> float:
    """Return the value of a field as a number; a manipulated page may send anything.

    Raises `ConfigError` if the value is not a number, or out of range.
    """
    # In Python, a bool is an int.
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{what} should be a number")
    if not (math.isfinite(value) and least <= value <= most):
        raise ConfigError(f"{what} should be {least:g} to {most:g}, not {value:g}")
    return float(value)


def shape_text(kind: str, sizes: Sequence[float]) -> str:
    """Return a shape in the syntax of the command line, from the sizes of the fields [mm]."""
    metres = [size / 1e3 for size in sizes]
    if kind != "box":  # the command line takes a radius, but people measure diameters
        metres[0] /= 2.0
    return f"{kind}:{'x'.join(f'{value:.6g}' for value in metres)}"


def folder_of(remote: str, hand: Hand) -> Path:
    """Return the folder of a running hand; raises `ConfigError` if it is not configured here."""
    folder = find_hand(remote)  # raises if the name contains a path
    if not hand.urdf.path.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(
            f"the running hand '{remote}' is not the one in {folder}, so it cannot be tried here"
        )
    return folder


class TryPanel:
    """Controls for an object and the action to try on it, with the trials' progress and results."""

    def __init__(
        self,
        bridge: Bridge,
        remote: RemoteHand,
        hand: Hand,
        jobs: Jobs,
        found: Found,
        preview: Preview,
    ) -> None:
        """Add the panel to the current container.

        All windows share the ``jobs``; ``found`` receives the results of trials, ``preview`` shows
        a planned grasp.
        """
        gui = bridge.stage.gui
        self._bridge, self._remote, self._hand, self._found = bridge, remote, hand, found
        self._jobs = jobs
        self._own: anyio.CancelScope | None = None
        self._removed = False
        self._actions: dict[str, Action] = {}
        self._meshes: dict[str, Path] = {}
        self._lines: list[str] = []
        self._object = gui.add_dropdown(
            "Object",
            (*_SIZES, *OBJECTS),
            hint="A shape of your size, a standard object, or a mesh from the folder 'objects' in "
            "the hand's folder",
        )
        self._sizes: dict[str, list[viser.GuiNumberHandle[float]]] = {
            kind: [
                gui.add_number(
                    label,
                    value,
                    min=1.0,
                    max=_LARGEST,
                    step=1.0,
                    hint=f"{label.partition(' ')[0]} of the {kind} [mm]",
                    visible=False,
                )
                for label, value in sizes
            ]
            for kind, sizes in _SIZES.items()
        }
        self._mass = gui.add_number(
            "Mass [kg]", 0.1, min=0.001, max=100.0, step=0.01, hint="Mass of the object [kg]"
        )
        self._usual = gui.add_checkbox(
            "Usual friction",
            True,
            hint="1 at fingertips, 0.8 elsewhere, and 0.5 to 1 in variations; plans: 0.5",
        )
        self._friction = gui.add_number(
            "Friction",
            0.5,
            min=0.0,
            max=10.0,
            step=0.05,
            hint="Coefficient of friction",
            visible=False,
        )
        self._table = gui.add_dropdown(
            "Table",
            tuple(_TABLES),
            hint="Table under the object of a suggested grasp: the hand keeps clear of it. Below "
            "it: the object stands as modelled. y or x is up: with that axis up. Across the "
            "weight: at right angles to the hand's reach",
        )
        self._action = gui.add_dropdown("Action", (_EVERY,), hint="The action to try")
        self._variations = gui.add_slider(
            "Variations",
            0,
            MOST_VARIATIONS,
            1,
            20,
            hint="Number of variations of each trial in size, mass, position, rotation, friction",
        )
        self._checked = gui.add_checkbox(
            "Try the best",
            True,
            hint="After planning: try the best three in simulation, and more until one holds",
        )
        self._buttons = gui.add_button_group(
            "",
            ("Try", "Suggest grasps", "Cancel"),
            hint="Try: does the action hold the object in simulation? Suggest grasps: which "
            "action holds it best? The real hand does not move",
        )
        self._bar = gui.add_progress_bar(0.0, animated=False, color=BAR)
        self._report = gui.add_html("")
        self._grasps = GraspsPanel(bridge, remote, preview)
        self.fade = self._grasps.fade
        self._object.on_update(lambda _: self._choose())
        self._usual.on_update(lambda _: self._choose())
        self._buttons.on_click(lambda event: self._clicked(str(event.target.value)))
        self._choose()
        self._offer_meshes()

    def _choose(self) -> None:
        """Show the fields that belong to the chosen shape and friction."""
        for kind, fields in self._sizes.items():
            for field in fields:
                field.visible = kind == self._object.value
        self._friction.visible = not self._usual.value

    def _offer_meshes(self) -> None:
        """Offer the objects; show the reason if this computer cannot run trials of the hand."""
        try:
            self._meshes = meshes_of(folder_of(self._remote.name, self._hand))
            offer(self._object, (*_SIZES, *OBJECTS, *self._meshes))
            check_installed(planning=False)
        except RteeError as error:
            self._say(str(error), BAD)

    def show_actions(self, actions: Sequence[Action]) -> None:
        """Offer these actions."""
        self._actions = {" ".join((a.name, *a.elements)): a for a in actions}
        offer(self._action, (_EVERY, *self._actions))

    # --- clicks

    def _clicked(self, button: str) -> None:
        match button:
            case "Try":
                self._bridge.call(partial(self._start, planning=False))
            case "Suggest grasps":
                self._bridge.call(partial(self._start, planning=True))
            case _:
                self._bridge.call(self._cancel)

    async def _cancel(self) -> None:
        if self._own is None:
            raise RequestRejected("this window runs no trial or planning")
        self.cancel()

    def cancel(self) -> None:
        """Cancel the job of this window, if there is one."""
        if self._own is not None:
            self._own.cancel()

    async def _start(self, *, planning: bool) -> None:
        self._jobs.check_free()
        job = self._job(planning=planning)
        title = "planning" if planning else "a trial"
        self._lines.clear()
        self._bar.value = 0.0
        self._say(f"{title} begins …", "")
        if planning:
            self._grasps.show(None)
        try:
            with anyio.CancelScope() as self._own:
                await self._jobs.run(job, title, self._receive)
            done = not self._own.cancelled_caught
        except RteeError as error:
            self._say(str(error), BAD)
            raise
        finally:
            self._own = None
        if self._removed:  # the hand has gone in the meantime, and so have its controls
            return
        self._bar.value = 100.0 if done else 0.0
        if not done:
            self._say("cancelled", BAD)
        elif planning:
            self._say(self._grasps.verdict, GOOD)
        else:
            self._say("", "")

    def _job(self, *, planning: bool) -> TrialJob:
        """Return the job that the fields describe.

        Raises `ConfigError` if an extra is missing, or a field has an invalid value.
        """
        check_installed(planning=planning)
        folder = folder_of(self._remote.name, self._hand)
        job = TrialJob(
            folder=str(folder),
            object=self._chosen(meshes_of(folder)),
            mass=number(self._mass.value, 0.001, 100.0, "the mass"),
            friction=None
            if self._usual.value
            else number(self._friction.value, 0.0, 10.0, "the friction"),
            actions=None if planning else self._chosen_actions(),
            variations=int(number(self._variations.value, 0, MOST_VARIATIONS, "variations")),
            checked=3 if self._checked.value else 0,
            table=_TABLES.get(self._table.value),
        )
        job.check()
        return job

    def _chosen(self, meshes: Mapping[str, Path]) -> str:
        name = self._object.value
        if name in _SIZES:
            fields = zip(_SIZES[name], self._sizes[name], strict=True)
            sizes = [number(field.value, 1.0, _LARGEST, label) for (label, _), field in fields]
            return shape_text(name, sizes)
        if name in OBJECTS:
            return str(name)
        if name in meshes:
            return str(meshes[name])
        raise ConfigError("there is no such object; choose one from the list")

    def _chosen_actions(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        name = self._action.value
        if name == _EVERY:
            return tuple(map(key_of, self._actions.values()))
        if name not in self._actions:
            raise ConfigError("there is no such action; choose one from the list")
        return (key_of(self._actions[name]),)

    # --- results

    def _receive(self, message: Mapping[str, Any]) -> None:
        """Show a message from the process."""
        if self._removed:
            return
        if "result" in message:
            result = result_of(message["result"])
            self._found(result)
            action = result.trial.what
            sign = "●" if result.held else "○"
            self._lines.append(
                f"{sign} {action} on {object_name(result.trial.object)}: {verdict(result)}"
            )
            self._say("", "")
        elif "ranking" in message:
            self._grasps.show(ranking_of(message["ranking"]))
        else:
            self._bar.value = round(100.0 * float(message.get("progress", 0.0)), 1)
            self._say(str(message.get("text", "")), "")

    def _say(self, text: str, colour: str) -> None:
        # Results stay above the progress text.
        lines = [escape(line) for line in self._lines]
        if text:
            style = f' style="color:{colour}"' if colour else ""
            lines.append(f'<span role="note"{style}>{escape(text)}</span>')
        self._report.content = small("<br>".join(lines))

    def remove(self) -> None:
        """Cancel the running job; the session removes the controls."""
        self._removed = True
        self.cancel()


Preview = Callable[[GraspPlan | None], None]
"""Shows a planned grasp as a ghost; ``None`` hides it."""

_MOST: Final = 8
"""Maximum number of listed grasps; people rarely go beyond the first few."""

_COMPOSED: Final = "Planned"
"""Name of an action composed for the object, which is kept only in memory."""


class GraspsPanel:
    """List of the planned grasps of an object."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, preview: Preview) -> None:
        """Add the panel, empty, to the current container."""
        self._bridge, self._remote, self._preview = bridge, remote, preview
        self._ranking: Ranking | None = None
        self._folder: viser.GuiFolderHandle | None = None
        self._executions: list[Execution] = []
        self._place = bridge.stage.gui.add_folder(None)

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
        """Replace the listed grasps by those of a ranking; ``None`` clears the list."""
        self._ranking = ranking
        if self._folder is not None:
            for execution in self._executions:
                execution.remove()
            self._executions.clear()
            self._folder.remove()
            self._folder = None
        if ranking is None:
            return
        gui = self._bridge.stage.gui
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
        gui = self._bridge.stage.gui
        with gui.add_folder(f"{number}. {plan.label}", expand_by_default=number == 1):
            gui.add_html(small(summary(plan)))
            reasons = "".join(f"<li>{escape(reason)}</li>" for reason in plan.reasons)
            gui.add_html(small(f'<ul style="margin:0;padding-left:1.2em">{reasons}</ul>'))
            buttons = gui.add_button_group(
                "",
                ("Show", "Pre-shape", "Grasp") if self._bridge.may(Role.OPERATOR) else ("Show",),
                hint="Show: the grasp as a ghost. Pre-shape: open the hand for the object. Grasp: "
                "close on it with the planned force, or intensity and effort",
            )
            execution = Execution(self._bridge, self._remote)
        self._executions.append(execution)
        buttons.on_click(lambda event: self._clicked(str(event.target.value), plan, execution))

    def fade(self) -> None:
        """Mark outdated results as old."""
        for each in self._executions:
            each.fade()

    def _clicked(self, button: str, plan: GraspPlan, execution: Execution) -> None:
        if button == "Show":
            self._preview(plan)
            return
        self._bridge.call(partial(self._do, plan, execution, pre=button == "Pre-shape"))
        self._preview(None)  # the ghost would hide the hand that moves

    async def _do(self, plan: GraspPlan, execution: Execution, *, pre: bool) -> None:
        """Execute a planned grasp, or its pre-shape."""
        if plan.force is not None and not pre:
            use = ActionReference(plan.action, plan.elements)
            goal = grasp_goal(plan.width, force=plan.force, action=use)
            await execution.follow(self._remote.start_goal(goal))
            return
        name, options = plan.action, GoalOptions(intensity=plan.intensity)
        if pre:
            options = GoalOptions(intensity=plan.preshape)
        elif plan.effort < 1.0:
            options["effort"] = plan.effort
        # A grasp without a name combines actions; add it to the hand as one action.
        if not name:
            name = _COMPOSED
            await self._remote.add_composed(
                name, plan.parts, replace=True, description=f"Planned: {plan.label}."
            )
        await execution.follow(self._remote.start(name, *plan.elements, **options))


def summary(plan: GraspPlan) -> str:
    """Return HTML with the key figures of a grasp."""
    words = [
        f"score {plan.score:.2f}",
        f"intensity {plan.intensity:.0%}",
        f"pre-shape {plan.preshape:.0%}",
        f"effort {plan.effort:.0%}" if plan.force is None else f"force {plan.force:.3g} N",
    ]
    if plan.check is not None:
        words.append(f"<b>{'held' if plan.check.held else 'lost'}</b> in simulation")
    return " · ".join(words)
