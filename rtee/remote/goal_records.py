"""Running goals and results of ended goals, for requests of clients.

Results are published once. A client whose connection was congested, or which connects again, asks
for a result by the goal's identifier.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

from rtee import monotonic
from rtee.messages.convert import RESULT
from rtee.remote.lease import Lease
from rtee.types import Result

KEPT_FOR = 60.0
"""Time for which results are kept [s]: many times as long as a client takes to ask for one."""

_MOST_KEPT = 1024
"""Most results that are kept, about 1 MB: a hand that executes 17 goals a second for a minute."""


class GoalRecords:
    """The running goals by the lease, and recent results, by the clock ``now`` [s].

    Any thread may call its methods.
    """

    def __init__(self, lease: Lease, now: Callable[[], float] = monotonic.asked) -> None:
        self._lease, self._now = lease, now
        self._changing = threading.Lock()
        self._results: OrderedDict[str, tuple[float, Result]] = OrderedDict()

    def ended(self, result: Result) -> None:
        """Keep a result, and record that its goal no longer holds the lease."""
        now = self._now()
        # First the result: until it is known, the goal counts as running.
        with self._changing:
            self._results[result.goal_id] = now, result
            self._results.move_to_end(result.goal_id)
            while len(self._results) > _MOST_KEPT:
                self._results.popitem(last=False)
            while next(iter(self._results.values()))[0] < now - KEPT_FOR:
                self._results.popitem(last=False)
        self._lease.ended(result.goal_id)

    def status(self, goal_id: str) -> Mapping[str, Any]:
        """Return the fields of a ``rtee_msgs/GoalStatus``."""
        # In this order, since the goal may end meanwhile.
        running = self._lease.runs(goal_id)
        with self._changing:
            kept = self._results.get(goal_id)
        results = [] if running or kept is None else [RESULT.fields(kept[1], time=kept[0])]
        return {"running": running, "result": results}
