"""The server of the Model Context Protocol: the tools of some hands, over stdin and stdout."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any, Final

import anyio
from mcp.server.mcpserver import MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.resources import FunctionResource
from mcp.server.mcpserver.tools import Tool
from mcp.types import ToolAnnotations

from rtee.agent.agent import Agent
from rtee.agent.texts import INSTRUCTIONS
from rtee.agent.tools import Tools
from rtee.errors import RteeError

_READING: Final = ("describe", "state", "events", "grasp_plan", "recordings", "recording")
_MOVING: Final = ("do", "grasp", "open", "stop")
"""The tools that only read, and the others; nothing else of `Tools` is offered."""


@contextlib.asynccontextmanager
async def serving(agents: Sequence[Agent]) -> AsyncIterator[MCPServer]:
    """Connect to hands and yield the server of their tools, for as long as the context lasts."""
    async with anyio.create_task_group() as group:
        for agent in agents:
            group.start_soon(agent.run)
        yield server_of(agents)
        group.cancel_scope.cancel()


async def serve(agents: Sequence[Agent]) -> None:
    """Serve an agent on stdin and stdout until it leaves."""
    async with serving(agents) as server:
        await server.run_stdio_async()


def server_of(agents: Sequence[Agent]) -> MCPServer:
    """Return the server of the tools and resources of some hands."""
    tools = Tools(agents)
    made = [_tool(getattr(tools, name), agents) for name in (*_READING, *_MOVING)]
    server = MCPServer("rtee", instructions=INSTRUCTIONS, tools=made, log_level="WARNING")
    for agent in agents:
        for what, read in (("model", tools.model), ("library", tools.library)):
            uri, name = f"rtee://{agent.name}/{what}", f"{what} of {agent.name}"
            fn, mime = functools.partial(read, agent), "application/json"
            server.add_resource(FunctionResource(uri=uri, name=name, fn=fn, mime_type=mime))
    return server


def _tool(method: Callable[..., Awaitable[Any]], agents: Sequence[Agent]) -> Tool:
    @functools.wraps(method)
    async def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return await method(*args, **kwargs)
        except RteeError as error:
            raise ToolError(str(error)) from None

    reads = ToolAnnotations(read_only_hint=method.__name__ in _READING)
    tool = Tool.from_function(call, annotations=reads)
    # Misspelt options would otherwise be dropped in silence.
    model = tool.fn_metadata.arg_model
    model.model_config["extra"] = "forbid"
    model.model_rebuild(force=True)
    tool.parameters["additionalProperties"] = False
    properties = tool.parameters["properties"]
    properties["hand"]["enum"] = ["", *(agent.name for agent in agents)]
    if "force" in properties:
        properties["force"]["maximum"] = max(agent.limits.force for agent in agents)
    return tool
