"""The GUI stands back: on a robot's computer the loop is what matters."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Final

NICE: Final = 10
"""How far the GUI's priority is below that of an ordinary program, see nice(2)."""


def stand_back() -> None:
    """Lower the priority of the calling thread and of all that it starts.

    It never interrupts another program when it wakes (SCHED_BATCH), and where processors are
    short it gets a tenth of what an ordinary program gets. Call it before anything starts threads.
    """
    with contextlib.suppress(OSError):  # some containers do not permit either
        os.nice(max(0, NICE - os.nice(0)))
        if sys.platform.startswith("linux") and os.sched_getscheduler(0) == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
