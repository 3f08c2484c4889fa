"""The tools and resources that a hand offers to an agent."""

from __future__ import annotations

import contextlib
import functools
import json
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import anyio
import anyio.to_thread
from mcp.server.mcpserver import Image, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.resources import FunctionResource
from mcp.server.mcpserver.tools import Tool
from mcp.types import ToolAnnotations
from pydantic import Field, ValidationError

from rtee.actions.library import ActionLibrary
from rtee.actions.naming import label
from rtee.agent import texts
from rtee.agent.agent import Agent
from rtee.agent.texts import INSTRUCTIONS
from rtee.errors import GoalRejected, RteeError, foreign, needing_extra, suggestion
from rtee.hand.load import hand_folder, load_configured
from rtee.messages.goals import goal_of
from rtee.objects.shape import TABLE, parse_table
from rtee.planning.result import GraspPlan
from rtee.remote.agents import AGENT
from rtee.remote.client import stop_hand

_SHAPE: Final = r"^(box:[\d.]+x[\d.]+x[\d.]+|(cylinder|capsule):[\d.]+x[\d.]+|sphere:[\d.]+)$"
"""Pattern of objects: only shapes with sizes, since a mesh would be a file."""

_SHAPES: Final = "box:WxDxH, cylinder:RADIUSxHEIGHT, sphere:RADIUS or capsule:RADIUSxLENGTH [m]"
_MOST: Final = "; the largest allowed share unless given"

_PLANS: Final = 5
"""Maximum number of listed grasps."""

_RECORDINGS: Final = 20
"""Maximum number of listed recordings."""

# Strict: neither a string nor a Boolean counts as a number.
_text = partial(Field, strict=True, max_length=100)
_number = partial(Field, strict=True, allow_inf_nan=False)
_share = partial(_number, gt=0, le=1)

Name = Annotated[str, _text(min_length=1, description="A name that 'describe' lists.")]
Names = Annotated[
    list[Name], Field(strict=True, max_length=20, description="Fingers, or the actuator.")
]
HandName = Annotated[str, _text(description="The hand; empty if there is only one.")]
GraspedObject = Annotated[str, _text(pattern=_SHAPE, description=f"The object, as {_SHAPES}.")]
Force = Annotated[float, _number(gt=0, description="Force on the object [N].")]
Width = Annotated[float, _number(ge=0, description="Width of the object [m]: 0.03 is 30 mm.")]
Intensity = Annotated[float, _number(ge=0, le=1, description="0: rest; 1: the full action.")]
Effort = Annotated[float, _share(description=f"Share of the effort limits{_MOST}.")]
Speed = Annotated[float, _share(description=f"Share of the velocity limits{_MOST}.")]
Mass = Annotated[float, _number(gt=0, le=100, description="Mass of the object [kg].")]
Friction = Annotated[float, _number(gt=0, le=10, description="Coefficient of friction.")]
Stands = Annotated[str, _text(description=f"Table under the object: {TABLE}; or empty.")]
Number = Annotated[int, Field(strict=True, ge=0, description="Only entries with later numbers.")]


class Tools:
    """The tools of an agent; each takes the name of a hand if there are several."""

    def __init__(self, agents: Sequence[Agent]) -> None:
        self.agents: Mapping[str, Agent] = {agent.name: agent for agent in agents}

    def _agent(self, hand: str) -> Agent:
        name = hand or (next(iter(self.agents)) if len(self.agents) == 1 else "")
        if name not in self.agents:
            raise GoalRejected(f"which hand? {suggestion(hand, self.agents)}")
        return self.agents[name]

    async def describe(self, hand: HandName = "") -> dict[str, Any]:
        """List the hand's actions, openings [m] and forces [N], and your limits."""
        agent = self._agent(hand)
        limits = {name: getattr(agent.limits, name) for name in ("force", "effort", "speed")}
        gate = {"hand": agent.name, "gate": agent.limits.gate, "limits": limits}
        return gate | await self.library(agent)

    async def library(self, agent: Agent) -> dict[str, Any]:
        """Return the actions that an agent may execute, and the openings of all actions."""
        remote = await agent.remote()
        actions = [each for each in await remote.actions() if agent.limits.allows(each.name)]
        return {
            "actions": list(map(texts.action, actions)),
            "openings": list(map(texts.opening, await remote.openings())),
        }

    async def model(self, agent: Agent) -> dict[str, Any]:
        """Return the hand's URDF, without the names of files."""
        urdf = await (await agent.remote()).robot_description()
        return {texts.UNTRUSTED: re.sub(r"""filename\s*=\s*("[^"]*"|'[^']*')""", "", urdf)}

    async def state(self, hand: HandName = "") -> dict[str, Any]:
        """Return the hand's activity, holder and devices, opening [m] and grip force [N]."""
        remote = await self._agent(hand).remote()
        state, measured = await remote.state(), ("opening", "force", "force_error")
        tips = {name: texts.number(getattr(state, name)) for name in measured}
        return texts.status(await remote.status()) | tips

    async def events(self, hand: HandName = "", after: Number = 0) -> dict[str, Any]:
        """Return the latest events, and results of your motions, since this server started."""
        return {"happened": [n for n in tuple(self._agent(hand).notes) if n["number"] > after]}

    async def grasp_plan(
        self,
        object: GraspedObject,  # noqa: A002 - as everywhere in rtee
        hand: HandName = "",
        mass: Mass = 0.1,
        friction: Friction = 0.5,
        table: Stands = "",
    ) -> list[str | Image]:
        """Rank the actions for an object, with reasons and a picture of the best; nothing moves."""
        agent = self._agent(hand)
        stands, remote = parse_table(table) if table else None, await agent.remote()
        ranking = await remote.grasp_plan(object, mass=mass, friction=friction, table=stands)
        plans = [plan for plan in ranking.plans if plan.action and agent.limits.allows(plan.action)]
        cannot = {name: texts.outside(why) for name, why in ranking.rejected}
        found = {"grasps": list(map(_planned, plans[:_PLANS])), "cannot": cannot}
        return [json.dumps(found, indent=2), *(await _picture(agent.name, plans))]

    async def do(
        self,
        action: Name,
        elements: Names = [],  # noqa: B006 - pydantic copies it, and nothing changes it
        hand: HandName = "",
        intensity: Intensity = 1.0,
        effort: Effort | None = None,
        speed: Speed | None = None,
        object: GraspedObject | None = None,  # noqa: A002
    ) -> dict[str, Any]:
        """Execute an action that 'describe' lists; give the object if the action closes on one."""
        agent = self._agent(hand)
        limits, remote = agent.limits, await agent.remote()
        if not (found := await remote.actions("", action, elements)):
            known = {each.name for each in await remote.actions()}
            what = label(action, tuple(elements))
            raise GoalRejected(f"no action {what}; {suggestion(action, known)}")
        share = limits.effort if effort is None else effort
        if share > limits.effort:
            raise GoalRejected(
                f"an effort of {share:g} is more than the {limits.effort:g} that a person allows"
            )
        # Send no limit for full effort, since some devices accept none.
        efforts = {} if share == 1.0 else await remote.effort_limits(share)
        fast = limits.speed if speed is None else speed
        name = found[0].name
        goal = goal_of(name, elements, intensity=intensity, speed=fast, effort=efforts)
        words = f"do {label(name, tuple(elements))} to {intensity:.0%}, effort {share:.0%}"
        return await agent.move(goal, words, object or "")

    async def grasp(
        self,
        width: Width,
        force: Force,
        fingers: Names = [],  # noqa: B006
        hand: HandName = "",
        speed: Speed | None = None,
        object: GraspedObject | None = None,  # noqa: A002
    ) -> dict[str, Any]:
        """Open wider than an object, close on it, and hold it with the given force."""
        agent = self._agent(hand)
        fast = agent.limits.speed if speed is None else speed
        goal = goal_of("", fingers, grasp=True, opening=width, force=force, speed=fast)
        known = {name for each in await (await agent.remote()).openings() for name in each.elements}
        for name in fingers:
            if name not in known:
                raise GoalRejected(f"the finger '{name}' has no opening; {suggestion(name, known)}")
        words = f"grasp {width * 1e3:g} mm with {force:g} N"
        return await agent.move(goal, words, object or f"box:{width:g}x{width:g}x{width:g}")

    async def open(self, hand: HandName = "") -> dict[str, Any]:
        """Open the hand, which drops a held object."""
        agent = self._agent(hand)
        return await agent.move(goal_of("open", speed=agent.limits.speed), "open the hand")

    async def stop(self, hand: HandName = "") -> dict[str, Any]:
        """Stop the hand at once; afterwards only a person lets you move it again."""
        agent = self._agent(hand)
        # Through the stop socket, regardless of the connection's state.
        _, confirmed = await stop_hand(agent.name, endpoint=agent.endpoint, client=AGENT)
        return {"confirmed": confirmed}

    async def recordings(self, hand: HandName = "") -> dict[str, Any]:
        """List the newest recordings of the hand; 'recording' returns the content of one."""
        return {"recordings": list(await _recorded(self._agent(hand)))}

    async def recording(self, name: Name, hand: HandName = "") -> dict[str, Any]:
        """Return the goals and events in a recording that 'recordings' lists; times in seconds."""
        from rtee.log.info import info

        files = await _recorded(self._agent(hand))
        if name not in files:
            raise GoalRejected(f"no recording '{name}'; {suggestion(name, files)}")
        recording = await anyio.to_thread.run_sync(info, [files[name]])
        return {
            "duration": recording.duration,
            "goals": [
                {"goal": texts.outside(s.name), "from": s.start, "to": s.end, "ended": s.outcome}
                for s in recording.goals
            ],
            "events": [{"at": e.t, **texts.event(e)} for e in recording.events],
        }


async def _recorded(agent: Agent) -> dict[str, Path]:
    """Return the newest recordings in the folder that the hand writes to, the newest first."""
    path = (await (await agent.remote()).status()).recording
    if agent.endpoint is not None or not path:
        raise GoalRejected("the hand does not record on this computer")
    files = {p.name: p for p in Path(path).parent.glob(f"{agent.name}_*.mcap") if p.is_file()}
    return {name: files[name] for name in sorted(files, reverse=True)[:_RECORDINGS]}


def _planned(plan: GraspPlan) -> dict[str, Any]:
    names = ("score", "intensity", "effort", "width", *(("force",) if plan.force else ()))
    numbers = {name: texts.number(getattr(plan, name)) for name in names}
    words = {"action": plan.action, "elements": plan.elements}
    return words | numbers | {"reasons": list(map(texts.outside, plan.reasons))}


async def _picture(name: str, plans: Sequence[GraspPlan]) -> list[str | Image]:
    """Return a picture of the best grasp, or the reason why there is none."""
    if not plans:
        return []
    try:
        drawn = await anyio.to_thread.run_sync(_draw, name, plans[0])
    except RteeError as error:
        return [json.dumps({"no_picture": texts.outside(str(error))})]
    return [Image(data=drawn, format="png")]


def _draw(name: str, plan: GraspPlan) -> bytes:
    """Return a PNG file of a hand that closes on the object; reads the hand's files here."""
    with needing_extra("a picture of a grasp", "plot"):
        from rtee.planning.closing import ActionPath
        from rtee.render.hand import HandRenderer

    hand, _ = load_configured(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    posture = ActionPath.of(hand, library.find(plan.action, plan.elements)).at(plan.touch)
    contacts = [(each.point, each.normal) for each in plan.contacts]
    return HandRenderer(hand, postures=[posture]).picture(posture, contacts=contacts, ghost=True)


_READING: Final = ("describe", "state", "events", "grasp_plan", "recordings", "recording")
_MOVING: Final = ("do", "grasp", "open", "stop")
"""The read-only tools, and the others; agents see no other methods of `Tools`."""


@contextlib.asynccontextmanager
async def serving(agents: Sequence[Agent]) -> AsyncIterator[MCPServer]:
    """Connect to hands, and yield the server of their tools while the context lasts."""
    async with anyio.create_task_group() as group:
        for agent in agents:
            group.start_soon(agent.run)
        yield server_of(agents)
        group.cancel_scope.cancel()


async def serve(agents: Sequence[Agent]) -> None:
    """Serve an agent on stdin and stdout until it disconnects."""
    async with serving(agents) as server:
        await server.run_stdio_async()


def server_of(agents: Sequence[Agent]) -> MCPServer:
    """Return the server that offers the tools and resources of some hands."""
    tools = Tools(agents)
    made = [_tool(getattr(tools, name), agents) for name in (*_READING, *_MOVING)]
    server = MCPServer("rtee", instructions=INSTRUCTIONS, tools=made, log_level="WARNING")
    for agent in agents:
        for what, read in (("model", tools.model), ("library", tools.library)):
            uri, name = f"rtee://{agent.name}/{what}", f"{what} of {agent.name}"
            fn, mime = functools.partial(read, agent), "application/json"
            server.add_resource(FunctionResource(uri=uri, name=name, fn=fn, mime_type=mime))
    return server


class _Tool(Tool):
    """A tool that says in a sentence which arguments are wrong, instead of pydantic's lines."""

    async def run(self, arguments: dict[str, Any], *args: Any, **kwargs: Any) -> Any:
        try:
            return await super().run(arguments, *args, **kwargs)
        except ToolError as error:
            if not isinstance(error.__cause__, ValidationError):
                raise
            wrong = "; ".join(map(_wrong, error.__cause__.errors()))
            raise ToolError(f"Error executing tool {self.name}: {wrong}") from None


def _wrong(error: Mapping[str, Any]) -> str:
    """Return one of pydantic's errors as a sentence about the argument."""
    words = {
        "extra_forbidden": "is not an argument of this tool",
        "missing": "is missing",
        "string_pattern_mismatch": f"should be {_SHAPES}",
    }
    name = foreign(".".join(map(str, error["loc"])))
    # "Input should be …", "List should have …"
    return f"'{name}' {words.get(error['type'], error['msg'].partition(' ')[2])}"


def _tool(method: Callable[..., Awaitable[Any]], agents: Sequence[Agent]) -> Tool:
    @functools.wraps(method)
    async def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return await method(*args, **kwargs)
        except RteeError as error:
            raise ToolError(str(error)) from None

    reads = ToolAnnotations(read_only_hint=method.__name__ in _READING)
    tool = _Tool.from_function(call, annotations=reads)
    # Otherwise, misspelt options would be silently ignored.
    model = tool.fn_metadata.arg_model
    model.model_config["extra"] = "forbid"
    model.model_rebuild(force=True)
    tool.parameters["additionalProperties"] = False
    properties = tool.parameters["properties"]
    properties["hand"]["enum"] = ["", *(agent.name for agent in agents)]
    if "force" in properties:
        properties["force"]["maximum"] = max(agent.limits.force for agent in agents)
    return tool
