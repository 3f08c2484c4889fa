"""Whatever messages a page sends, STOP is there and works, in this page and in a new one."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import msgspec.msgpack
import pytest
import viser
import viser._messages as viser_messages
from remote.serving import Served, make_hand, make_library, serving, until
from websockets.sync.connection import Connection

from benchmarks.gui_onlooker import admitted, controls, messages, stop, window
from rtee.gui.access import Access, PageRole
from rtee.gui.app import App
from rtee.gui.visitors import Visitors

pytestmark = pytest.mark.anyio

VALUES: tuple[Any, ...] = (
    True,
    None,
    0,
    1e999,
    "x",
    [],
    [[]],
    {},
    {"value": True},
    b"\xff",
    [1, "x"],
)


@pytest.fixture(autouse=True)
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep other hands of this computer out."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_RUNTIME_DIR", raising=False)


def kinds() -> Iterator[type[viser_messages.Message]]:
    waiting: list[type[Any]] = [viser_messages.Message]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        if dataclasses.is_dataclass(kind):
            yield kind


def properties(handle: Any) -> set[str]:
    """Return everything that viser's server would set on a control."""
    return {*vars(handle._impl), *vars(handle._impl.props), "value", "removed", "update_cb"}


def junk(handles: dict[str, Any], role: PageRole) -> Iterator[dict[str, Any]]:
    for uuid, handle in handles.items():
        for name in sorted(properties(handle)):
            for value in VALUES:
                # What an operator may do is no attack: to click a button, or to write a text.
                like = isinstance(value, type(handle._impl.value)) or value == 0
                if role is PageRole.OPERATOR and name == "value" and like:
                    continue
                yield {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {name: value}}
        update = {"type": "GuiUpdateMessage", "uuid": uuid}
        yield {**update, "updates": {"value": True, "removed": True}}
        yield {**update, "updates": {"value": True}, "more": 1}
        yield {**update, "updates": []}
    some = [*handles][:3]
    for kind in kinds():
        if kind.__name__ in ("GuiUpdateMessage", "CommandTriggerMessage"):
            continue
        names = [field.name for field in dataclasses.fields(kind)]
        for uuid in (*some, "", "root"):
            for value in VALUES:
                yield {"type": kind.__name__, **dict.fromkeys(names, value)}
            yield {"type": kind.__name__, **dict.fromkeys(names, uuid)}


def send(connection: Connection, messages: Iterator[dict[str, Any]]) -> int:
    count = 0
    for message in messages:
        connection.send(msgspec.msgpack.encode(message))
        count += 1
    for data in (b"", b"\xc1", b"\x93\x01", b"\x81\xa4type\xa1x", "text", "\x00"):
        connection.send(data)
    return count


async def stops(served: Served, count: int) -> None:
    await until(lambda: sum(event.kind == "stop" for event in served.watcher.events) >= count)
    await anyio.sleep(0.15)  # a stop so soon after another one is answered by that


@pytest.mark.samples("*observer*")
@pytest.mark.parametrize("role", [PageRole.OBSERVER, PageRole.OPERATOR])
async def test_no_message_takes_stop_away(tmp_path: Path, role: PageRole) -> None:
    access = Access(observers=True)
    visitors = Visitors(access)
    hand = make_hand(tmp_path)
    server = visitors.open_server(0)
    try:
        async with serving(hand, make_library(hand)) as served, anyio.create_task_group() as group:
            app = App(server, None, None, visitors)
            group.start_soon(app.run)
            in_thread = anyio.to_thread.run_sync
            visit = await in_thread(admitted, access.links(server.get_port())[role])
            with await in_thread(contextlib.ExitStack().__enter__) as stack:
                old = await in_thread(stack.enter_context, window(visit))
                await in_thread(controls, old)
                [client] = server.get_clients().values()
                handles = dict(client.gui._gui_input_handle_from_uuid)
                assert len(handles) > 20
                assert await in_thread(send, old, junk(handles, role)) > 1000
                await in_thread(stop, visit)
                await stops(served, 1)
                new = await in_thread(stack.enter_context, window(visit))
                await in_thread(controls, new)
                await in_thread(stop, visit)
                await stops(served, 2)
                assert not served.watcher.goals
            group.cancel_scope.cancel()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def test_a_value_is_admitted_by_the_type_of_its_control() -> None:
    visitors = Visitors(Access())
    server = visitors.open_server(0)
    try:
        gui = server.gui
        cases: list[tuple[viser.GuiInputHandle[Any], list[Any], list[Any]]] = [
            (gui.add_checkbox("a", False), [True, False], [1, "x", None, [True]]),
            (gui.add_text("b", ""), ["", "x"], [1, None, True, "x" * 10**5]),
            (
                gui.add_slider("c", 0.0, 1.02, 0.1, 0.5),
                [0, 0.5, 1.02, 1.1],
                [-0.1, 5, math.nan, math.inf, True, "1"],
            ),
            (gui.add_number("d", 3), [-1, 2.0], [2.5, 1e300, math.nan, True, "1", None]),
            (gui.add_number("g", 3, min=2), [2, 1e9], [1, -1]),
            (gui.add_dropdown("e", ("x", "y")), ["x"], ["z", 1, None, ["x"]]),
            (gui.add_rgb("f", (1, 2, 3)), [[1, 2, 3]], [[1, 2], [1, 2, "x"], 1, [1, 2, math.nan]]),
        ]
        for control, right, wrong in cases:
            for value, admitted in [*((v, True) for v in right), *((v, False) for v in wrong)]:
                updates = {"value": value}
                message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid}
                data = msgspec.msgpack.encode({**message, "updates": updates})
                assert visitors.admits(PageRole.OPERATOR, data) is admitted, (control.label, value)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


@pytest.mark.parametrize("refused", [5.0, math.inf, "x"])
async def test_a_page_whose_number_is_refused_shows_the_number_in_force(refused: object) -> None:
    access = Access()
    visitors = Visitors(access)
    server = visitors.open_server(0)
    in_thread = anyio.to_thread.run_sync
    try:
        slider = server.gui.add_slider("width", 0.0, 1.0, 0.1, 0.5)

        def ask() -> object:
            visit = admitted(access.links(server.get_port())[PageRole.OPERATOR])
            with window(visit) as connection:
                controls(connection, "width")
                update = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid}
                connection.send(msgspec.msgpack.encode({**update, "updates": {"value": refused}}))
                for frame in connection:
                    for message in messages(frame) if isinstance(frame, bytes) else ():
                        if message["type"] == "GuiUpdateMessage":
                            return message["updates"]
                return None

        assert await in_thread(ask) == {"value": 0.5}
        assert slider.value == 0.5
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
