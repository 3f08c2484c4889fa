"""The GUI's main loop: find a running hand, show it until it ends, and look for the next one."""

from __future__ import annotations

import contextlib
import gc
import io
from collections.abc import Iterator
from html import escape
from typing import Final

import anyio
import viser

from rtee.errors import ConfigError, NoHand, RteeError
from rtee.gui.access import Access, Role
from rtee.gui.bridge import Bridge
from rtee.gui.colours import BAD, GOOD, WARN
from rtee.gui.headset import Follow
from rtee.gui.panels.approval import Approval
from rtee.gui.session import Session
from rtee.gui.visitors import Visitors
from rtee.gui.wording import WRAPS
from rtee.loop.memory import give_memory_back
from rtee.remote.client import connect
from rtee.remote.find import hands_running
from rtee.remote.model import model_of

_POLL_PERIOD = 0.5
"""Time between two searches for running hands [s]: short enough to look immediate."""

# Keeps the group that contains the banner in sight when the panel is scrolled, and the right edges
# of panels beside their scrollbars, which otherwise lie 3 px over them.
_STYLE: Final = """<style>
.mantine-ScrollArea-content > div[style*="width: 100%"] { padding-right: 4px; }
.mantine-ScrollArea-content .mantine-ScrollArea-content > div { padding-right: 0 !important; }
.mantine-ScrollArea-content div[style*="overflow: hidden"]:has(.rtee-top) {
  overflow: clip !important; }
.mantine-ScrollArea-content div[style*="padding-top"] > :has(.rtee-top) {
  position: sticky; top: 0.5em; z-index: 10; background: var(--mantine-color-body);
  box-shadow: 0 -0.75em 0 var(--mantine-color-body); }
</style>"""


def _first(errors: BaseExceptionGroup[RteeError] | None) -> str:
    """Return the message of the first of several errors."""
    error: BaseException | None = errors
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return str(error)


class App:
    """One page of the GUI, open in any number of browser windows; its banner has a `message`.

    Attributes:
        approval: What answers the questions of agents.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        hand: str | None,
        endpoint: str | None,
        visitors: Visitors | None = None,
    ) -> None:
        """Prepare the page of a hand, or of the one chosen in it; must be called in the event loop.

        The ``endpoint`` is needed for a hand on another computer, the visitors if there may be
        observers.
        """
        self.server = server
        self.session: Session | None = None
        self.message = ""
        self._endpoint = endpoint
        self._wanted = hand
        self._bridge = Bridge(server, visitors)
        self.approval = Approval(self._bridge)
        server.gui.configure_theme(
            control_width="medium",
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 90, 140),
        )
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label("rtee")
        self._top = server.gui.add_folder("Hand", order=-1)
        with self._top:
            self._banner = server.gui.add_html("")
            self._hands = server.gui.add_dropdown(
                "Shown", (hand or "–",), hint="The hand shown, of those that run on this computer"
            )
        self._say("Looking for a hand …", WARN)
        self._hands.on_update(lambda _: self._bridge.call(self._chosen))
        self._leave: anyio.CancelScope | None = None

    async def _chosen(self) -> None:
        self.choose(str(self._hands.value))

    def choose(self, name: str) -> None:
        """Show another hand; must be called in the event loop."""
        if self._endpoint is None and name not in ("–", self._wanted):
            self._wanted = name
            if self._leave is not None:
                self._leave.cancel()

    def _say(self, text: str, colour: str) -> None:
        self.message = text
        self._banner.content = (
            f'{_STYLE}<div role="alert" class="rtee-top" style="padding:0.25em 0.75em;'
            f'font-weight:600;{WRAPS};color:{colour}">{escape(text)}</div>'
        )

    async def run(self) -> None:
        """Show hands until cancelled."""
        async with anyio.create_task_group() as group:
            group.start_soon(self._keep_offering)
            group.start_soon(self.approval.run)
            await self._keep_showing()

    async def _keep_offering(self) -> None:
        while True:
            self._offer()
            await anyio.sleep(_POLL_PERIOD)

    async def _keep_showing(self) -> None:
        while True:
            self._offer()
            with self._scope() as leave:
                try:
                    await self._show()
                except NoHand as error:
                    self._say(f"Not connected: {error}", BAD)
                except BaseExceptionGroup as errors:  # from the task group of the session
                    known, others = errors.split(RteeError)
                    if others is not None:
                        raise
                    self._say(f"Not connected: {_first(known)}", BAD)
                except RteeError as error:
                    self._say(f"Cannot show the hand: {error}", BAD)
            if not leave.cancelled_caught:  # another hand was chosen: show it now
                await anyio.sleep(_POLL_PERIOD)

    @contextlib.contextmanager
    def _scope(self) -> Iterator[anyio.CancelScope]:
        with anyio.CancelScope() as scope:
            self._leave = scope
            try:
                yield scope
            finally:
                self._leave = None

    def _offer(self) -> None:
        if self._endpoint is not None:
            return
        # The chosen hand stays in the list while it is away, since it is shown when it returns.
        names = tuple(sorted({*hands_running(), *([self._wanted] if self._wanted else [])}))
        if self._wanted is None and names:
            self._wanted = names[0]
        if names and tuple(self._hands.options) != names:
            self._hands.options = names
            self._hands.value = self._wanted or names[0]

    async def _show(self) -> None:
        if self._wanted is None and self._endpoint is None:
            raise NoHand("no hand is running here; start one with `rtee run HAND`")
        async with connect(self._wanted, endpoint=self._endpoint, client="gui") as remote:
            hand = await model_of(remote)
            self._bridge.role = remote.role
            if self._endpoint is not None:
                self._hands.options = (remote.name,)
            session = Session(self._bridge, remote, hand, self._top)
            self._say(f"{remote.name}: connected", GOOD)
            self.session = session
            try:
                await session.run()
            finally:
                self.session = None
                # Leave properly: the hand treats a client that just vanishes as lost.
                with anyio.CancelScope(shield=True):
                    # First, since the work of clicks would go on with controls that are removed.
                    await self._bridge.close()
                    await session.leave()
                    await remote.leave()
                session.remove()


_LINKS: Final = {Role.OPERATOR: "GUI at", Role.OBSERVER: "to watch and stop only:"}
"""What is printed before an address, by role."""


def _announce(role: Role, link: str) -> None:
    """Print the address for the next browser."""
    print(f"rtee: for another browser: {_LINKS[role]} {link}", flush=True)  # noqa: T201


async def serve(
    hand: str | None,
    *,
    access: Access,
    port: int = 8080,
    endpoint: str | None = None,
    follow: Follow | None = None,
) -> None:
    """Serve the GUI of a hand, or of any that runs, until cancelled; headsets go to ``follow``.

    If the port is in use, takes the next free one, or raises `ConfigError` where a proxy forwards
    to it. Raises `LoopError` if the access checks cannot be added to the installed viser.
    """
    visitors = Visitors(access, follow)
    server = visitors.open_server(port)
    # viser takes the next free port, but the proxy would forward to the program on this one.
    if access.behind_proxy and server.get_port() != port:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        raise ConfigError(
            f"port {port} is not free, and the proxy leads there; give another one with --port, and"
            " to the proxy, too"
            if port
            else "--behind-proxy needs a --port, to which the proxy leads"
        )
    # Python collects fully once a quarter of all objects are new. Without the objects of the
    # imports, it does so every few minutes instead of hours, and has fewer to examine.
    gc.collect()
    gc.freeze()
    give_memory_back()
    for role, link in access.links(server.get_port()).items():
        print(f"rtee: {_LINKS[role]} {link}", flush=True)  # noqa: T201
    access.announce = _announce
    try:
        await App(server, hand, endpoint, visitors).run()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
