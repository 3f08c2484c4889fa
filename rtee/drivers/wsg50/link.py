"""Talks to a WSG 50 over its TCP connection: one request, or several in one packet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rtee.buses.parser import CodecError
from rtee.buses.serial import SerialBus
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.wsg50.codec import (
    MOTIONS,
    Command,
    Frame,
    FrameParser,
    Grasping,
    State,
    Status,
    asking,
    grasping_of,
    number,
    state_of,
)
from rtee.errors import BusError

_REPORT = (Command.STATE, Command.GRASPING, Command.WIDTH, Command.SPEED, Command.FORCE)


class WsgRefusal(BusError):
    """The gripper refused a command.

    Attributes:
        command: The refused command.
        status: The reason.
    """

    def __init__(self, bus: str, command: int, status: Status) -> None:
        name = status.name.lower().replace("_", " ")
        super().__init__(bus, f"the gripper refuses command {command:#04x}: {name}")
        self.command = command
        self.status = status


@dataclass(frozen=True, slots=True)
class WsgReport:
    """The gripper's report of every cycle.

    Attributes:
        state: The system's state.
        grasping: State of the grasp.
        width: Distance between the fingers [mm].
        speed: Rate of change of the width [mm/s].
        force: Force at the fingers, measured by the motor [N].
    """

    state: State = field(default_factory=lambda: State(0))
    grasping: Grasping = Grasping.IDLE
    width: float = 0.0
    speed: float = 0.0
    force: float = 0.0


class _ReportParser:
    """Collects the answers to the requests of a report, and drops all others.

    Answers carry the command but no number, so a report consists of the newest answer to each.
    """

    def __init__(self) -> None:
        self._frames = FrameParser()
        self._found: dict[int, Frame] = {}
        self._wrong = 0

    @property
    def errors(self) -> int:
        return self._frames.errors + self._wrong

    def reset(self) -> None:
        self._frames.reset()
        self._found.clear()

    def feed(self, data: bytes) -> list[WsgReport]:
        for frame in self._frames.feed(data):
            if frame.command in _REPORT:
                self._found[frame.command] = frame
        if len(self._found) < len(_REPORT):
            return []
        frames = [self._found[command] for command in _REPORT]
        # Before anything fails below: parts of this report must not complete the next one.
        self._found.clear()
        try:
            if any(frame.status is not Status.OK for frame in frames):
                raise CodecError("a request was refused")
            state, grasping, *rest = frames
            return [WsgReport(state_of(state), grasping_of(grasping), *map(number, rest))]
        except CodecError:
            self._wrong += 1
            return []


class WsgLink(RelaxedDeadline):
    """Talks to one gripper.

    Attributes:
        bus: The connection.
        deadline: Longest time for one exchange, retries included [s].
    """

    def __init__(self, bus: SerialBus, deadline: float) -> None:
        self.bus = bus
        self.deadline = deadline
        self._frames = FrameParser()
        self._reports = _ReportParser()
        # In one packet: on a network, each separate request would cost a round trip.
        self._requests = b"".join(asking(command).to_bytes() for command in _REPORT)

    async def report(self) -> WsgReport:
        """Return the gripper's report; raises `BusError`."""
        return await self.bus.transact(self._requests, self._reports, self.deadline)

    async def ask(self, request: Frame, *, retries: int = 1) -> Frame:
        """Send a request, repeating it up to ``retries`` times, and return its first answer.

        Raises `WsgRefusal` if the gripper refuses it, and `BusError`.
        """
        answer = await self.bus.transact(
            request.to_bytes(), self._frames, self.deadline, retries, accept=_answers(request)
        )
        status = answer.status
        if status not in (Status.OK, Status.PENDING):
            raise WsgRefusal(self.bus.name, request.command, status)
        return answer

    async def begin(self, request: Frame) -> bool:
        """Begin a motion; return whether the gripper accepts it: not while another is under way.

        Raises `WsgRefusal` if it refuses for another reason, and `BusError`.
        """
        try:
            # Sent once: if only the answer was lost, the motion has begun and shows in the state.
            await self.ask(request, retries=0)
        except WsgRefusal as refusal:
            if refusal.status is Status.ALREADY_RUNNING:
                return False
            raise
        return True


def _answers(request: Frame) -> Callable[[Frame], bool]:
    def accepted(answer: Frame) -> bool:
        if answer.command != request.command:
            return False
        try:
            status = answer.status
        except CodecError:
            return False
        # The result of an earlier motion may come first; these never refuse a new motion.
        results: Sequence[Status] = (Status.OK, Status.ABORTED, Status.FAILED, Status.AXIS_BLOCKED)
        return request.command not in MOTIONS or status not in results

    return accepted
