"""List and change the actions of a running hand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Final

from rtee.actions.build import StepPlan
from rtee.actions.library import listed
from rtee.actions.types import (
    Action,
    ActionReference,
    Composed,
    CustomAction,
    Generic,
    Posture,
    PrimitiveGroup,
    Step,
    Timed,
)
from rtee.errors import RequestRejected
from rtee.messages.convert import table_fields
from rtee.objects.table import Table
from rtee.planning.question import Question, question_about
from rtee.planning.result import Ranking, from_document
from rtee.remote.actions import action_fields, action_of, group_of
from rtee.remote.hand_info import info_of
from rtee.remote.link import Link
from rtee.remote.openings import GripLimits, OpeningRange, limits_of, opening_of

_NOWHERE = Posture({}, ())
"""Posture of an action that is sent: the hand computes it from the parts."""

PLANNED_WITHIN: Final = 90.0
"""Time to wait for a plan [s]: up to four other plans may be waiting before it."""


class ActionClient:
    """Lists, adds, stores, renames and removes the actions of a running hand.

    A change takes effect for all clients at once.

    Args:
        link: The connection to the hand.
    """

    def __init__(self, link: Link) -> None:
        self._link = link

    async def actions(
        self, kind: str = "", name: str = "", elements: Sequence[str] = ()
    ) -> list[Action]:
        """Return the actions that match a filter; see `ActionLibrary.all`."""
        fields = {"kind": kind, "name": name, "elements": listed(elements)}
        reply = await self._link.ask("actions", fields)
        return [action_of(entry) for entry in reply["actions"]]

    async def primitives(self) -> list[PrimitiveGroup]:
        """Return the primitives grouped by name, as a user interface shows them."""
        return [group_of(entry) for entry in (await self._link.ask("primitives"))["groups"]]

    async def partners(self, name: str, element: str) -> tuple[str, ...]:
        """Return the elements with which a given one can be combined in a primitive."""
        reply = await self._link.ask("partners", self._action(name, element))
        return tuple(reply["names"])

    async def openings(self) -> list[OpeningRange]:
        """Return the ranges of openings and forces for goals, of the actions that have them."""
        return [opening_of(entry) for entry in (await self._link.ask("openings"))["openings"]]

    async def limits(self) -> GripLimits:
        """Return the openings, forces and speeds that goals may ask for.

        Raises:
            RequestRejected: if no action of the hand has an opening.
        """
        ranges = await self.openings()
        if not ranges:
            raise RequestRejected(
                f"no action of '{self._link.hand}' has an opening of its fingertips"
            )
        info = info_of(await self._link.ask("info", {"name": [], "position": []}))
        return limits_of(ranges, await self.actions(), info)

    async def trials(self) -> str:
        """Return the text of the file with the results of trials; empty if there is none.

        `rtee.trials.store.parse_results` reads it. Its last line, ``present``, identifies the
        hand's files as they are now, ``present_model`` and ``present_actions`` its model and each
        of its actions; `rtee.trials.store.outdated` says which trials were made with others.
        """
        return str((await self._link.ask("trials"))["data"])

    async def grasp_plan(
        self,
        object: str,  # noqa: A002 - as on the command line
        *,
        mass: float = 0.1,
        friction: float = 0.5,
        scale: float = 1.0,
        weight_axis: Sequence[float] = (),
        top: int = 5,
        table: Table | None = None,
    ) -> Ranking:
        """Return the actions that suit an object, best first, with the reasons; nothing moves.

        The hand plans with its stored actions, in a process beside the loop. Its computer needs the
        extra ``extract``.

        Args:
            object: ``box:WxDxH``, ``cylinder:RADIUSxHEIGHT``, ``sphere:RADIUS``,
                ``capsule:RADIUSxLENGTH`` [m], ``drill``, or the path of a local mesh file, which is
                sent.
            mass: Its mass [kg].
            friction: Coefficient of friction.
            scale: Brings a mesh to metres.
            weight_axis: Direction of its weight in the hand's base frame; along its reach unless
                given.
            top: Number of grasps to return.
            table: The table on which the object stands; it has the weight's direction if given a
                normal.

        Raises:
            ConfigError: if the object or an option makes no sense.
            RequestRejected: if the hand refuses the request, with the reason.
        """
        question = question_about(
            object,
            mass=mass,
            friction=friction,
            scale=scale,
            weight_axis=tuple(weight_axis),
            top=top,
            table=table,
        )
        fields = {name: getattr(question, name) for name in Question.__dataclass_fields__}
        fields["table"] = table_fields(table)
        # The file itself is sent: a path would name a file of the hand's computer.
        reply = await self._link.ask("grasp_plan", fields, within=PLANNED_WITHIN)
        return from_document(json.loads(reply["data"]))

    async def add_generic(
        self,
        name: str,
        set_points: Mapping[str, float],
        *,
        description: str = "",
        store: bool = False,
        replace: bool = False,
    ) -> None:
        """Add a generic action.

        Args:
            name: Its name.
            set_points: Positions of the involved actuators [rad | m].
            description: One sentence for people.
            store: Whether to write it to the hand's folder, too.
            replace: Whether to replace an action of the same name.

        Raises:
            RequestRejected: if the hand refuses the action, with the reason.
        """
        posture = Posture(set_points, tuple(set_points))
        await self.add_action(Generic(name, posture, description), store=store, replace=replace)

    async def add_composed(
        self,
        name: str,
        parts: Sequence[ActionReference | str],
        *,
        independent: bool = False,
        description: str = "",
        store: bool = False,
        replace: bool = False,
    ) -> None:
        """Add a composed action; see `ActionLibrary.compose`."""
        action = Composed(
            name, tuple(map(ActionReference.of, parts)), _NOWHERE, independent, description
        )
        await self.add_action(action, store=store, replace=replace)

    async def add_timed(
        self,
        name: str,
        steps: Sequence[StepPlan],
        *,
        description: str = "",
        store: bool = False,
        replace: bool = False,
    ) -> None:
        """Add a timed action; see `ActionLibrary.sequence`."""
        timed = tuple(
            Step(ActionReference.of(s.use), s.alias, s.before, s.after, _NOWHERE) for s in steps
        )
        action = Timed(name, timed, description)
        await self.add_action(action, store=store, replace=replace)

    async def add_action(
        self, action: CustomAction, *, store: bool = False, replace: bool = False
    ) -> None:
        """Add a composed, timed or generic action.

        The hand looks up its parts and computes its postures from them.
        """
        fields = {
            "client": self._link.client,
            "action": action_fields(action),
            "store": store,
            "replace": replace,
        }
        await self._link.ask("add", fields)

    async def store_action(self, name: str) -> None:
        """Write an action that is only in memory to the hand's folder."""
        await self._link.ask("store", self._action(name))

    async def remove_action(self, name: str) -> None:
        """Remove an action and its file."""
        await self._link.ask("remove", self._action(name))

    async def rename_action(self, name: str, new_name: str) -> None:
        """Rename an action, in all actions that use it, too."""
        await self._link.ask("rename", self._action(name, new_name))

    def _action(self, name: str, what: str = "") -> dict[str, str]:
        return {"client": self._link.client, "name": name, "what": what}
