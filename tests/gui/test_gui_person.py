"""The page of `rtee retarget --show`."""

from __future__ import annotations

from collections.abc import AsyncIterator

import anyio
import pytest

from rtee.cli.retarget import answered
from rtee.gui.access import Access
from rtee.gui.person import Answer, show_person
from rtee.retarget import Retargeter
from rtee.retarget.frames import TrackerFrame
from rtee.testing.human_hand import shown


def test_a_persons_hand_is_shown_beside_the_robots(capsys: pytest.CaptureFixture[str]) -> None:
    retargeter = Retargeter.of("wsg50")
    frames = [TrackerFrame(k / 1000.0, points) for k, points in enumerate(shown()[::40])]
    seen: list[Answer] = []

    async def first() -> AsyncIterator[Answer]:
        async for answer in answered(retargeter, frames):
            seen.append(answer)
            yield answer
            if len(seen) > len(frames):  # it begins again
                return

    async def main() -> None:
        await show_person(retargeter.hand, first(), access=Access(), port=0)

    anyio.run(main)
    assert "GUI at http://127.0.0.1:" in capsys.readouterr().out
    points, positions = seen[-1]
    assert points.shape == (21, 3)
    assert positions.shape == retargeter.hand.rest.shape
