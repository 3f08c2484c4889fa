"""Runs trials and plans for the page: one at a time, in a process beside the GUI."""

from __future__ import annotations

import asyncio
import asyncio.subprocess
from collections.abc import Callable
from typing import Any, Final

from rtee.errors import RequestRejected
from rtee.trials.apart import LONGEST_LINE, Job, command, read_line

Tell = Callable[[dict[str, Any]], None]
"""Called with what the process says: ``progress`` and ``text``, ``result`` or ``ranking``."""

_PIPE: Final = asyncio.subprocess.PIPE
_NOTHING: Final = asyncio.subprocess.DEVNULL


class Jobs:
    """Does one job at a time, for all windows; its methods are called in the event loop."""

    def __init__(self) -> None:
        self._process: asyncio.subprocess.Process | None = None
        self._doing = ""
        self._cancelled = False

    @property
    def doing(self) -> str:
        """What is under way, in words; empty if nothing is."""
        return self._doing

    def check_free(self) -> None:
        """Raise `RequestRejected` if something is under way."""
        if self._doing:
            raise RequestRejected(f"{self._doing} is under way; wait for its end, or cancel it")

    async def do(self, job: Job, what: str, tell: Tell) -> bool:
        """Do a job to its end.

        Args:
            job: The job.
            what: What it is, in words.
            tell: Called with what comes of it.

        Returns:
            Whether it was not cancelled.

        Raises:
            RequestRejected: if another one is under way, or it cannot be done, with the reason.
            ConfigError: if it makes no sense.
        """
        self.check_free()
        job.check()
        self._doing, self._cancelled = what, False
        try:
            return await self._run(job, tell)
        finally:
            self._doing = ""
            # When the GUI ends, this task is cancelled while the process still works.
            process, self._process = self._process, None
            if process is not None and process.returncode is None:
                process.kill()
                await process.wait()

    async def _run(self, job: Job, tell: Tell) -> bool:
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
            said = read_line(line)
            if "error" in said:
                raise RequestRejected(str(said["error"]))
            if "done" in said:
                return True
            tell(said)
        if self._cancelled:
            return False
        # Its output has ended without a last word: it crashed or was killed.
        status = await process.wait()
        raise RequestRejected(
            f"{self._doing} ended with exit status {status}; see rtee try or rtee grasp-plan"
        )

    def cancel(self) -> None:
        """End what is under way at once; nothing if nothing is."""
        self._cancelled = True
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
