"""List and change the actions of a running hand, plan grasps, and execute planners' grasps."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence, Sized
from dataclasses import replace
from typing import Final

import anyio
import numpy as np
from numpy.typing import ArrayLike

from rtee.actions.build import StepPlan, parts_of, plans_of
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
from rtee.errors import ActionError, ConfigError, RequestRejected
from rtee.hand.names import listed
from rtee.messages.convert import table_fields
from rtee.objects.shape import Table, vector
from rtee.planning.grasp_solution import GraspSolution, WantedContact
from rtee.planning.grasp_solution import from_document as solution_in
from rtee.planning.question import Question, ReachQuestion, question_about
from rtee.planning.result import Ranking, from_document
from rtee.remote.actions import GROUP, action_fields, action_of
from rtee.remote.goal import GoalClient
from rtee.remote.goal_values import numbers, word_of
from rtee.remote.hand_info import info_of
from rtee.remote.link import Link
from rtee.remote.openings import GripLimits, OpeningRange, limits_of, opening_of
from rtee.types import Result, Stage
from rtee.units import LENGTH, quantity

_NOWHERE = Posture({}, ())
"""Posture of an action that is sent: the hand computes it from the parts."""

PLANNED_WITHIN: Final = 90.0
"""Time to wait for a plan [s]: up to four other plans may be waiting before it."""


class LibraryClient:
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
        fields = {"kind": kind, "name": name, "elements": listed(elements, "elements", ActionError)}
        reply = await self._link.ask("actions", fields)
        return [action_of(entry) for entry in reply["actions"]]

    async def primitives(self) -> list[PrimitiveGroup]:
        """Return the primitives grouped by name, as a user interface shows them."""
        return [GROUP.of(entry) for entry in (await self._link.ask("primitives"))["groups"]]

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
            ConfigError: if the object or an option is invalid.
            RequestRejected: if the hand refuses the request, with the reason.
        """
        given_none = isinstance(weight_axis, Sized) and not len(weight_axis)
        question = question_about(
            object,
            mass=mass,
            friction=friction,
            scale=scale,
            weight_axis=() if given_none else vector(weight_axis, "the weight axis"),
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
            GoalRejected: if a set-point is not a finite number.
            RequestRejected: if the hand refuses the action, with the reason.
        """
        given = numbers(set_points, "set-point")
        posture = Posture(given, tuple(given))
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
        action = Composed(name, parts_of(parts), _NOWHERE, independent, description)
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
            Step(ActionReference.of(s.use), s.alias, s.before, s.after, _NOWHERE)
            for s in plans_of(steps)
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
        """Store an action from memory in the hand's folder."""
        await self._link.ask("store", self._action(name))

    async def remove_action(self, name: str) -> None:
        """Remove an action and its file."""
        await self._link.ask("remove", self._action(name))

    async def rename_action(self, name: str, new_name: str) -> None:
        """Rename an action, in all actions that use it, too."""
        await self._link.ask("rename", self._action(name, new_name))

    def _action(self, name: str, what: str = "") -> dict[str, str]:
        return {"client": self._link.client, "name": name, "what": what}


_NAMED: Final = 3
"""Most collisions that a refusal names, the deepest ones first: they fit into a sentence."""


class ReachClient:
    """Converts grasps of a planner to postures of the hand, and executes them."""

    def __init__(self, link: Link, actions: LibraryClient, goals: GoalClient) -> None:
        self._link, self._actions, self._goals = link, actions, goals

    async def reach(
        self,
        contacts: Sequence[WantedContact] | ArrayLike | None = None,
        *,
        width: float | str | None = None,
        pose: ArrayLike | None = None,
        fingers: Sequence[str] = (),
        approach: Sequence[float] | None = None,
        retreat: float | str = 0.1,
        tolerance: float | str = 0.003,
        object: str = "",  # noqa: A002 - as on the command line
        object_pose: ArrayLike | None = None,
    ) -> GraspSolution:
        """Return the postures and palm poses for a grasp of a planner; nothing moves.

        The hand computes them in a process beside the loop. Its computer needs the extra
        ``extract``.

        Args:
            contacts: Contacts, or their points ``(k, 3)`` [m], for the fingertips.
            width: Width of the object for a gripper's pose [m], or such as ``30mm``, instead of
                contacts.
            pose: Pose ``(4, 4)`` in the planner's frame. With contacts: of the palm (without it,
                contacts are in the palm's frame). With a width: of the gripper, with x along the
                approach, y along the closing and the origin between the ends of its fingers.
            fingers: The fingers to grasp with, for a width.
            approach: Direction in which the palm approaches.
            retreat: Distance of the palm before the approach [m].
            tolerance: Largest distance of a fingertip from its contact [m].
            object: Shape of the object, such as ``box:0.04x0.04x0.1`` [m]. The result's
                ``collisions`` then include those of links with the object, besides those among
                links.
            object_pose: Pose of the object ``(4, 4)`` in the planner's frame; identity by default.

        Raises:
            ConfigError: if a value is malformed.
            RequestRejected: if the grasp cannot be reached, with the reason.
        """
        question = _question(contacts, width, pose, fingers, approach, retreat, tolerance)
        if object_pose is not None:
            flat = _numbers(object_pose, (4, 4), "the object's pose is 4 by 4 numbers")
            question = replace(question, object_pose=tuple(flat))
        question = replace(question, object=object)
        question.check()
        reply = await self._link.ask("reach", question.words()["reach"], within=PLANNED_WITHIN)
        return solution_in(json.loads(reply["data"]))

    async def grasp_at(
        self,
        solution: GraspSolution | Sequence[WantedContact] | ArrayLike | None = None,
        *,
        width: float | str | None = None,
        pose: ArrayLike | None = None,
        fingers: Sequence[str] = (),
        approach: Sequence[float] | None = None,
        force: float | str | None = None,
        stage: Stage | str = Stage.BOTH,
        despite_collisions: bool = False,
    ) -> Result:
        """Execute a grasp of a planner and wait for the result.

        With an arm, use two stages: ``reach``, the arm to ``pre_palm_pose``,
        ``grasp_at(solution, stage="pre_grasp")``, the arm to ``palm_pose``, and
        ``grasp_at(solution, stage="grasp")``.

        Args:
            solution: The result of `reach`; or contacts, as for `reach`.
            width: As for `reach`.
            pose: As for `reach`.
            fingers: As for `reach`.
            approach: As for `reach`.
            force: Force between the fingertips, for a width [N].
            stage: ``pre_grasp``: only open for it; ``grasp``: only close; by default both.
            despite_collisions: Execute the grasp even if it has collisions, among links or, where
                `reach` was given an object, of links with the object; refused by default.

        Raises:
            ConfigError: if a value is malformed, or the grasp has collisions.
            RequestRejected: if the grasp cannot be reached or executed, with the reason.
            LeaseHeld: if another client holds the lease.
        """
        part = word_of(stage, Stage, "stage")
        if not isinstance(solution, GraspSolution):
            solution = await self.reach(
                solution, width=width, pose=pose, fingers=fingers, approach=approach
            )
        # Another hand may have actuators of the same names, with other postures for a grasp.
        elif solution.hand != self._link.hand:
            raise ConfigError(
                f"the grasp was solved for '{solution.hand}', not '{self._link.hand}'"
            )
        if solution.collisions and not despite_collisions:
            named = "; ".join(collision.words for collision in solution.collisions[:_NAMED])
            raise ConfigError(f"the grasp has collisions: {named}")
        if solution.action:
            return await self._by_action(solution, force, part)
        if force is not None:
            raise ConfigError("a force needs a width; a grasp by contacts uses the effort limits")
        return await self._by_postures(solution, part)

    async def _by_action(
        self, solution: GraspSolution, force: float | str | None, part: Stage
    ) -> Result:
        if part is Stage.PRE_GRASP:
            return await self._goals.do(
                solution.action, *solution.elements, intensity=solution.pre_intensity
            )
        return await self._goals.grasp(
            solution.width, force=force, fingers=solution.elements, action=solution.action
        )

    async def _by_postures(self, solution: GraspSolution, part: Stage) -> Result:
        """Go to the postures one after the other, by temporary actions."""
        postures = {
            Stage.PRE_GRASP: (solution.pre_grasp,),
            Stage.GRASP: (solution.posture,),
            Stage.BOTH: (solution.pre_grasp, solution.posture),
        }[part]
        # All clients share the names of actions, and two may execute grasps at the same time.
        name = f"grasp_at_{os.urandom(4).hex()}"
        for posture in postures:
            action = Generic(name, Posture(posture, tuple(posture)), "A grasp of a planner.")
            await self._actions.add_action(action)
            try:
                result = await self._goals.do(name)
            finally:
                # All clients see the actions of the hand: none may be left behind, even if this
                # call is cancelled.
                with anyio.CancelScope(shield=True):
                    await self._actions.remove_action(name)
            # Closing from where the hand could not open for it would push the object.
            if not (result.reached or result.stalled):
                break
        return result


def _question(
    contacts: Sequence[WantedContact] | ArrayLike | None,
    width: float | str | None,
    pose: ArrayLike | None,
    fingers: Sequence[str],
    approach: Sequence[float] | None,
    retreat: float | str,
    tolerance: float | str,
) -> ReachQuestion:
    """Return the question; raises `ConfigError` if a value is malformed."""
    flat = tuple(_numbers(pose, (4, 4), "a pose is 4 by 4 numbers")) if pose is not None else ()
    direction = () if approach is None else vector(approach, "an approach")
    if contacts is None:
        if width is None or pose is None:
            raise ConfigError("give contacts, or a gripper's pose and a width")
        return ReachQuestion(
            points=(),
            normals=(),
            fingers=listed(fingers, "fingers", ConfigError),
            width=quantity(width, LENGTH, "width"),
            pose=flat,
            approach=direction,
            retreat=quantity(retreat, LENGTH, "retreat"),
            tolerance=quantity(tolerance, LENGTH, "tolerance"),
        )
    if width is not None or len(fingers):
        raise ConfigError(
            "contacts already name their fingers and set the width; leave out fingers and width"
        )
    wanted = _contacts(contacts)
    normals = [contact.normal for contact in wanted]
    if any(n is None for n in normals) != all(n is None for n in normals):
        raise ConfigError("give a normal for each contact, or for none")
    named = [contact.finger for contact in wanted]
    return ReachQuestion(
        points=tuple(float(v) for contact in wanted for v in contact.point),
        normals=tuple(float(v) for normal in normals if normal is not None for v in normal),
        fingers=tuple(named) if any(named) else (),
        pose=flat,
        approach=direction,
        retreat=quantity(retreat, LENGTH, "retreat"),
        tolerance=quantity(tolerance, LENGTH, "tolerance"),
    )


def _contacts(contacts: Sequence[WantedContact] | ArrayLike) -> list[WantedContact]:
    if isinstance(contacts, Sequence) and all(isinstance(c, WantedContact) for c in contacts):
        return [c for c in contacts if isinstance(c, WantedContact)]
    points = _numbers(contacts, (-1, 3), "points of contacts are three numbers each")
    return [WantedContact((x, y, z)) for x, y, z in np.reshape(points, (-1, 3)).tolist()]


def _numbers(values: object, shape: tuple[int, int], requirement: str) -> list[float]:
    """Return the numbers of an array of a shape, row by row; raises `ConfigError` otherwise."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    fits = array.ndim == 2 and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise ConfigError(f"{requirement}; got {np.shape(array)}")
    return array.ravel().tolist()
