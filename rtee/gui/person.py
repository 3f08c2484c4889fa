"""A person's hand and the robot hand in the browser: tracked points and the robot's posture."""

from __future__ import annotations

import contextlib
import io
from collections.abc import AsyncIterable
from typing import Final

import numpy as np

from rtee.gui.access import Access
from rtee.gui.colours import REFERENCE
from rtee.gui.scene import HandScene
from rtee.gui.visitors import Visitors
from rtee.hand.model import Hand
from rtee.sample import FloatArray

_BONES: Final = np.array(
    [(i, i + 1) for i in range(1, 20) if i % 4]
    + [(0, 1), (0, 5), (5, 9), (9, 13), (13, 17), (17, 0)]
)
"""Pairs of points joined by lines: the bones of the fingers and the outline of the palm."""

_THICK: Final = 0.004
"""Thickness of these lines [m]."""

Answer = tuple[FloatArray, FloatArray]
"""A person's points ``(21, 3)`` in the hand's base frame [m], and actuator positions ``(n,)``."""


async def show_person(
    hand: Hand, answers: AsyncIterable[Answer], *, access: Access, port: int = 8080
) -> None:
    """Serve a page with a person's hand and the robot hand until cancelled or the answers end.

    Raises:
        LoopError: if the access checks cannot be added to the installed viser.
    """
    server = Visitors(access).open_server(port)
    try:
        for link in access.links(server.get_port()).values():
            print(f"rtee: GUI at {link}", flush=True)  # noqa: T201
        scene = HandScene(server, hand)
        lines = server.scene.add_line_segments(
            "/person", np.zeros((len(_BONES), 2, 3)), REFERENCE, thickness=_THICK
        )
        async for points, positions in answers:
            with server.atomic():
                lines.points = points[_BONES].astype(np.float32)
                scene.show(hand.transmission.joints(positions))
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
