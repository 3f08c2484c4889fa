"""The GUI: one page per window, which shows a running hand and reconnects after its loss."""

from __future__ import annotations

import contextlib
import gc
import io
import math
import os
import secrets
import warnings
from collections.abc import Iterator
from functools import partial
from html import escape
from typing import Final

import anyio
import viser
from anyio.abc import TaskGroup

from rtee import monotonic
from rtee.errors import ConfigError, RteeError
from rtee.gui.access import Access, PageRole
from rtee.gui.bridge import Bridge, Stage
from rtee.gui.colours import BAD, GOOD, WARN
from rtee.gui.headset import Follow
from rtee.gui.panels.approval import Approval
from rtee.gui.panels.trying import Jobs
from rtee.gui.session import HandSession
from rtee.gui.visitors import Visitors
from rtee.gui.watch import AGAIN, Watch, first_message
from rtee.gui.wording import coloured, small
from rtee.loop.memory import give_memory_back
from rtee.remote.client import connect, stop_hand
from rtee.remote.directory import hands_running
from rtee.remote.fleet import Fleet, HandAddress, Look, following
from rtee.remote.truth import Tone, Truth, Words, clock

_DRAW_PERIOD: Final = 1 / 30
"""Time between two updates of a window [s]: 30 frames per second look smooth."""


class Page:
    """One window with a hand; if the hand is lost, it shows the last state until the hand returns.

    Attributes:
        session: The panels of the hand, or of the last one if it is lost.
        watch: The known state of the hand.
        narrow: Whether the window has no room for plots beside the hand.
        key: The secret of the window's bar: observers cannot act for it.
    """

    def __init__(self, app: App, stage: Stage) -> None:
        """Build the top of the page; must be called in the event loop."""
        self.session: HandSession | None = None
        self.watch = app.watch()
        self._app = app
        self.bridge = Bridge(stage)
        self._open = True
        self.narrow = False
        self._scope = anyio.CancelScope()
        gui = stage.gui
        self.key = secrets.token_urlsafe(12)
        self._top = gui.add_folder("Hand", order=-1)
        with self._top:
            gui.add_html(f'<i data-rtee-window="{self.key}"></i>')
            self._hands = gui.add_dropdown(
                "Hand",
                (self.watch.truth.hand or "–",),
                hint="Which of the hands that run on this computer is shown",
                visible=False,
            )
        self._hands.on_update(self.bridge.clicked(self._chosen))

    async def _chosen(self) -> None:
        self.choose(str(self._hands.value))

    def choose(self, name: str) -> None:
        """Show another hand; must be called in the event loop."""
        if name not in ("–", self.watch.truth.hand):
            self.watch = self._app.watch(name)
            self._scope.cancel()

    def offer(self, names: tuple[str, ...]) -> None:
        """Offer the running hands and the displayed one."""
        shown = self.watch.truth.hand
        # A lost hand stays in the list, since the page shows it again when it returns.
        names = tuple(sorted({*names, *([shown] if shown else [])}))
        self._hands.visible = len(names) > 1
        if names and tuple(self._hands.options) != names:
            self._hands.options = names
            self._hands.value = shown or names[0]

    async def run(self) -> None:
        """Show hands until the window is closed."""
        async with anyio.create_task_group() as group:
            group.start_soon(self._draw)
            while self._open:
                with anyio.CancelScope() as self._scope:
                    try:
                        await self._show(self.watch)
                    except RteeError:  # the bar shows the reason
                        pass
                    except BaseExceptionGroup as errors:  # raised by the session's tasks
                        first_message(errors)
                if not self._scope.cancel_called:
                    await anyio.sleep(AGAIN)
            group.cancel_scope.cancel()

    async def _draw(self) -> None:
        while True:
            await anyio.sleep(_DRAW_PERIOD)
            if self.session is not None and self._open:
                self.session.draw(monotonic.now())

    async def _show(self, watch: Watch) -> None:
        await watch.model()
        endpoint = self._app.endpoint
        async with connect(watch.truth.hand, endpoint=endpoint, client="gui") as remote:
            self.bridge.role, self.bridge.truth = remote.role, watch.truth
            if self.session is not None:
                self.session.remove()
            with self.bridge.stage.atomic():
                self.session = session = HandSession(
                    self.bridge, remote, watch, self._top, self._app.jobs, narrow=self.narrow
                )
            watch.watched += 1
            try:
                await session.run()
            finally:
                watch.watched -= 1
                # Leave properly: the hand treats a client that just vanishes as lost.
                with anyio.CancelScope(shield=True):
                    await self.bridge.close()
                    await session.leave()
                    await remote.leave()

    async def fold(self) -> None:
        """Fold the plots away to leave room for the hand."""
        self.narrow = True
        if self.session is not None:
            self.session.fold()

    async def close(self) -> None:
        """Release the hand, and end once the tasks of its clicks have ended."""
        self._open = False
        if self.session is not None:
            await self.session.leave()
        await self.bridge.done()
        self._scope.cancel()


class App:
    """The pages of all windows, with their hands and the hands' states.

    Attributes:
        endpoint: Address of the hand, if it runs on another computer.
        approval: Answers the questions of agents.
        jobs: Runs the trials of all windows.
        pages: The pages by the number of their window.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        hand: str | None,
        endpoint: str | None,
        visitors: Visitors | None = None,
    ) -> None:
        """Prepare to show a hand, or the first one that runs; must be called in the event loop.

        The ``endpoint`` is needed for a hand on another computer. Windows come from the visitors.
        """
        self.server, self.endpoint = server, endpoint
        self.jobs = Jobs()
        self.pages: dict[int, Page] = {}
        self._wanted = hand
        self._watches: dict[str, Watch] = {}
        self._group: TaskGroup | None = None
        self._bridge = Bridge(server)
        self._run = os.urandom(4).hex()
        self.approval = Approval(self._bridge, self._attended)
        server.gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 90, 140),
        )
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label("rtee")
        self._visitors = visitors
        if visitors is not None:
            visitors.desk = self

    async def run(self) -> None:
        """Show hands until cancelled."""
        async with anyio.create_task_group() as self._group:
            self._group.start_soon(self.approval.run)
            if self._visitors is not None:
                self._visitors.tell(self._come, self._go)
            while True:
                self._offer()
                await anyio.sleep(AGAIN)

    def _attended(self) -> bool:
        """Return whether a window is open whose user may answer."""
        if self._visitors is None:
            return bool(self.server.get_clients())
        return self._visitors.attended

    # --- windows

    def open(self, stage: Stage) -> Page:
        """Open a page in one window, or in all windows; must be called in the event loop."""
        assert self._group is not None  # noqa: S101 - `run` comes first
        number = stage.client_id if isinstance(stage, viser.ClientHandle) else 0
        page = self.pages[number] = Page(self, stage)
        self._group.start_soon(page.run)
        return page

    def _come(self, client: viser.ClientHandle) -> None:
        async def opened() -> None:
            self.open(client)

        self._bridge.call(opened)

    def _go(self, number: int) -> None:
        async def closed() -> None:
            page = self.pages.pop(number, None)
            if page is not None:
                await page.close()

        self._bridge.call(closed)

    # --- hands

    def watch(self, name: str | None = None) -> Watch:
        """Return the watch of a hand: by default the requested hand, otherwise the running one."""
        name = name or self._wanted or ""
        if name not in self._watches:
            assert self._group is not None  # noqa: S101
            found = self._watches[name] = Watch(name or None, self.endpoint)
            self._group.start_soon(found.run)
        return self._watches[name]

    def _offer(self) -> None:
        if self.endpoint is None:
            names = tuple(hands_running())
            if self._wanted is None and names:
                self._wanted = names[0]
                for page in self.pages.values():
                    page.choose(names[0])
            for page in self.pages.values():
                page.offer(names)

    # --- the bar

    def _page(self, key: str) -> Page | None:
        pages = tuple(self.pages.values())  # windows open and close in the meantime
        return next((page for page in pages if page.key == key), None)

    def words(self, key: str) -> dict[str, object]:
        """Return the text of the bar of the window with this key."""
        page = self._page(key)
        truth = Truth() if page is None else page.watch.truth
        sessions = {p.key: p.session for p in tuple(self.pages.values())}
        names = {k: "" if s is None else s.client for k, s in sessions.items()}
        own = names.pop(key, "")
        past = "" if page is None or page.session is None else page.session.recorded
        held = truth.held()
        return {
            "run": self._run,
            "title": f"{truth.hand or 'rtee'}: {held.text}",
            "held": Words(f"hand now: {held.text}", held.tone) if past else held,
            # A click on a panel of the hand before would reach nothing.
            "link": truth.link()
            if truth.stale or page is None or page.session is None or page.session.current
            else Words(f"{truth.hand}: connecting …", Tone.WARN),
            "mode": Words(f"RECORDING {past}: not the hand", Tone.WARN)
            if past
            else truth.control(own, list(names.values())),
            "doing": truth.doing(),
            "old": truth.stale and not past,
            "recorded": bool(past),
        }

    def press(self, button: str, key: str) -> None:
        """Execute the command of a button of a window's bar; from any thread."""
        page = self._page(key)
        if button == "stop":
            self._bridge.call(lambda: self._stop(page))
        elif page is not None and button == "narrow":
            page.bridge.call(page.fold, always=True)
        elif page is not None and page.session is not None:
            _, _, time = button.partition(" ")
            show = partial(page.session.scrub, float(time)) if time else page.session.live
            page.bridge.call(show, always=True)

    async def _stop(self, page: Page | None) -> None:
        truth = Truth(self._wanted or "") if page is None else page.watch.truth
        truth.stopped = Words(f"{clock()} stopping …", Tone.WARN)
        confirmed: dict[str, bool] = {}
        try:
            if page is None or page.session is None or truth.stale:
                hand = truth.hand or None
                confirmed = (await stop_hand(hand, endpoint=self.endpoint, client="gui"))[1]
            else:
                confirmed = await page.session.stop()
            why = "no answer"
        except RteeError as error:
            why = str(error)
        silent = ", ".join(name for name, done in confirmed.items() if not done)
        if not confirmed:
            words = Words(f"{clock()} STOP has NOT reached the hand: {why}", Tone.BAD)
        elif silent:
            words = Words(f"{clock()} STOP NOT confirmed by {silent}", Tone.BAD)
        else:
            words = Words(f"{clock()} stopped, confirmed by {', '.join(confirmed)}", Tone.WARN)
        truth.stopped = words


_LINKS: Final = {PageRole.OPERATOR: "GUI at", PageRole.OBSERVER: "to watch and stop only:"}
"""Text before a printed address, by role."""


def _announce(role: PageRole, link: str, prefix: str = "rtee: for another browser:") -> None:
    """Print an address, by default the one for the next browser."""
    print(f"{prefix} {_LINKS[role]} {link}", flush=True)  # noqa: T201


async def serve(
    hand: str | None,
    *,
    access: Access,
    port: int = 8080,
    endpoint: str | None = None,
    follow: Follow | None = None,
) -> None:
    """Serve the GUI of a hand, or of any running hand, until cancelled.

    Frames of headsets go to ``follow``.

    If the port is in use, takes the next free one, or raises `ConfigError` where a proxy forwards
    to it. Raises `LoopError` if the access checks cannot be added to the installed viser.
    """
    # Python runs a full garbage collection once a quarter of all objects are new. Without the
    # imported objects, it does so every few minutes instead of hours, and examines fewer.
    gc.collect()
    gc.freeze()
    # Tasks of a window's clicks continue after it closes; their messages are discarded.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    give_memory_back()
    visitors = Visitors(access, follow)
    access.announce = _announce  # a browser may come before the first address is printed
    with _opened(visitors, access, port) as server:
        await App(server, hand, endpoint, visitors).run()


@contextlib.contextmanager
def _opened(visitors: Visitors, access: Access, port: int) -> Iterator[viser.ViserServer]:
    """Run a server and print its addresses.

    Raises `ConfigError` if a proxy forwards to this port and it is in use or 0.
    """
    server = visitors.open_server(port)
    try:
        # viser takes the next free port, but the proxy would forward to the program on this one.
        if access.behind_proxy and server.get_port() != port:
            raise ConfigError(
                f"port {port}, to which the proxy forwards, is not free; choose another one with"
                " --port and in the proxy"
                if port
                else "--behind-proxy needs --port with the port to which the proxy forwards"
            )
        for role, link in access.links(server.get_port()).items():
            _announce(role, link, "rtee:")
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


_DRAWN_EVERY: Final = 1.0
"""Time between two updates of all cards [s]: often enough to see which hand moves."""

_COLOURS: Final = {"ready": GOOD, "moving": GOOD, "leased": WARN, "inactive": WARN}
"""Colours of conditions; all others have the colour `BAD`."""


class Cards:
    """Cards of the discovered hands, in a page; the STOP above it stops them all.

    Attributes:
        cards: The HTML content of each card.
        chosen: The hand whose card was clicked.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        """Prepare an empty page; must be called in the event loop."""
        self._gui, self._bridge = server.gui, Bridge(server)
        self._gui.set_panel_label("rtee")
        self.cards: dict[HandAddress, viser.GuiHtmlHandle] = {}
        self._folders: dict[HandAddress, viser.GuiFolderHandle] = {}
        self._clicked = anyio.Event()
        self._run = os.urandom(4).hex()  # the next page has another one, so the browser reloads
        self._stopped = Words("")
        self.chosen: HandAddress | None = None

    def words(self, key: str) -> dict[str, object]:
        """Return the text of the bar."""
        count = sum(bool(place.hand) for place in self.cards)
        held = Words(f"{count} hand{'s' * (count != 1)}: STOP stops all")
        rest = {"link": Words(""), "mode": Words(""), "old": False, "recorded": False}
        return {"run": self._run, "title": "rtee", "held": held, "doing": self._stopped, **rest}

    def press(self, button: str, key: str) -> None:
        """Stop all hands if the button is STOP; from any thread."""
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
        """Show the hands' answers, and remove the cards of hands that are gone."""
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
        *(device.trouble for device in look.idle),
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
    with _opened(visitors, access, port) as server:
        taken = server.get_port()
        async with following([endpoint] if endpoint else [], here=endpoint is None) as fleet:
            await fleet.known()
            visitors.desk = cards = Cards(server)
            place = await cards.run(fleet)
    await serve(place.hand, access=access, port=taken, endpoint=endpoint, follow=follow)
