"""Showing a recording: its hand runs on the replay driver."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path


def show(path: Path, *, speed: float, repeat: bool, gui: bool) -> int:
    """Run the hand of a recording on its recorded states until Ctrl-C.

    The hand is the configured one of that name if it has the same actuators, else the one that the
    recording itself describes. A recording that was never closed is shown from a whole copy.

    Args:
        path: The recording.
        speed: How fast time passes in it.
        repeat: Begin again at its end.
        gui: Open the hand in the browser.

    Returns:
        The exit status.
    """
    import anyio

    from rtee.log.playback import write_hand
    from rtee.log.reader import read
    from rtee.log.recover import recover
    from rtee.messages.topics import ROBOT_DESCRIPTION
    from rtee.run import RunOptions, run_hands

    recording = read(path, only=[ROBOT_DESCRIPTION])
    with tempfile.TemporaryDirectory(prefix="rtee-replay-") as folder:
        if not recording.finished:
            path = recover(path, Path(folder) / path.name).path
        hand = recording.hand
        if not _configured(hand, recording.metadata.get("actuators", "").split()):
            hand = str(write_hand(recording, Path(folder)))
        options = RunOptions(
            driver="replay",
            driver_options={"file": str(path.absolute()), "speed": speed, "repeat": repeat},
            rate=recording.rate or None,
            record=False,
            companions=((sys.executable, "-m", "rtee", "gui"),) if gui else (),
        )

        async def main() -> int:
            return await run_hands([hand], options, say=lambda line: print(line, flush=True))

        return anyio.run(main)


def _configured(name: str, actuators: list[str]) -> bool:
    """Whether there is a configured hand of this name with these actuators."""
    from rtee.errors import UserError
    from rtee.hand.catalog import find_hand
    from rtee.hand.load import load_hand

    try:
        find_hand(name)
        return sorted(load_hand(name).actuator_names) == sorted(actuators)
    except UserError:
        return False
