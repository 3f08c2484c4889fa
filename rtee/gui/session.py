"""A running hand in the GUI: its panels, and the tasks that update them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncIterator, Sequence
from functools import partial
from html import escape
from typing import Final

import anyio
import anyio.to_thread
import numpy as np
import viser

from rtee.actions.describe import abduction_sentence, deeper_text
from rtee.actions.types import Action, ActionKind, Evidence, Posture, Primitive
from rtee.errors import ConfigError, RequestRejected
from rtee.gui.bridge import Bridge
from rtee.gui.panels.action_editor import MakingPanel
from rtee.gui.panels.actions import ActionsPanel, Card
from rtee.gui.panels.header import HeaderPanel
from rtee.gui.panels.plots import PlotsPanel, TouchPanel
from rtee.gui.panels.recordings import RecordingsPanel
from rtee.gui.panels.table import TablePanel
from rtee.gui.panels.trying import Jobs, TryPanel
from rtee.gui.playback import Playback
from rtee.gui.scene import Contact, HandScene
from rtee.gui.trial_results import key_of, tried_in
from rtee.gui.watch import AGAIN, Watch
from rtee.gui.wording import Angles, effort_bar, put, small
from rtee.hand.model import Hand
from rtee.loop.plan import targets_of
from rtee.messages.state import State
from rtee.planning.result import GraspPlan
from rtee.remote.client import RemoteHand
from rtee.sample import FloatArray
from rtee.touch import TouchState
from rtee.types import Event

_PLOT_PERIOD = 1 / 8
"""Time between two updates of the plots [s]: each takes the browser a few milliseconds."""

_QUIET_PERIOD = 1.0
"""Time between two updates of the plots while nothing moves the hand [s]: saves most traffic."""

_TABLE_PERIOD = 1 / 4
"""Time between two updates of the tables [s]: numbers that change faster cannot be read."""

_PANEL_WIDTH = 330
"""Width of the panel with plots and tables [pixels]: a third of a small laptop's screen."""

_COLOURS = {"info": "blue", "warning": "orange", "error": "red"}
"""Colours of notifications by severity of the event."""

_VIEWS = {
    "Reference": (False, "Show the commanded set-points as a grey ghost"),
    "Degrees": (False, "Show angles in degrees instead of radians: in plots and tables"),
    "Names": (True, "Name the fingers at their tips, with the forces measured there"),
    "Effort": (True, "Show bars at the tips: each finger's effort as a share of its limit"),
    "Contacts": (True, "Mark where the tips of the current action touch"),
    "Pressure": (True, "Show the pressure at the tips, where the hand measures it"),
    "Touch": (True, "Colour the taxels on the hand by what they measure"),
    "Object": (True, "Show the object that a simulated hand grasps"),
    "Contact forces": (True, "Show the contact forces on the links as arrows"),
}
"""Check boxes of the 3D view by label: whether ticked at first, and the hint."""


_FELT: Final = 0.05
"""Smallest force written at a fingertip [N]: below the lightest touch."""

_LONGEST: Final = 24
"""Longest name of a finger at its tip [characters]: longer ones would cover its neighbours'."""

_STRAINED: Final = 0.1
"""Smallest effort shown at a fingertip, as a share of its limit: above that of friction alone."""

_PAST: Final = "this window shows a recording; go back to live first"


class HandSession:
    """A running hand in a window, until the hand or window goes, or the user chooses another."""

    def __init__(
        self,
        bridge: Bridge,
        remote: RemoteHand,
        watch: Watch,
        top: viser.GuiFolderHandle,
        jobs: Jobs,
        *,
        narrow: bool = False,
    ) -> None:
        """Build the panels below the folder ``top``; the watch must have connected before.

        All windows share the ``jobs``. In a narrow window, the plots are folded away.
        """
        assert watch.hand is not None  # noqa: S101
        assert watch.history is not None  # noqa: S101
        hand = watch.hand
        self._bridge, self._remote, self._watch, self._hand = bridge, remote, watch, hand
        gui = bridge.stage.gui
        self._scene = HandScene(bridge.stage, hand)
        self._angles, self._pressed = Angles(), False
        self._plots_due = self._table_due = 0.0
        self._playback: Playback | None = None
        self._known: list[Action] = []
        with top:
            self._header = HeaderPanel(bridge, remote)
        self._tabs = gui.add_tab_group()
        with self._tabs.add_tab("Actions"):
            self._actions = ActionsPanel(bridge, remote, self._show, partial(_remark, hand))
        with self._tabs.add_tab("Teach"):
            self._making = MakingPanel(bridge, remote, hand, self._show)
        with self._tabs.add_tab("Simulate"):
            add_trial = self._actions.add_trial
            self._trying = TryPanel(bridge, remote, hand, jobs, add_trial, self._show_grasp)
        with self._tabs.add_tab("Recordings"):
            self._recordings = RecordingsPanel(bridge, remote, hand, self._look_at)
        with self._tabs.add_tab("View"):
            self._views = {
                label: gui.add_checkbox(label, ticked, hint=hint)
                for label, (ticked, hint) in _VIEWS.items()
            }
            self._forces = gui.add_html("")
        self._panel = gui.add_panel()
        with self._panel.add_tab("Plots", viser.Icon.CHART_LINE):
            self._plots = PlotsPanel(gui, hand, watch.history, self._angles)
        with self._panel.add_tab("Joints", viser.Icon.TABLE):
            self._table = TablePanel(gui, hand, self._angles)
        with self._panel.add_tab("Touch", viser.Icon.HAND_FINGER):
            self._touch_panel = TouchPanel(gui)
        self._panel.dock_left()
        self._panel.set_width(_PANEL_WIDTH)
        if narrow:
            self.fold()

    @property
    def client(self) -> str:
        """This window's name on the network."""
        return self._remote.client

    @property
    def current(self) -> bool:
        """Whether the panels are those of the hand that is watched now, not of one before it."""
        return self._watch.hand is self._hand

    @property
    def recorded(self) -> str:
        """The recording and time that this window shows; empty if it shows the live hand."""
        return "" if self._playback is None else self._recordings.place

    @property
    def cards(self) -> dict[tuple[ActionKind, str], Card]:
        """The cards of the actions by kind and name."""
        return self._actions.cards

    def _show(self, posture: Posture | None, intensity: float, evidence: Evidence | None) -> None:
        self._scene.show_preview(None if posture is None else self._target(posture, intensity))
        contact: list[Contact] = []
        if evidence is not None and evidence.point is not None and evidence.normal is not None:
            contact.append((evidence.point, evidence.normal))
        self._show_contacts(contact)

    def _show_contacts(self, contacts: Sequence[Contact]) -> None:
        self._scene.show_contacts(contacts if self._views["Contacts"].value else ())

    def _show_grasp(self, plan: GraspPlan | None) -> None:
        """Show a planned grasp as a ghost, with its contacts; ``None`` hides both."""
        if plan is None:
            self._show(None, 0.0, None)
            return
        # A grasp composed for the object is not an action of the hand yet, and has no ghost.
        matches = [a for a in self._known if key_of(a) == (plan.action, plan.elements)]
        target = self._target(matches[0].waypoints[-1], plan.intensity) if matches else None
        self._scene.show_preview(target)
        self._show_contacts([(contact.point, contact.normal) for contact in plan.contacts])

    def _target(self, posture: Posture, intensity: float) -> FloatArray:
        # Actuators that an action does not involve stay at their reference.
        state = self._watch.truth.state
        start = self._hand.rest if state is None else state.reference_position
        target = np.array(start)
        for index, position in targets_of(posture, self._hand, intensity).items():
            target[index] = position
        return target

    def _look_at(self, playback: Playback | None) -> None:
        self._playback = playback
        self._plots.follow(playback)
        self._bridge.refused = "" if playback is None else _PAST
        if playback is not None:
            self._making.jog.give_back()

    async def _refresh(self) -> None:
        self._known = await self._actions.refresh()
        self._making.show_actions(self._known)
        self._trying.show_actions(self._known)

    async def run(self) -> None:
        """Update all panels until they are no longer `current`; raises `NoHand` if the hand ends.

        The watch may connect again without a loss of this window's own connection.
        """
        # Subscribed first, so that no change of the actions is missed.
        events = self._remote.events()
        await self._request_trials()  # first, since they order the cards
        await self._refresh()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._follow_events, events)
            while self.current:  # noqa: ASYNC110 - the watch sets it in this thread
                await anyio.sleep(AGAIN)
            tasks.cancel_scope.cancel()

    async def _request_trials(self) -> None:
        # Neither a refusal nor a damaged file must end the session.
        with contextlib.suppress(RequestRejected, ConfigError):
            text = await self._remote.trials()
            self._actions.show_trials(await anyio.to_thread.run_sync(tried_in, text))

    async def _follow_events(self, events: AsyncIterator[Event]) -> None:
        async for event in events:
            await self._on_event(event)

    async def _on_event(self, event: Event) -> None:
        if event.kind == "actions_changed":
            await self._refresh()
            await self._request_trials()
        # These two occur with many goals, and the displayed state already shows them.
        elif event.kind not in ("limited", "at_rest"):
            title = event.kind.replace("_", " ")
            self._bridge.notify(title, event.text, _COLOURS.get(event.severity, "blue"))

    def draw(self, now: float) -> None:
        """Draw changes; called about 30 times per second."""
        # Send all changes in one message, so that no window shows half a state.
        with self._bridge.stage.atomic():
            self._draw(now)

    def _draw(self, now: float) -> None:
        watch, playback = self._watch, self._playback
        self._angles.degrees = self._views["Degrees"].value
        self._recordings.advance()
        state = watch.truth.state if playback is None else playback.state()
        if state is None or (playback is None and (watch.truth.stale or not self.current)):
            state = None  # the last picture stays, marked as old
        if state is not None:
            self._draw_hand(state)
        if now >= self._plots_due and state is not None:
            quiet = playback is None and not watch.truth.busy
            self._plots_due = now + (_QUIET_PERIOD if quiet else _PLOT_PERIOD)
            self._plots.draw()
            source = watch.touched.windows if playback is None else playback.touch_windows
            self._touch_panel.draw(source(self._touch_panel.length))
        if now >= self._table_due:
            self._table_due = now + _TABLE_PERIOD
            self._header.show(watch.truth, jogs=self._making.jog.holding)
            for panel in (self._actions, self._making, self._trying):
                panel.fade()
            status = watch.truth.status
            if status is not None:
                self._table.show_status(status)
                self._making.show_status(status)
                self._recordings.show_status(status)
            if state is not None:
                self._show_numbers(state)

    def _show_numbers(self, state: State) -> None:
        self._table.show_state(state)
        self._scene.show_fingers(self._finger_labels(state))
        self._touch_panel.show(self._touch_now())
        contacts = self._scene.seen.summary(tuple(self._hand.urdf.links))
        put(self._forces, small(escape(contacts)))
        if self._playback is None:
            self._making.show_state(state)

    def _draw_hand(self, state: State) -> None:
        view = {label: box.value for label, box in self._views.items()}
        self._scene.show(state.joint_position)
        self._scene.show_reference(state.reference_position if view["Reference"] else None)
        self._scene.taxels.show(self._touch_now() if view["Touch"] else ())
        pressure = self._pressures(state) if view["Pressure"] else {}
        if pressure or self._pressed:  # once more after the last contact, to hide the spheres
            self._pressed = bool(pressure)
            self._scene.show_pressure(pressure)
        playback = self._playback
        held = self._watch.described if playback is None else playback.object_description
        self._scene.seen.describe(held if view["Object"] else None)
        self._scene.seen.show(state.channels, forces=view["Contact forces"])

    def _finger_labels(self, state: State) -> dict[str, str]:
        """Return each finger's name with its measured force, and its effort as a bar."""
        names, bars = self._views["Names"].value, self._views["Effort"].value
        fingers, efforts = self._hand.finger_names, self._efforts(state) if bars else {}
        forces = dict.fromkeys(fingers, 0.0)
        for name, values in state.channels.items():
            if name.endswith("/contact_force") and len(values) == len(fingers):
                forces = dict(zip(fingers, values.tolist(), strict=True))
        said = {}
        for finger in fingers:
            force, share = forces[finger], efforts.get(finger, 0.0)
            name = finger if len(finger) <= _LONGEST else f"{finger[: _LONGEST - 1]}…"
            words = [name] * names + [f"{force:.1f} N"] * (names and force >= _FELT)
            said[finger] = " ".join(words + [effort_bar(share)] * (share >= _STRAINED))
        return said

    def _efforts(self, state: State) -> dict[str, float]:
        """Return the largest effort of each finger's actuators, as a share of their limits."""
        share: dict[str, float] = {}
        for i, actuator in enumerate(self._hand.actuators):
            if math.isfinite(actuator.effort) and actuator.effort > 0.0:
                strength = abs(float(state.effort[i])) / actuator.effort
                for finger in actuator.fingers:
                    if math.isfinite(strength):
                        share[finger] = max(share.get(finger, 0.0), strength)
        return share

    def _touch_now(self) -> Sequence[TouchState]:
        """Return the last readings of the touch sensors, live or at the time of a recording."""
        if self._playback is None:
            return self._watch.touched.newest()
        return self._playback.touch()

    def _pressures(self, state: State) -> dict[str, float]:
        """Return the pressure of each finger without taxels, as a share of the largest."""
        fingers = self._hand.finger_names
        for name, values in state.channels.items():
            if name.endswith(("/pressure", "/contact_force")) and len(values) % len(fingers) == 0:
                by_finger = np.nan_to_num(values).reshape(len(fingers), -1).max(axis=1)
                most = max(float(by_finger.max()), 1.0)  # weak pressures stay pale
                shares = dict(zip(fingers, (by_finger / most).tolist(), strict=True))
                # Taxels show the same pressures in more detail.
                drawn = self._scene.taxels.fingers
                return {f: share for f, share in shares.items() if f not in drawn}
        return {}

    def fold(self) -> None:
        """Fold the plots away."""
        self._panel.minimize()

    async def live(self) -> None:
        """Show the running hand again, instead of a recording."""
        await self._recordings.live()

    async def scrub(self, time: float) -> None:
        """Show another time of the recording [s]."""
        self._recordings.scrub(time)

    async def stop(self) -> dict[str, bool]:
        """Stop the hand; return whether each device has confirmed."""
        return await self._remote.stop()

    async def leave(self) -> None:
        """End the trials of this window, and release the lease if it is held for jogging."""
        self._trying.cancel()
        await self._making.jog.leave()

    def remove(self) -> None:
        """Remove everything of the hand from the browser."""
        self._trying.remove()
        self._scene.remove()
        self._header.remove()
        self._actions.remove()
        self._tabs.remove()
        self._panel.remove()


def _remark(hand: Hand, action: Action) -> str:
    """Return the remark to show before an action starts, or ``""``."""
    if isinstance(action, Primitive) and (deeper := deeper_text(action)):
        return deeper
    return abduction_sentence(hand, action)
