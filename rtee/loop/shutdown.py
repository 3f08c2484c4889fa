"""End a hand's loop with the configured behaviour, always within a bounded time."""

from __future__ import annotations

import logging

import anyio

from rtee.errors import RteeError
from rtee.hand.config_schema import Behaviour
from rtee.loop.handloop import ITSELF, HandLoop
from rtee.loop.planning import OPEN
from rtee.types import Event, Goal, Named

log = logging.getLogger(__name__)

OPEN_WITHIN = 3.0
"""Time that opening may take at the end [s]: most hands open faster, and service managers wait
longer before they kill a process."""

REST_WITHIN = 0.18
"""Time that the other behaviours may take [s]: the devices' time to confirm, and a little for the
tasks."""


async def bring_to_rest(
    loop: HandLoop, behaviour: Behaviour, reason: str, *, ticking: bool = True
) -> list[tuple[str, bool]]:
    """Bring a hand to rest before its loop ends. Cannot raise or be cancelled; ends in time.

    Args:
        loop: The hand.
        behaviour: The behaviour to apply.
        reason: Why, for the log.
        ticking: Whether the loop still ticks; else the hand can't open, and is stopped.

    Returns:
        Every device with whether it confirmed.
    """
    confirmed = dict.fromkeys(loop.devices, False)
    # The run is being cancelled: without the shield, the first await would raise.
    with anyio.CancelScope(shield=True):
        try:
            if behaviour is Behaviour.OPEN:
                # An opened hand holds its posture; one that could not open is stopped.
                opened = ticking and await _open(loop)
                behaviour = Behaviour.HOLD if opened else Behaviour.STOP
            with anyio.move_on_after(REST_WITHIN):
                match behaviour:
                    case Behaviour.DISABLE:
                        confirmed |= dict(await loop.disable(reason))
                    case Behaviour.STOP:
                        confirmed |= dict(await loop.stop(reason))
                    case _:
                        confirmed |= dict(await loop.keep(reason))
            if behaviour is not Behaviour.STOP:  # `HandLoop.stop` reports itself
                _report(loop, behaviour, reason, confirmed)
        except Exception:
            log.exception("%s could not be brought to rest (%s)", loop.name, behaviour)
    return list(confirmed.items())


async def _open(loop: HandLoop) -> bool:
    with anyio.move_on_after(OPEN_WITHIN):
        try:
            await loop.execute(Goal(Named(OPEN), client=ITSELF, timeout=OPEN_WITHIN), partly=True)
        except RteeError as error:
            log.warning("%s cannot open: %s", loop.name, error)
            return False
    return True


def _report(loop: HandLoop, behaviour: Behaviour, reason: str, confirmed: dict[str, bool]) -> None:
    missing = [name for name, done in confirmed.items() if not done]
    text = f"{loop.name}: {reason}, {behaviour}"
    text += f"; not confirmed by {', '.join(missing)}" if missing else "; confirmed"
    severity = "error" if missing else "info"
    loop.announce(Event("at_rest", loop.name, text, loop.now(), severity))
