"""`rtee do` and `rtee open`: execute a grasping action, with its progress on the terminal."""

from __future__ import annotations

import contextlib
import math
import signal
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

# Imported before a goal begins: a signal that arrives during an import would not cancel it.
import anyio
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn

from rtee.cli._common import (
    ConnectOption,
    EffortOption,
    JsonOption,
    OnContactOption,
    RunningOption,
    TimeoutOption,
    WaitOption,
    complete_action,
    complete_element,
    effort_limits,
    to_json,
    with_hand,
)
from rtee.errors import RteeError
from rtee.remote.words import sentence
from rtee.types import Around, EventKind, Outcome, Stage

if TYPE_CHECKING:
    from anyio.abc import TaskStatus

    from rtee.remote.client import RemoteHand
    from rtee.remote.goal import RunningGoal
    from rtee.types import Feedback, Result


def do(
    action: Annotated[str, typer.Argument(autocompletion=complete_action)],
    elements: Annotated[list[str] | None, typer.Argument(autocompletion=complete_element)] = None,
    *,
    intensity: str = "1.0",
    effort: EffortOption = None,
    speed: str = "1.0",
    tolerance: float = 0.01,
    timeout: TimeoutOption = None,
    stage: Stage = Stage.BOTH,
    kind: str | None = None,
    opening: str | None = None,
    force: str | None = None,
    on_contact: OnContactOption = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Execute a grasping action; Ctrl-C cancels it.

    Example: rtee do pinch_tight index thumb --intensity 0.6

    Arguments and options:
        action (ACTION): Name of an action, in any spelling.
        elements (ELEMENT…): Fingers, or the actuator, of a primitive, in any order.
        intensity (SHARE): 0 (rest posture) to 1 (the action's posture), or 0% to 100%.
        speed (SHARE): Scale of the velocity limits, up to 1 or 100%.
        tolerance: Error norm that counts as reached.
        stage: How far a pinch goes; other actions have no stages.
        kind: Kind of the action, where its name is ambiguous.
        opening (LENGTH): Opening of the fingertips instead of an intensity, such as 30mm.
        force (FORCE): Force between the fingertips, such as 10N.
    """
    from rtee.actions.cli_syntax import read_efforts, read_on_contact
    from rtee.actions.naming import label
    from rtee.remote.goal_values import action_goal

    efforts = read_efforts(effort or [])
    chosen = tuple(elements or ())
    options: dict[str, Any] = {
        "intensity": intensity,
        "speed": speed,
        "tolerance": tolerance,
        "timeout": timeout,
        "stage": stage,
        "kind": kind,
        "on_contact": read_on_contact(on_contact or []),
        "opening": opening,
        "force": force,
    }
    action_goal(action, *chosen, **options)  # before a hand is looked for

    async def execute(remote: RemoteHand) -> Result:
        options["effort"] = await effort_limits(remote, efforts)
        goal = action_goal(action, *chosen, **options)
        return await follow(remote, remote.start_goal(goal), label(action, chosen))

    _end(with_hand(hand, connect, "do", execute, wait=wait), as_json, chosen)


def open_(
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring the hand to its rest posture, or do its action "open" if it has one."""

    async def execute(remote: RemoteHand) -> Result:
        return await follow(remote, remote.start("open"), "open")

    _end(with_hand(hand, connect, "open", execute, wait=wait), as_json)


def _end(result: Result, as_json: bool, elements: Sequence[str] = (), remark: str = "") -> NoReturn:
    """Print a result, with a remark behind its sentence, and end with its exit status."""
    told = {**result.to_dict(), "succeeded": result.succeeded}
    print(to_json(told) if as_json else sentence(result, elements))
    if remark and not as_json:
        print(remark)
    raise typer.Exit(0 if result.succeeded else 1)


async def follow(remote: RemoteHand, start: Awaitable[RunningGoal], title: str) -> Result:
    """Start a goal and show its progress; Ctrl-C cancels it, a second Ctrl-C ends the command."""
    events = remote.events()
    # Progress is for people; the output holds the result alone.
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bars = _Bars(progress, title)

        async def tell_speed() -> None:
            with contextlib.suppress(RteeError):  # the goal says it, too
                async for event in events:
                    if event.kind == EventKind.SLOWED:
                        # One line, whatever the width, and brackets in it are no markup.
                        console.print(event.text, markup=False, highlight=False, soft_wrap=True)

        result = await _interruptible(start, bars.show, tell_speed)
        # The last feedback may come from shortly before the end.
        if result.succeeded:
            bars.complete()
    return result


async def _interruptible(
    start: Awaitable[RunningGoal],
    show: Callable[[Feedback], None],
    beside: Callable[[], Coroutine[Any, Any, None]],
) -> Result:
    goals: list[RunningGoal] = []
    started = anyio.Event()

    async def cancel_on_signal(*, task_status: TaskStatus[None]) -> None:
        # Leaving the context restores the usual effect of a signal: the second one ends this.
        with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
            task_status.started()
            async for _ in signals:
                break
        # The signal may arrive before the hand has accepted the goal that it cancels.
        await started.wait()
        # If cancelling fails, the result, which is awaited in any case, says why.
        with contextlib.suppress(RteeError):
            await goals[0].cancel()

    errors: list[RteeError] = []
    async with anyio.create_task_group() as group:
        # Started before the goal is sent, so that a signal never leaves the goal running.
        await group.start(cancel_on_signal)
        group.start_soon(beside)
        try:
            goals.append(await start)
            started.set()
            return await goals[0].result(show)
        except RteeError as error:  # raised below, since the task group would wrap it
            errors.append(error)
        finally:
            group.cancel_scope.cancel()
    raise errors[0]


class _Bars:
    """One progress bar for the goal, and one for each inner action of a timed one."""

    def __init__(self, progress: Progress, title: str) -> None:
        self._progress = progress
        self._whole = progress.add_task(title, total=1.0)
        self._inner: dict[str, TaskID] = {}

    def show(self, feedback: Feedback) -> None:
        self._progress.update(self._whole, completed=feedback.progress)
        for name, value in feedback.inner_progress.items():
            if name not in self._inner:
                self._inner[name] = self._progress.add_task(f"  {name}", total=1.0)
            self._progress.update(self._inner[name], completed=value)

    def complete(self) -> None:
        for task in (self._whole, *self._inner.values()):
            self._progress.update(task, completed=1.0)


def grasp(
    fingers: list[str] | None = None,
    *,
    width: str,
    force: str | None = None,
    speed: str | None = None,
    narrower: str = "5mm",
    wider: str = "5mm",
    action: str = "",
    timeout: TimeoutOption = None,
    on_contact: OnContactOption = None,
    max_force: str | None = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Open wider than an object, close on it, and keep a force; Ctrl-C cancels it.

    Exit status 1 when nothing of that width is held.

    Example: rtee grasp --width 30mm --force 10N index thumb

    Arguments and options:
        width (LENGTH): Width of the object, such as 30mm, 3cm or 0.03.
        fingers (FINGER…): Fingers to hold it with; the hand's best action unless given.
        force (FORCE): Force to hold it with, such as 10N.
        speed (SPEED): Speed of opening and closing, such as 50mm/s.
        narrower (LENGTH): How much narrower than its width it may be held.
        wider (LENGTH): How much wider than its width it may be held.
        action: The action to close with, instead of the best one.
        max_force (FORCE): Force up to which a slip raises --force.
    """
    from rtee.actions.cli_syntax import read_on_contact
    from rtee.remote.goal_values import grasp_goal

    goal = grasp_goal(
        width,
        force=force,
        tip_speed=speed,
        fingers=fingers,
        width_tolerance=(narrower, wider),
        action=action,
        timeout=timeout,
        max_force=max_force,
        on_contact=read_on_contact(on_contact or []),
    )
    asked = goal.to if isinstance(goal.to, Around) else Around(math.nan)

    async def execute(remote: RemoteHand) -> Result:
        return await follow(remote, remote.start_goal(goal), f"grasp {asked.width * 1e3:g} mm")

    result = with_hand(hand, connect, "grasp", execute, wait=wait)
    remark = ""
    # The exit status alone would not say why it is a failure.
    if result.outcome is Outcome.WRONG_WIDTH:
        least, most = (1e3 * (asked.width + by) for by in (-asked.narrower, asked.wider))
        remark = f"what is held is not {max(least, 0.0):g} to {most:g} mm wide, as asked"
    _end(result, as_json, result.elements, remark)


def touch(
    fingers: list[str] | None = None,
    *,
    action: str = "",
    speed: str | None = None,
    timeout: TimeoutOption = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Close slowly until a finger touches something, and stop there; Ctrl-C cancels it.

    Exit status 1 when nothing was touched.

    Example: rtee touch index thumb

    Arguments and options:
        fingers (FINGER…): Fingers to close; as many as possible by default.
        action: The action to close with.
        speed (SPEED): Speed of closing; 10mm/s by default.
    """
    from rtee.remote.goal_values import touch_goal

    goal = touch_goal(fingers=fingers, action=action, tip_speed=speed, timeout=timeout)

    async def execute(remote: RemoteHand) -> Result:
        return await follow(remote, remote.start_goal(goal), "touch")

    result = with_hand(hand, connect, "touch", execute, wait=wait)
    # A goal that was cancelled or stopped has its own outcome, but may have touched nothing.
    nothing = not result.touched and result.outcome not in (Outcome.EMPTY, Outcome.UNKNOWN)
    _end(result, as_json, result.elements, "nothing was touched" if nothing else "")
