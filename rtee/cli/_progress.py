"""A goal under way on the terminal: one bar, and one for each inner action of a timed one."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

import anyio
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn

from rtee.errors import RteeError

if TYPE_CHECKING:
    from rtee.remote.goal import RunningGoal
    from rtee.types import Feedback, Result


async def follow(running: RunningGoal, title: str) -> Result:
    """Show a goal's progress until its result; Ctrl-C cancels it, a second one leaves it.

    Args:
        running: The goal.
        title: What the bar is called.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bars = _Bars(progress, title)
        result = await _interruptible(running, bars.show)
        if result.succeeded:
            bars.complete()
    return result


async def _interruptible(running: RunningGoal, show: Callable[[Feedback], None]) -> Result:
    errors: list[RteeError] = []
    async with anyio.create_task_group() as group:
        group.start_soon(_cancel_on_signal, running)
        try:
            return await running.result(show)
        except RteeError as error:  # out of the task group it comes bare
            errors.append(error)
        finally:
            group.cancel_scope.cancel()
    raise errors[0]


async def _cancel_on_signal(running: RunningGoal) -> None:
    """Cancel the goal at the first signal; the next one does what it does anywhere."""
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async for _ in signals:
            break
    with contextlib.suppress(RteeError):
        await running.cancel()


class _Bars:
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
