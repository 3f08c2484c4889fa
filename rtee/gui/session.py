"""One hand in the GUI: its panels, and the streams that update them."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from functools import partial
from html import escape

import anyio
import anyio.to_thread
import numpy as np
import viser

from rtee.actions.sideways import sideways_words
from rtee.actions.types import Action, ActionKind, Evidence, Posture
from rtee.errors import ConfigError, RequestRejected, RteeError
from rtee.gui.bridge import Bridge
from rtee.gui.history import LONGEST
from rtee.gui.panels.action_editor import MakingPanel
from rtee.gui.panels.actions import ActionsPanel
from rtee.gui.panels.cards import Card
from rtee.gui.panels.execution import last_posture
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
from rtee.object_description import OBJECT_POSE, ObjectDescription
from rtee.planning.result import GraspPlan
from rtee.remote.client import RemoteHand
from rtee.sample import FloatArray
from rtee.touch import TouchState
from rtee.types import Event, from_rest

_STATE_RATE = 100.0
"""States received per second [Hz]: enough for smooth lines in the plots."""

_SCENE_PERIOD = 1 / 30
"""Time between two updates of the 3D view [s]: as fluent as a film."""

_UNWATCHED_PERIOD = 0.25
"""The same while no window is open [s]: only the history of the plots is filled."""

_UNWATCHED_STEP = 5
"""Of this many states one goes into the history while no window is open."""

_PLOT_PERIOD = 1 / 8
"""Time between two updates of the plots [s]: each takes the browser some milliseconds."""

_TABLE_PERIOD = 1 / 4
"""Time between two updates of the tables [s]: numbers that change faster cannot be read."""

_STATUS_PERIOD = 0.5
"""Time between two requests for the status [s]."""

_PANEL_WIDTH = 330
"""Width of the panel with plots and tables [pixels]: a third of a small laptop's screen."""

_COLOURS = {"info": "blue", "warning": "orange", "error": "red"}


class Session:
    """Shows one running hand until it goes."""

    def __init__(
        self, bridge: Bridge, remote: RemoteHand, hand: Hand, top: viser.GuiFolderHandle
    ) -> None:
        """Build the panels.

        Args:
            bridge: Carries clicks into the event loop.
            remote: The running hand.
            hand: Its model.
            top: The folder that always stays in sight.
        """
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
        self._thing: ObjectDescription | None = None
        self._known: list[Action] = []
        self._touched: dict[str, TouchState] = {}
        with top:
            self._header = Header(bridge, remote)
        self._tabs = gui.add_tab_group()
        with self._tabs.add_tab("Actions"):
            self._actions = ActionsPanel(bridge, remote, self._show, partial(sideways_words, hand))
        with self._tabs.add_tab("Make"):
            self._making = MakingPanel(bridge, remote, hand, self._refresh)
        with self._tabs.add_tab("Try"):
            self._trying = TryPanel(bridge, remote, hand, self._actions.add_trial, self._show_grasp)
        with self._tabs.add_tab("Log"):
            self._recordings = RecordingsPanel(bridge, remote, hand, self._look_at)
        with self._tabs.add_tab("View"):
            self._ghost = gui.add_checkbox(
                "Reference", False, hint="Show the set-points sent as a grey ghost"
            )
            self._strain = gui.add_checkbox(
                "Effort", True, hint="Darken fingers by the effort they exert, as a share of limits"
            )
            self._touch = gui.add_checkbox(
                "Contacts", True, hint="Mark where the tips of the current action touch"
            )
            self._press = gui.add_checkbox(
                "Pressure", True, hint="Show the pressure at the tips, where the hand measures it"
            )
            self._taxels = gui.add_checkbox(
                "Touch", True, hint="Colour the taxels on the hand by what they measure"
            )
            self._object = gui.add_checkbox(
                "Object", True, hint="Show the object that a simulated hand grasps"
            )
            self._forces = gui.add_checkbox(
                "Contact forces", True, hint="Show by arrows how hard links press on things"
            )
            self._felt = gui.add_html("")
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
        if posture is None:
            self._scene.show_preview(None)
        else:
            self._scene.show_preview(self._target(posture, intensity))
        contact: list[Contact] = []
        if evidence is not None and evidence.point is not None and evidence.normal is not None:
            contact.append((evidence.point, evidence.normal))
        self._scene.show_contacts(contact if self._touch.value else ())

    def _show_grasp(self, plan: GraspPlan | None) -> None:
        """Show a planned grasp as a ghost, with its contacts."""
        if plan is None:
            self._show(None, 0.0, None)
            return
        found = [a for a in self._known if key_of(a) == (plan.action, plan.elements)]
        self._scene.show_preview(
            self._target(last_posture(found[0]), plan.intensity) if found else None
        )
        contacts = [(contact.point, contact.normal) for contact in plan.contacts]
        self._scene.show_contacts(contacts if self._touch.value else ())

    def _target(self, posture: Posture, intensity: float) -> FloatArray:
        # What an action leaves out stays at its reference, so that the ghost shows it there.
        start = self._hand.rest if self._state is None else self._state.reference_position
        target = np.array(start)
        for name in posture.involved:
            index = self._hand.actuator_index(name)
            target[index] = from_rest(self._hand.rest[index], posture.position[name], intensity)
        return target

    def _look_at(self, playback: Playback | None) -> None:
        self._playback = playback
        self._plots.follow(playback)

    async def _refresh(self) -> list[Action]:
        actions = await self._actions.refresh()
        self._known = actions
        self._making.show_actions(actions)
        self._trying.show_actions(actions)
        return actions

    async def run(self) -> None:
        """Update all panels until the hand goes.

        Raises:
            NoHand: when the hand goes.
        """
        events = (
            self._remote.events()
        )  # subscribed first, so that no change of the actions is missed
        await self._refresh()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._follow_events, events)
            tasks.start_soon(self._follow_status)
            tasks.start_soon(self._follow_states)
            tasks.start_soon(self._follow_object)
            tasks.start_soon(self._follow_touch)
            await self._ask_trials()

    async def _follow_object(self) -> None:
        """Ask what is grasped once there is something: a simulation appears after its hand."""
        with contextlib.suppress(RteeError):  # an older hand cannot tell
            while self._thing is None:
                await anyio.sleep(_STATUS_PERIOD)
                if self._state is not None and self._has_object(self._state):
                    self._thing = await self._remote.object_description()

    async def _follow_touch(self) -> None:
        with contextlib.suppress(RequestRejected):  # an older hand cannot tell
            async for state in self._remote.touch_states():
                self._touched[state.device] = state
                self._touch_panel.add(state)

    @staticmethod
    def _has_object(state: State) -> bool:
        return any(name.endswith(f"/{OBJECT_POSE}") for name in state.channels)

    async def _ask_trials(self) -> None:
        # An older hand cannot tell, and a damaged file of trials must not end the session.
        with contextlib.suppress(RequestRejected, ConfigError):
            text = await self._remote.trials()
            self._actions.show_trials(await anyio.to_thread.run_sync(tried_in, text))

    async def _follow_events(self, events: AsyncIterator[Event]) -> None:
        async for event in events:
            await self._on_event(event)

    async def _on_event(self, event: Event) -> None:
        if event.kind == "actions_changed":
            await self._refresh()
            await self._ask_trials()
        elif event.kind not in ("limited", "at_rest"):
            title = event.kind.replace("_", " ")
            self._bridge.notify(title, event.text, _COLOURS.get(event.severity, "blue"))

    async def _follow_status(self) -> None:
        while True:
            status = await self._remote.status()
            self._header.show(status)
            self._table.show_status(status)
            self._making.show_status(status)
            self._recordings.show_status(status)
            await anyio.sleep(_STATUS_PERIOD)

    async def _follow_states(self) -> None:
        """Draw the states received meanwhile, 30 times a second while a window is open."""
        # As many as the plots show, should drawing be held up for that long.
        most = round(_STATE_RATE * LONGEST)
        async with self._remote.collected_states(_STATE_RATE, most) as states:
            while True:
                watched = self._bridge.watched
                await anyio.sleep(_SCENE_PERIOD if watched else _UNWATCHED_PERIOD)
                for state in states.drain(1 if watched else _UNWATCHED_STEP):
                    self._receive(state)
                if watched:
                    # In one go, which costs less, and no window shows half of a state.
                    with self._bridge.server.atomic():
                        self._draw(time.monotonic())

    def _receive(self, state: State) -> None:
        if state.joint_names != self._hand.joint_names:  # the model here has another order
            state = self._in_order(state)
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
            self._felt.content = small(escape(self._scene.seen.said(tuple(self._hand.urdf.links))))
            if playback is None:
                self._making.show_state(state)

    def _draw_hand(self, state: State) -> None:
        self._scene.show(state.joint_position)
        self._scene.show_reference(state.reference_position if self._ghost.value else None)
        self._scene.show_effort(self._efforts(state) if self._strain.value else {})
        self._scene.taxels.show(self._touch_now() if self._taxels.value else ())
        pressure = self._pressures(state) if self._press.value else {}
        if pressure or self._pressed:  # once more after the last contact, to hide the spheres
            self._pressed = bool(pressure)
            self._scene.show_pressure(pressure)
            self._scene.place_pressures(state.position)
        thing = self._thing if self._playback is None else self._playback.object_description
        self._scene.seen.describe(thing if self._object.value else None)
        self._scene.seen.show(state.channels, forces=self._forces.value)

    def _in_order(self, state: State) -> State:
        by_name, names = state.joints, self._hand.joint_names
        position = np.array([by_name.get(name, math.nan) for name in names])
        return replace(state, joint_names=names, joint_position=position)

    def _efforts(self, state: State) -> dict[str, float]:
        share: dict[str, float] = {}
        for i, actuator in enumerate(self._hand.actuators):
            if math.isfinite(actuator.effort) and actuator.effort > 0.0:
                strength = abs(float(state.effort[i])) / actuator.effort
                for finger in actuator.fingers:
                    if math.isfinite(strength):
                        share[finger] = max(share.get(finger, 0.0), strength)
        return share

    def _touch_now(self) -> Sequence[TouchState]:
        """Return what touch sensors measure, or had measured at the time of a recording."""
        return list(self._touched.values()) if self._playback is None else self._playback.touch()

    def _pressures(self, state: State) -> dict[str, float]:
        fingers = self._hand.finger_names
        for name, values in state.channels.items():
            if name.endswith(("/pressure", "/contact_force")) and len(values) % len(fingers) == 0:
                by_finger = np.nan_to_num(values).reshape(len(fingers), -1).max(axis=1)
                most = max(float(by_finger.max()), 1.0)  # weak pressures stay pale
                shares = dict(zip(fingers, (by_finger / most).tolist(), strict=True))
                # Taxels show the same in more detail.
                drawn = self._scene.taxels.fingers
                return {f: share for f, share in shares.items() if f not in drawn}
        return {}

    async def leave(self) -> None:
        """Give the hand back if it is held for jogging; the hand goes on, or has gone."""
        await self._making.leave()

    def remove(self) -> None:
        """Remove everything of the hand from the browser."""
        self._trying.remove()
        self._scene.remove()
        self._header.remove()
        self._actions.remove()
        self._tabs.remove()
        self._panel.remove()
