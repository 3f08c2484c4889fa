"""A running hand in the GUI: its panels, and the tasks that update them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from functools import partial
from html import escape

import anyio
import anyio.to_thread
import numpy as np
import viser

from rtee import monotonic
from rtee.actions.abduction import abduction_sentence
from rtee.actions.describe import deeper_text
from rtee.actions.types import Action, ActionKind, Evidence, Posture, Primitive
from rtee.errors import ConfigError, RequestRejected, RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.history import LONGEST
from rtee.gui.panels.action_editor import MakingPanel
from rtee.gui.panels.actions import ActionsPanel
from rtee.gui.panels.cards import Card
from rtee.gui.panels.header import Header
from rtee.gui.panels.plots import PlotsPanel
from rtee.gui.panels.recordings import RecordingsPanel
from rtee.gui.panels.table import TablePanel
from rtee.gui.panels.touch import TouchPanel
from rtee.gui.panels.trying import TryPanel
from rtee.gui.playback import Playback
from rtee.gui.scene import Contact, HandScene
from rtee.gui.trial_results import key_of, tried_in
from rtee.gui.wording import small
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.objects.description import OBJECT_POSE, ObjectDescription
from rtee.planning.result import GraspPlan
from rtee.remote.client import RemoteHand
from rtee.sample import FloatArray
from rtee.touch import TouchState
from rtee.types import Event, from_rest

_STATE_RATE = 100.0
"""States received per second [Hz]: enough for smooth lines in the plots."""

_SCENE_PERIOD = 1 / 30
"""Time between two updates of the 3D view [s]: 30 pictures per second look fluent."""

_UNWATCHED_PERIOD = 0.25
"""Time between two updates while no window is open [s]: they only fill the plots' history."""

_UNWATCHED_STEP = 5
"""While no window is open, every fifth state goes into the history."""

_PLOT_PERIOD = 1 / 8
"""Time between two updates of the plots [s]: each costs the browser some milliseconds."""

_TABLE_PERIOD = 1 / 4
"""Time between two updates of the tables [s]: numbers that change faster cannot be read."""

_STATUS_PERIOD = 0.5
"""Time between two requests for the status [s]."""

UNATTENDED = 3.0
"""Time without an operator's window after which the hand is given back [s]: a window that is
reloaded is there again sooner."""

_WINDOWS_PERIOD = 0.25
"""Time between two looks for windows [s]: short beside `UNATTENDED`."""

_PANEL_WIDTH = 330
"""Width of the panel with plots and tables [pixels]: a third of a small laptop's screen."""

_COLOURS = {"info": "blue", "warning": "orange", "error": "red"}
"""Colours of notifications by severity of the event."""

_VIEWS = {
    "Reference": (False, "Show the set-points sent as a grey ghost"),
    "Effort": (True, "Darken fingers by the effort they exert, as a share of limits"),
    "Contacts": (True, "Mark where the tips of the current action touch"),
    "Pressure": (True, "Show the pressure at the tips, where the hand measures it"),
    "Touch": (True, "Colour the taxels on the hand by what they measure"),
    "Object": (True, "Show the object that a simulated hand grasps"),
    "Contact forces": (True, "Show by arrows how hard links press on things"),
}
"""Check boxes of the 3D view: by label, whether ticked at first, and the hint."""


class Session:
    """A running hand in the GUI, until it ends or another hand is chosen."""

    def __init__(
        self, bridge: Bridge, remote: RemoteHand, hand: Hand, top: viser.GuiFolderHandle
    ) -> None:
        """Build the panels; the folder ``top`` stays visible when the panel is scrolled."""
        self._bridge = bridge
        self._remote = remote
        self._hand = hand
        server = bridge.server
        gui = server.gui
        self._scene = HandScene(server, hand)
        self._state: State | None = None
        self._pressed = False
        self._plots_due = self._table_due = 0.0
        self._playback: Playback | None = None
        self._object: ObjectDescription | None = None
        self._known: list[Action] = []
        self._touched: dict[str, TouchState] = {}
        with top:
            self._header = Header(bridge, remote)
        self._tabs = gui.add_tab_group()
        with self._tabs.add_tab("Actions"):
            self._actions = ActionsPanel(bridge, remote, self._show, partial(_remark, hand))
        with self._tabs.add_tab("Make"):
            self._making = MakingPanel(bridge, remote, hand)
        with self._tabs.add_tab("Try"):
            self._trying = TryPanel(bridge, remote, hand, self._actions.add_trial, self._show_grasp)
        with self._tabs.add_tab("Log"):
            self._recordings = RecordingsPanel(bridge, remote, hand, self._look_at)
        with self._tabs.add_tab("View"):
            self._views = {
                label: gui.add_checkbox(label, ticked, hint=hint)
                for label, (ticked, hint) in _VIEWS.items()
            }
            self._forces = gui.add_html("")
        self._panel = gui.add_panel()
        with self._panel.add_tab("Plots", viser.Icon.CHART_LINE):
            self._plots = PlotsPanel(gui, hand)
        with self._panel.add_tab("Joints", viser.Icon.TABLE):
            self._table = TablePanel(gui, hand)
        with self._panel.add_tab("Touch", viser.Icon.HAND_FINGER):
            self._touch_panel = TouchPanel(gui)
        self._panel.dock_left()
        self._panel.set_width(_PANEL_WIDTH)

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
        # A grasp composed for the object is no action of the hand yet, and has no ghost.
        matches = [a for a in self._known if key_of(a) == (plan.action, plan.elements)]
        target = self._target(matches[0].waypoints[-1], plan.intensity) if matches else None
        self._scene.show_preview(target)
        self._show_contacts([(contact.point, contact.normal) for contact in plan.contacts])

    def _target(self, posture: Posture, intensity: float) -> FloatArray:
        # Actuators that an action does not involve stay at their reference.
        start = self._hand.rest if self._state is None else self._state.reference_position
        target = np.array(start)
        for name in posture.involved:
            index = self._hand.actuator_index(name)
            target[index] = from_rest(self._hand.rest[index], posture.position[name], intensity)
        return target

    def _look_at(self, playback: Playback | None) -> None:
        self._playback = playback
        self._plots.follow(playback)

    async def _refresh(self) -> None:
        self._known = await self._actions.refresh()
        self._making.show_actions(self._known)
        self._trying.show_actions(self._known)

    async def run(self) -> None:
        """Update all panels; ends with `NoHand` when the hand has ended."""
        # Subscribed first, so that no change of the actions is missed.
        events = self._remote.events()
        await self._refresh()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._follow_events, events)
            tasks.start_soon(self._follow_status)
            tasks.start_soon(self._follow_states)
            tasks.start_soon(self._follow_object)
            tasks.start_soon(self._follow_touch)
            tasks.start_soon(self._follow_windows)
            await self._request_trials()

    async def _follow_object(self) -> None:
        """Request the simulated object once its pose is among the channels of the states."""
        with contextlib.suppress(RteeError):  # a hand of an earlier version has no such request
            while self._object is None:
                await anyio.sleep(_STATUS_PERIOD)
                channels = () if self._state is None else self._state.channels
                if any(name.endswith(f"/{OBJECT_POSE}") for name in channels):
                    self._object = await self._remote.object_description()

    async def _follow_touch(self) -> None:
        with contextlib.suppress(RequestRejected):  # refused by a hand of an earlier version
            async for state in self._remote.touch_states():
                self._touched[state.device] = state
                self._touch_panel.add(state)

    async def _request_trials(self) -> None:
        # Refused by a hand of an earlier version; a damaged file must not end the session either.
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
        # These two occur with many goals, and the state shows them.
        elif event.kind not in ("limited", "at_rest"):
            title = event.kind.replace("_", " ")
            self._bridge.notify(title, event.text, _COLOURS.get(event.severity, "blue"))

    async def _follow_status(self) -> None:
        while True:
            status = await self._remote.status()
            self._header.show(status, jogs=self._making.jog.holding)
            self._table.show_status(status)
            self._making.show_status(status)
            self._recordings.show_status(status)
            await anyio.sleep(_STATUS_PERIOD)

    async def _follow_windows(self) -> None:
        """Give the hand back when nobody has been there for a while who could."""
        attended = monotonic.now()
        while True:
            await anyio.sleep(_WINDOWS_PERIOD)
            if self._bridge.attended:
                attended = monotonic.now()
            elif monotonic.now() - attended > UNATTENDED and self._making.jog.holding:
                self._making.jog.give_back()

    async def _follow_states(self) -> None:
        """Draw the states received meanwhile, 30 times per second while a window is open."""
        # As many states as the plots show are kept, even if drawing is delayed for that long.
        most = round(_STATE_RATE * LONGEST)
        async with self._remote.collected_states(_STATE_RATE, most) as states:
            while True:
                watched = self._bridge.watched
                await anyio.sleep(_SCENE_PERIOD if watched else _UNWATCHED_PERIOD)
                for state in states.drain(1 if watched else _UNWATCHED_STEP):
                    self._receive(state)
                if watched:
                    # In one message, which costs less and leaves no window with half a state.
                    with self._bridge.server.atomic():
                        self._draw(monotonic.now())

    def _receive(self, state: State) -> None:
        names = self._hand.joint_names
        if state.joint_names != names:  # the hand sends them in another order than the model here
            by_name = state.joints
            position = np.array([by_name.get(name, math.nan) for name in names])
            state = replace(state, joint_names=names, joint_position=position)
        self._state = state
        speeds = self._hand.transmission.velocities(state.position, state.velocity)
        self._plots.history.add(state, speeds)

    def _draw(self, now: float) -> None:
        state, playback = self._state, self._playback
        self._recordings.advance()
        if playback is not None:
            state = playback.state()
        if state is None:
            return
        self._draw_hand(state)
        if now >= self._plots_due:
            self._plots_due = now + _PLOT_PERIOD
            self._plots.draw()
            panel = self._touch_panel
            panel.draw(panel.live() if playback is None else playback.touch_windows(panel.length))
        if now >= self._table_due:
            self._table_due = now + _TABLE_PERIOD
            self._table.show_state(state)
            self._touch_panel.show(self._touch_now())
            contacts = self._scene.seen.summary(tuple(self._hand.urdf.links))
            self._forces.content = small(escape(contacts))
            if playback is None:
                self._making.show_state(state)

    def _draw_hand(self, state: State) -> None:
        view = {label: box.value for label, box in self._views.items()}
        self._scene.show(state.joint_position)
        self._scene.show_reference(state.reference_position if view["Reference"] else None)
        self._scene.show_effort(self._efforts(state) if view["Effort"] else {})
        self._scene.taxels.show(self._touch_now() if view["Touch"] else ())
        pressure = self._pressures(state) if view["Pressure"] else {}
        if pressure or self._pressed:  # once more after the last contact, to hide the spheres
            self._pressed = bool(pressure)
            self._scene.show_pressure(pressure)
            self._scene.place_pressures(state.position)
        playback = self._playback
        held = self._object if playback is None else playback.object_description
        self._scene.seen.describe(held if view["Object"] else None)
        self._scene.seen.show(state.channels, forces=view["Contact forces"])

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
        return list(self._touched.values()) if self._playback is None else self._playback.touch()

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

    async def leave(self) -> None:
        """Release the lease if it is held for jogging."""
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
    """Return what people should know of an action before they start it, or ``""``."""
    if isinstance(action, Primitive) and (deeper := deeper_text(action)):
        return deeper
    return abduction_sentence(hand, action)
