"""Panel of recordings: start, finish and mark a recording; open one and scrub through it."""

from __future__ import annotations

import os
from collections.abc import Callable
from html import escape
from pathlib import Path

import anyio.to_thread
import viser

from rtee import monotonic
from rtee.errors import LogError, RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.playback import Playback, timeline
from rtee.gui.wording import NOTHING, WRAPS, offer
from rtee.hand.config_schema import LogSection
from rtee.hand.load import load_configured
from rtee.hand.model import Hand
from rtee.log import read
from rtee.log.rotation import being_written, recordings
from rtee.messages.requests import Role
from rtee.remote.client import RemoteHand
from rtee.remote.monitoring import HandStatus

Opened = Callable[[Playback | None], None]
"""Receives the recording to show, or ``None`` for the live hand."""

_SPEEDS = {"⅒ ×": 0.1, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "10 ×": 10.0}
"""Playback speeds by label, as multiples of real time."""

_REDRAW = 0.1
"""Time between two updates of the slider while a recording plays [s]: smooth enough to follow."""


def configured_folder(hand: str) -> Path:
    """Return the configured folder of a hand's recordings, or the default folder."""
    try:
        return load_configured(hand)[1].log.folder
    except RteeError:
        return LogSection().folder


def files_in(folder: Path, hand: str) -> dict[str, Path]:
    """Return the recordings of a hand in a folder by label, newest first.

    Those that are still being written come after the complete ones.
    """
    # Before Python 3.14, `Path.is_dir` raises an error below another user's private folder.
    if not os.path.isdir(folder):
        return {}
    files: dict[bool, dict[str, Path]] = {False: {}, True: {}}
    for file in reversed(recordings(folder, hand)):
        label = f"{file.path.stem} · {file.size / 1e6:.1f} MB"
        files[being_written(file.path)][label] = file.path
    return files[False] | {f"{label} · being written": path for label, path in files[True].items()}


class RecordingsPanel:
    """The recording being written, and the one being viewed."""

    def __init__(self, bridge: Bridge, remote: RemoteHand, hand: Hand, opened: Opened) -> None:
        """Add the panel to the current container; ``opened`` receives the recording to show."""
        gui = bridge.stage.gui
        self._bridge, self._remote, self._hand, self._opened = bridge, remote, hand, opened
        self._playback: Playback | None = None
        self._files: dict[str, Path] = {}
        self._shown = ""
        self._played = self._drawn = 0.0
        self._status = gui.add_html("")
        record = gui.add_button_group(
            "Record", ("Start", "Finish"), hint="Start a new recording, or finish the current one"
        )
        self._text = gui.add_text("Mark", "", hint="Text of a mark in the recording, one line")
        mark = gui.add_button("Set mark", icon=viser.Icon.BOOKMARK, hint="Mark this moment")
        with gui.add_folder("Recordings"):
            self._folder = gui.add_text(
                "Folder",
                str(configured_folder(hand.name)),
                hint="Folder of recordings on the computer of this GUI",
            )
            self._file = gui.add_dropdown("File", (NOTHING,), hint="Newest first")
            show = gui.add_button_group(
                "",
                ("Refresh", "Play", "Back to live"),
                hint="Play: in this window only, which cannot move the hand until Back to live",
            )
            self._player = gui.add_folder(None, visible=False)
        with self._player:
            self._line = gui.add_html("")
            self._time = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0, hint="Time shown [s]")
            self._play = gui.add_checkbox("Play", False, hint="Play or pause")
            self._speed = gui.add_dropdown(
                "Speed", tuple(_SPEEDS), initial_value="1 ×", hint="1 × is real time"
            )
            self._span = gui.add_dropdown(
                "Go to", (NOTHING,), hint="Start of an action, or a mark, in the recording"
            )
        self._places: dict[str, float] = {}
        bridge.need(Role.MAINTAINER, record, self._text, mark)
        record.on_click(lambda event: bridge.call(lambda: self._record(str(event.target.value))))
        mark.on_click(lambda _: bridge.call(self._mark))
        self._folder.on_update(lambda _: self._refresh())
        show.on_click(lambda event: self._clicked(str(event.target.value)))
        self._time.on_update(bridge.entered(self._scrubbed))
        self._span.on_update(bridge.entered(self._go))
        self._refresh()

    # --- the recording being written

    async def _record(self, button: str) -> None:
        await self._remote.record("start" if button == "Start" else "stop")
        words = "a recording begins" if button == "Start" else "the recording ends"
        self._bridge.notify("Recording", words, "green")

    async def _mark(self) -> None:
        text = str(self._text.value).strip()
        await self._remote.record("mark", text)
        self._bridge.notify("Marked", text, "green")

    def show_status(self, status: HandStatus) -> None:
        """Show the name of the file that is being written."""
        name = escape(Path(status.recording).name)
        text = f"● recording to <b>{name}</b>" if status.recording else "○ off"
        html = f'<div style="font-size:0.85em;padding:0.25em 0.75em;{WRAPS}">{text}</div>'
        if self._status.content == html:
            return
        self._status.content = html
        # Offer the newest recordings, unless the hand's folder is on another computer.
        folder = Path(status.recording).parent if status.recording else None
        if folder is not None and os.path.isdir(folder) and str(folder) != self._folder.value:
            self._folder.value = str(folder)
        self._refresh()

    # --- the recording being viewed

    @property
    def place(self) -> str:
        """The displayed recording, and the time in it."""
        playback = self._playback
        if playback is None:
            return ""
        return f"{self._shown} · {playback.time:.1f} of {playback.duration:.1f} s"

    async def live(self) -> None:
        """Show the running hand again."""
        await self._live()

    def _refresh(self) -> None:
        # `Path.expanduser` would raise an error while the user is still typing after "~".
        folder = Path(os.path.expanduser(str(self._folder.value)))
        self._files = files_in(folder, self._hand.name)
        newest = self._file.value == self._file.options[0]
        offer(self._file, self._files)
        if newest:  # show the newest unless the user has chosen another
            self._file.value = self._file.options[0]

    def _clicked(self, button: str) -> None:
        match button:
            case "Refresh":
                self._refresh()
            case "Play":
                self._bridge.call(self._open, always=True)
            case _:
                self._bridge.call(self._live, always=True)

    async def _open(self) -> None:
        path = self._files.get(str(self._file.value))
        if path is None:
            raise LogError(f"there is no recording of {self._hand.name} in this folder")
        # In a thread, since reading a long recording takes seconds.
        playback = await anyio.to_thread.run_sync(lambda: Playback(read(path), self._hand))
        self._playback = None
        self._time.value = 0.0
        self._time.max = playback.duration
        self._time.step = max(playback.duration / 1e5, 0.001)  # far finer than a pixel
        self._places = {
            **{f"{s.start:.1f} s {s.name}: {s.outcome}": s.start for s in playback.recording.spans},
            **{f"{at:.1f} s mark: {text}": at for at, text in playback.marks},
        }
        self._span.options = tuple(sorted(self._places, key=self._places.__getitem__)) or (NOTHING,)
        self._span.value = self._span.options[0]
        self._playback, self._shown = playback, path.name
        self._player.visible = self._play.value = True
        self._line.content = timeline(playback)
        self._opened(playback)

    async def _live(self) -> None:
        self._playback = None
        self._play.value = False
        self._player.visible = False
        self._opened(None)

    def _go(self, span: str) -> None:
        if span in self._places:
            self.scrub(self._places[span])

    def scrub(self, time: float) -> None:
        """Show another time of the recording [s]."""
        if self._playback is not None:
            self._time.value = min(time, self._playback.duration)
            self._scrubbed(self._time.value)

    def _scrubbed(self, time: float) -> None:
        playback = self._playback
        if playback is not None:
            playback.time = time
            self._line.content = timeline(playback)

    def advance(self) -> None:
        """Advance the time while the recording plays; called about 30 times per second."""
        now = monotonic.now()
        passed, self._played = now - self._played, now
        playback = self._playback
        if playback is None or not self._play.value:
            return
        # At most 0.5 s, so that playback does not jump after a pause of the event loop.
        playback.time += min(passed, 0.5) * _SPEEDS[str(self._speed.value)]
        if playback.time >= playback.duration:
            playback.time = playback.duration
            self._play.value = False
        if now - self._drawn >= _REDRAW or not self._play.value:
            self._drawn = now
            self._time.value = playback.time
            self._line.content = timeline(playback)
