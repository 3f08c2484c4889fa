"""The page before a hand is chosen: a card for each that runs, a click away.

It has a server of its own, at the port of the page that follows: the browser's window connects to
that by itself, with the cookie that it has.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
from html import escape
from typing import Final

import anyio
import viser

from rtee.errors import ConfigError, RteeError
from rtee.gui.access import Access
from rtee.gui.app import serve
from rtee.gui.bridge import Bridge
from rtee.gui.colours import BAD, GOOD, WARN
from rtee.gui.headset import Follow
from rtee.gui.visitors import Visitors
from rtee.gui.wording import coloured, small
from rtee.remote.client import stop_hand
from rtee.remote.fleet import Fleet, HandAddress, Look, following
from rtee.remote.truth import Tone, Words, clock

_DRAWN_EVERY: Final = 1.0
"""Time between two looks at all hands [s]: often enough to see which one moves."""

_COLOURS: Final = {"ready": GOOD, "moving": GOOD, "leased": WARN, "inactive": WARN}
"""Colours of conditions; all others are bad."""


class Cards:
    """Cards of the hands that were found, in a page; the STOP above it stops them all.

    Attributes:
        cards: What each card says, as HTML.
        chosen: The hand whose card was clicked.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        """Add nothing yet; must be called in the event loop."""
        self._gui, self._bridge = server.gui, Bridge(server)
        self._gui.set_panel_label("rtee")
        self.cards: dict[HandAddress, viser.GuiHtmlHandle] = {}
        self._folders: dict[HandAddress, viser.GuiFolderHandle] = {}
        self._clicked = anyio.Event()
        self._run = os.urandom(4).hex()  # the page that follows has another one, and is reloaded
        self._stopped = Words("")
        self.chosen: HandAddress | None = None

    def words(self, key: str) -> dict[str, object]:
        """Return the text of the bar."""
        count = sum(bool(place.hand) for place in self.cards)
        held = Words(f"{count} hand{'s' * (count != 1)}: STOP stops all")
        rest = {"link": Words(""), "mode": Words(""), "old": False, "recorded": False}
        return {"run": self._run, "title": "rtee", "held": held, "doing": self._stopped, **rest}

    def press(self, button: str, key: str) -> None:
        """Stop all hands, if that is the button; from any thread."""
        if button == "stop":
            self._bridge.call(self._stop, always=True)

    async def _stop(self) -> None:
        said: list[str] = []

        async def stop(place: HandAddress) -> None:
            try:
                _, done = await stop_hand(place.hand, endpoint=place.endpoint or None, client="gui")
                silent = ", ".join(name for name, confirmed in done.items() if not confirmed)
                said.append(
                    f"{place.hand}: " + (f"NOT confirmed by {silent}" if silent else "stopped")
                )
            except RteeError as error:
                said.append(f"STOP has NOT reached {place.hand}: {error}")

        self._stopped = Words("stopping …", Tone.WARN)
        async with anyio.create_task_group() as group:
            for place in self.cards:
                if place.hand:
                    group.start_soon(stop, place)
        bad = any("NOT" in words for words in said)
        self._stopped = Words(f"{clock()} {'; '.join(said)}", Tone.BAD if bad else Tone.WARN)

    def draw(self, looks: list[Look]) -> None:
        """Show what hands answered; hands that were not found any more lose their card."""
        places = [look.place for look in looks]
        for place in [known for known in self._folders if known not in places]:
            self._folders.pop(place).remove()
            del self.cards[place]
        for number, look in enumerate(looks):
            if look.place not in self._folders:
                self._add(look.place, number)
            self.cards[look.place].content = _html(look)

    def _add(self, place: HandAddress, order: int) -> None:
        name = place.hand or place.endpoint
        self._folders[place] = folder = self._gui.add_folder(name, order=order)

        async def choose() -> None:
            self.choose(place)

        with folder:
            self.cards[place] = self._gui.add_html("")
            if place.hand:
                self._gui.add_button(f"Show {name}").on_click(self._bridge.clicked(choose))

    def choose(self, place: HandAddress) -> None:
        """Choose a hand, as a click on its card does."""
        self.chosen = place
        self._clicked.set()

    async def run(self, fleet: Fleet) -> HandAddress:
        """Draw until a hand is chosen, and return it."""
        while self.chosen is None:
            self.draw(await fleet.look())
            with anyio.move_on_after(_DRAWN_EVERY):
                await self._clicked.wait()
        await self._bridge.close()
        return self.chosen


def _html(look: Look) -> str:
    condition = coloured(look.condition, _COLOURS.get(look.condition, BAD))
    if look.status is None:
        return condition + small(escape(look.trouble))
    status = look.status
    clock, counts = status.statistics, status.counts
    lines = [
        status.action and f"does {status.action}",
        status.holder and f"held by {status.holder}",
        counts.result and f"last goal: {counts.result.replace('_', ' ')}",
        *(f"{d.name}: {d.fault_name or d.message or d.lifecycle}" for d in look.idle),
        "" if math.isnan(look.temperature) else f"{look.temperature:.0f} °C",
        clock.missed and f"{clock.missed} ticks missed",
        status.recording_trouble,
    ]
    return condition + "".join(small(escape(str(line))) for line in lines if line)


async def serve_chosen(
    *, access: Access, port: int, endpoint: str | None, follow: Follow | None = None
) -> None:
    """Serve the cards until one is clicked, then the GUI of that hand; see `rtee.gui.app.serve`.

    Raises:
        ConfigError: if the port is in use and a proxy forwards to it.
    """
    visitors = Visitors(access)
    server = visitors.open_server(port)
    try:
        taken = server.get_port()
        if access.behind_proxy and taken != port:
            raise ConfigError(f"port {port} is not free, and the proxy leads there")
        for link in access.links(taken).values():
            print(f"rtee: GUI at {link}", flush=True)  # noqa: T201
        async with following([endpoint] if endpoint else [], here=endpoint is None) as fleet:
            await fleet.known()
            visitors.desk = cards = Cards(server)
            place = await cards.run(fleet)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    await serve(place.hand, access=access, port=taken, endpoint=endpoint, follow=follow)
