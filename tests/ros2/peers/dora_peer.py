"""A node made with dora-rs, in a process and an environment of its own; it prints JSON.

Usage: dora_peer.py PREFIX SESSION NAME TASK ARGUMENTS…
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable
from typing import Any

import dora
import pyarrow as pa


class WithoutPandas:
    """Finds no pandas, which pyarrow imports for its first array: 1.5 s of processor time."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


sys.meta_path.insert(0, WithoutPandas())

ATTEMPTS = 5
"""Sessions in which to look for a server: now and then, one of dora-rs misses what was in the graph
before it, and another one finds it."""


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


INTEGERS = {"sec": pa.int32(), "nanosec": pa.uint32()}
"""Types of the integers in times: pyarrow takes all for 64 bits, which dora-rs refuses."""


def kind_of(value: Any, name: str = "") -> pa.DataType:
    """Return the Arrow type of a field's value."""
    if isinstance(value, dict):
        return pa.struct([(key, kind_of(one, key)) for key, one in value.items()])
    if isinstance(value, list):
        return pa.list_(kind_of(value[0])) if value else pa.list_(pa.null())
    return INTEGERS.get(name) or pa.scalar(value).type


def array_of(text: str) -> pa.Array:
    """Return the array that stands for a message, of its fields as JSON."""
    fields = json.loads(text)
    return pa.array([fields], kind_of(fields))


def open_context(prefix: str, session: str) -> Any:
    transport = dora.Ros2Transport.zenoh("rep2016", config_uri=session)
    return dora.Ros2Context(ros_paths=[prefix], transport=transport, domain_id=0)


def echo(node: Any, qos: Any, topic: str, kind: str, count: str) -> None:
    """Print when so many messages came, and the first position of each."""
    heard = node.create_subscription(node.create_topic(topic, kind, qos), qos)
    say(ready=True)
    numbers = []
    while len(numbers) < int(count):
        message = heard.next()
        if message is not None:  # nothing came for a while
            numbers.append(message.to_pylist()[0]["position"][0])
    say(numbers=numbers)


def latched(node: Any, _: Any, topic: str, kind: str, field: str) -> None:
    """Print a field of the message that was published before."""
    durability = dora.Ros2Durability.TransientLocal
    qos = dora.Ros2QosPolicies(durability=durability, reliable=True, keep_last=1)
    heard = node.create_subscription(node.create_topic(topic, kind, qos), qos)
    say(ready=True)
    message = None
    while message is None:
        message = heard.next()
    say(field=message.to_pylist()[0][field])


def publish(node: Any, qos: Any, topic: str, kind: str, fields: str) -> None:
    """Publish the same message 20 times a second until killed."""
    publisher = node.create_publisher(node.create_topic(topic, kind, qos), qos)
    say(ready=True)
    while True:
        publisher.publish(array_of(fields))
        time.sleep(0.05)


def call(node: Any, qos: Any, service: str, kind: str, fields: str) -> None:
    client = node.create_service_client(service, kind, qos)
    say(response=client.call(array_of(fields), 5.0).to_pylist()[0])


def serve(node: Any, qos: Any, service: str, kind: str, fields: str) -> None:
    server = node.create_service_server(service, kind, qos)
    say(ready=True)
    while True:
        asked = server.take_request(timeout_s=0.5)
        if asked is not None:
            server.send_response(asked[0], array_of(fields))


def goal(node: Any, qos: Any, action: str, kind: str, fields: str, cancel_after: str) -> None:
    """Send a goal, print its feedback and result; cancel it after so many feedbacks, or never."""
    client = node.create_action_client(action, kind, qos)
    goal_id = client.send_goal(array_of(fields), 20.0)
    say(accepted=goal_id is not None)
    if goal_id is None:
        return
    heard = 0
    while heard < max(int(cancel_after), 1):
        told = client.take_feedback(goal_id, timeout_s=5.0)
        if told is None:
            break
        heard += 1
    if int(cancel_after):  # its result cannot be asked for after that
        say(feedback=heard, cancelled=client.cancel(goal_id, 10.0))
        return
    status, result = client.take_result(goal_id, timeout_s=30.0)
    say(feedback=heard, status=status, result=result.to_pylist()[0])


def act(node: Any, qos: Any, action: str, kind: str, feedback: str, result: str) -> None:
    """Take one goal, tell feedback until it is cancelled or 5 were told, and end it."""
    server = node.create_action_server(action, kind, qos)
    say(ready=True)
    taken = None
    while taken is None:
        taken = server.take_goal(timeout_s=0.5)
    goal_id, asked = taken
    say(goal=asked.to_pylist()[0])
    status = "succeeded"
    for _ in range(5):
        server.send_feedback(goal_id, array_of(feedback))
        if server.take_cancel(timeout_s=0.1):
            status = "canceled"
            break
    server.send_result(goal_id, array_of(result), status, 20.0)


TASKS: dict[str, Callable[..., None]] = {
    one.__name__: one for one in (echo, latched, publish, call, serve, goal, act)
}

if __name__ == "__main__":
    prefix, session, name, task, place, kind, *words = sys.argv[1:]
    kind = "/".join(kind.split("/")[::2])  # dora-rs leaves out whether it is a msg, srv or action
    qos = dora.Ros2QosPolicies(reliable=True, keep_last=10)
    for left in reversed(range(ATTEMPTS)):
        context = open_context(prefix, session)  # its nodes leave the graph when it is dropped
        node = context.new_node(name, "/dora", dora.Ros2NodeOptions(rosout=False))
        try:
            TASKS[task](node, qos, place, kind, *words)
            break
        except RuntimeError as error:
            if not re.search("(readiness|request) timed out", str(error)) or not left:
                raise
