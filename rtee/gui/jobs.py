"""Trials and grasp plans of the page, run one at a time in a process beside the GUI."""

from __future__ import annotations

import asyncio
import asyncio.subprocess
from collections.abc import Callable
from typing import Any, Final

from rtee.errors import RequestRejected
from rtee.trials.job import LONGEST_LINE, TrialJob, command, read_line

Report = Callable[[dict[str, Any]], None]
"""Receives a line of the process: ``progress`` and ``text``, ``result`` or ``ranking``."""

_PIPE: Final = asyncio.subprocess.PIPE
_NOTHING: Final = asyncio.subprocess.DEVNULL


class Jobs:
    """Runs one job at a time for all windows; call its methods in the event loop.

    `running` is the title of the job, empty if there is none.
    """

    def __init__(self) -> None:
        self.running = ""
        self._process: asyncio.subprocess.Process | None = None
        self._cancelled = False

    def check_free(self) -> None:
        """Raise `RequestRejected` if a job is running."""
        if self.running:
            raise RequestRejected(f"{self.running} is under way; wait for its end, or cancel it")

    async def run(self, job: TrialJob, title: str, report: Report) -> bool:
        """Run a job to its end; return whether it was not cancelled.

        Raises `RequestRejected` if another job is running, or this one fails, with the reason, and
        `ConfigError` if an argument of the job is out of range.
        """
        self.check_free()
        job.check()
        self.running, self._cancelled = title, False
        try:
            return await self._run(job, report)
        finally:
            self.running = ""
            # When the GUI ends, it cancels this task while the process still works.
            process, self._process = self._process, None
            if process is not None and process.returncode is None:
                process.kill()
                await process.wait()

    async def _run(self, job: TrialJob, report: Report) -> bool:
        arguments, environment = command()
        process = self._process = await asyncio.create_subprocess_exec(
            *arguments,
            stdin=_PIPE,
            stdout=_PIPE,
            stderr=_NOTHING,
            env=environment,
            limit=LONGEST_LINE,
        )
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        process.stdin.write(job.to_json().encode() + b"\n")
        while not self._cancelled and (line := await process.stdout.readline()):
            message = read_line(line)
            if "error" in message:
                raise RequestRejected(str(message["error"]))
            if "done" in message:
                return True
            report(message)
        if self._cancelled:
            return False
        # The output has ended without "done": the process crashed or was killed.
        status = await process.wait()
        raise RequestRejected(
            f"{self.running} ended with exit status {status}; see rtee try or rtee grasp-plan"
        )

    def cancel(self) -> None:
        """Kill the process of the running job, if there is one."""
        self._cancelled = True
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
