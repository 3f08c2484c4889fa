"""The services of a hand's node: stop, open, its actions, and queries about the hand."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Iterable, Iterator
from functools import partial
from typing import Any

from rtee.actions.naming import normalise, snake_case
from rtee.actions.types import Action, ActionKind, kind_of
from rtee.errors import MessageError, NoHand, RteeError
from rtee.messages.schema import full_name
from rtee.remote.action_client import PLANNED_WITHIN
from rtee.remote.monitoring import HandStatus
from rtee.remote.words import sentence
from rtee.ros2.endpoints import Service
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.parameters import Parameter
from rtee.ros2.served_hand import Part, ServedHand
from rtee.ros2.topics import ros_name
from rtee.ros2.types import referred
from rtee.types import Result

TOLERANCE, SPEED, INTENSITY = "tolerance", "speed", "intensity"
"""Names of the parameters for the goals that services start."""

GRIP_EFFORT = "grip_effort"
"""Name of the parameter for the effort on a grasped object."""

CHANGED = "actions_changed"
"""Kind of the event that reports changed actions of the hand."""

_TRIGGER = "std_srvs/srv/Trigger"


class Services(Part):
    """Offers the actions and queries of a hand as services, and its gains as parameters."""

    def __init__(self, served: ServedHand, actions: Iterable[Action], status: HandStatus) -> None:
        self._served, self._status = served, status
        self._offered: dict[str, tuple[Action, Service]] = {}
        node = served.node
        self._trigger = node.context.interfaces.service(_TRIGGER)
        for name, answer in (("stop", self._stop), ("recover", self._recover)):
            self._offer(f"~/{name}", answer)
        self._offer("~/open", partial(self._goal, "open", ()))
        for name, handler in (
            ("ListActions", self._list_actions),
            ("PrimitivesAggregated", self._primitives),
            ("SelectablePartners", self._partners),
            ("NewGenericAction", self._new_generic),
            ("GetHandInfo", self._info),
            ("ListOpenings", self._openings),
            ("PlanGrasps", self._plan_grasps),
        ):
            kind = node.context.interfaces.service(f"rtee_msgs/srv/{name}")
            node.service(f"~/{snake_case(name)}", kind, partial(_with, kind.response, handler))
        self._update(actions)
        served.on_status.append(self._keep_gains)

    def parameters(self) -> Iterable[Parameter]:
        """Return the parameters of goals, the gains and the limits."""
        goals = "of the goals that services begin"
        yield Parameter(TOLERANCE, 0.01, f"Tolerance {goals} [rad | m].", lower=1e-6, upper=1.0)
        yield Parameter(
            SPEED, 1.0, f"Scale of the velocity limits {goals}.", lower=0.001, upper=1.0
        )
        yield Parameter(INTENSITY, 1.0, f"Intensity {goals}: 0 (rest) to 1.", lower=0.0, upper=1.0)
        hand = self._served.hand
        yield Parameter(
            GRIP_EFFORT,
            self._status.grip_effort,
            "Effort kept on a grasped object, as a fraction of the effort limit.",
            lower=0.0,
            upper=1.0,
            change=lambda value: hand.set_gains({GRIP_EFFORT: value}),
        )
        for device, gain, value in _gains(self._status):
            # A device that does not report its gain has NaN; a client could not read it back.
            if not math.isnan(value):
                yield Parameter(
                    gain_name(device, gain),
                    value,
                    f"Gain {gain} of the device {device}.",
                    change=partial(self._set_gain, device, gain),
                )
        model = self._served.model
        for name, values in (("lower", model.lower), ("upper", model.upper)):
            text = f"{name.capitalize()} limits of the actuators [rad | m]."
            yield Parameter(f"limits.{name}", values.tolist(), text, read_only=True)
        yield Parameter(
            "use_sim_time", False, "Always false: a hand uses its computer's time.", read_only=True
        )

    async def _set_gain(self, device: str, gain: str, value: float) -> None:
        await self._served.hand.set_gains({gain: value}, device)

    async def run(self) -> None:
        """Follow changes of the hand's actions until the hand ends."""
        events = self._served.hand.events()
        # Update after subscribing, since the actions may have changed while the node was made.
        self._update(await self._served.hand.actions())
        async for event in events:
            if event.kind == CHANGED:
                self._update(await self._served.hand.actions())

    def _keep_gains(self, status: HandStatus) -> None:
        """Update the parameters of gains, which other clients may have changed."""
        gains = {gain_name(device, gain): value for device, gain, value in _gains(status)}
        gains[GRIP_EFFORT] = status.grip_effort
        parameters = self._served.parameters
        known = parameters.values
        # A gain unknown at the start has no parameter, and NaN would count as a change each time.
        parameters.update({n: v for n, v in gains.items() if n in known and not math.isnan(v)})

    # --- services that move the hand

    def _offer(self, name: str, answer: Callable[[], Awaitable[tuple[bool, str]]]) -> Service:
        """Offer a ``Trigger`` service; its response carries the message of an error."""

        async def handle(_: Any) -> Message:
            try:
                success, text = await answer()
            except RteeError as error:
                success, text = False, str(error)
            return self._trigger.response(success=success, message=text)

        return self._served.node.service(name, self._trigger, handle)

    async def _stop(self) -> tuple[bool, str]:
        confirmed = await self._served.hand.stop()
        silent = [device for device, done in confirmed.items() if not done]
        if silent:
            return False, f"no answer from {', '.join(silent)}"
        return True, "all devices have stopped"

    async def _recover(self) -> tuple[bool, str]:
        await self._served.hand.recover()
        return True, "all devices have recovered"

    async def _goal(
        self, name: str, elements: tuple[str, ...], kind: ActionKind | None = None
    ) -> tuple[bool, str]:
        served = self._served
        result: Result = await served.hand.do(
            name,
            *elements,
            kind=kind,
            tolerance=served.number(TOLERANCE),
            speed=served.number(SPEED),
            # The hand opens completely, whatever intensity is set for other goals.
            intensity=served.number(INTENSITY) if kind is not None else 1.0,
        )
        return result.succeeded, sentence(result, elements)

    def _update(self, actions: Iterable[Action]) -> None:
        """Offer one service for each action; withdraw those of removed actions."""
        wanted: dict[str, Action] = {}
        for action in actions:
            name = service_name(action)
            if name in wanted:  # a composed action may be called as a primitive with its elements
                name = f"{name}_{kind_of(action)}"
            wanted[name] = action
        for name in [name for name in self._offered if name not in wanted]:
            self._served.node.discard(self._offered.pop(name)[1])
        for name, action in wanted.items():
            same = self._offered.get(name)
            # Replaced only if it means another action, since closing it loses a pending response.
            if same is not None and _reference(same[0]) == _reference(action):
                continue
            if same is not None:
                self._served.node.discard(same[1])
            service = self._offer(f"~/do/{name}", partial(self._goal, *_reference(action)))
            self._offered[name] = action, service

    # --- queries

    async def _list_actions(self, request: Any) -> dict[str, Any]:
        fields = {"kind": request.kind, "name": request.name, "elements": request.elements}
        return await self._served.hand.ask("actions", fields)

    async def _primitives(self, request: Any) -> dict[str, Any]:
        groups = (await self._served.hand.ask("primitives"))["groups"]
        wanted = normalise(request.name)
        return {"groups": [g for g in groups if wanted in ("", normalise(g["name"]))]}

    async def _partners(self, request: Any) -> dict[str, Any]:
        return {"partners": await self._served.hand.partners(request.action, request.element)}

    async def _new_generic(self, request: Any) -> dict[str, Any]:
        if len(request.actuator) != len(request.position):
            reason = f"{len(request.actuator)} actuators have {len(request.position)} positions"
            return {"accepted": False, "reason": reason}
        where = dict(zip(request.actuator, request.position.tolist(), strict=True))
        try:
            await self._served.hand.add_generic(
                request.name, where, store=request.store, replace=request.replace
            )
        # A hand that has ended does not refuse the action; the service logs this error.
        except NoHand:
            raise
        except RteeError as error:
            return {"accepted": False, "reason": str(error)}
        return {"accepted": True}

    async def _info(self, request: Any) -> dict[str, Any]:
        fields = {"name": request.name, "position": request.position}
        return {"info": await self._served.hand.ask("info", fields)}

    async def _openings(self, _: Any) -> dict[str, Any]:
        return await self._served.hand.ask("openings")

    async def _plan_grasps(self, request: Any) -> dict[str, Any]:
        try:
            asked = request.request.to_dict()
            plans = await self._served.hand.ask("grasp_plan", asked, within=PLANNED_WITHIN)
        except NoHand:
            raise
        except RteeError as error:
            return {"accepted": False, "reason": str(error)}
        return {"accepted": True, "plans": plans["data"]}


def service_name(action: Action) -> str:
    """Return the name of an action's service: ``pinch_tight_index_thumb``."""
    return ros_name("_".join((snake_case(action.name), *action.elements)))


def gain_name(device: str, gain: str) -> str:
    """Return the name of the parameter of a gain."""
    return f"gains.{ros_name(device)}.{gain}"


def _gains(status: HandStatus) -> Iterator[tuple[str, str, float]]:
    """Yield device, name and value of each gain."""
    for device in status.devices:
        for gain, value in zip(device.gains, device.gain_values, strict=False):
            yield device.name, gain, value


def _reference(action: Action) -> tuple[str, tuple[str, ...], ActionKind]:
    """Return name, elements and kind, which identify an action."""
    return action.name, tuple(action.elements), kind_of(action)


async def _with(
    response: type[Message], handler: Callable[[Any], Awaitable[dict[str, Any]]], request: Any
) -> Message:
    """Return a response with the fields that a handler returns."""
    made: Message = response.from_dict(await handler(request))
    return made


_SERVICE = "type_description_interfaces/srv/GetTypeDescription"
_MESSAGES = "type_description_interfaces/msg"

NO_SERVICE = frozenset({"humble"})
"""Distributions whose nodes do not have the service."""


class TypeDescriptions:
    """Answers ``~/get_type_description`` of a node.

    Args:
        node: The node.
    """

    def __init__(self, node: Node) -> None:
        self._interfaces = node.context.interfaces
        self._type = self._interfaces.service(_SERVICE)
        if self._interfaces.distro not in NO_SERVICE:
            node.service("~/get_type_description", self._type, self._answer)

    async def _answer(self, request: Any) -> Message:
        try:
            name = full_name(request.type_name)
            if request.type_hash not in {"", self._interfaces.hash(name)}:
                raise MessageError(f"'{name}' has another hash here: {self._interfaces.hash(name)}")
            tree = self._interfaces.description(name)
        except MessageError as error:
            return self._type.response(failure_reason=str(error))
        # The tree has the names of the message's fields.
        described = self._interfaces.message(f"{_MESSAGES}/TypeDescription").from_dict(tree)
        sources = self._sources(name) if request.include_type_sources else []
        return self._type.response(
            successful=True, type_description=described, type_sources=sources
        )

    def _sources(self, name: str) -> list[Message]:
        structure = self._interfaces.structure(name)
        source = self._interfaces.message(f"{_MESSAGES}/TypeSource")
        sources = []
        for each in (structure, *referred(structure)):
            text = self._interfaces.texts.get(each.name)
            # Parts derived from a service or action have no definition of their own.
            kind = each.name.split("/")[1] if text is not None else "implicit"
            sources.append(source(type_name=each.name, encoding=kind, raw_file_contents=text or ""))
        return sources
