"""A node made with zenoh-ros2-sdk, in a process and an environment of its own; it prints JSON.

Usage: sdk_peer.py DEFINITIONS PORT TASK ARGUMENTS…
"""

from __future__ import annotations

import json
import queue
import sys
import time
from typing import Any

import zenoh_ros2_sdk as sdk
from zenoh_ros2_sdk.message_registry import get_registry


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


def echo(place: dict[str, Any], topic: str, kind: str, count: str) -> None:
    """Print when so many messages came, and the first position of each."""
    heard: queue.SimpleQueue[Any] = queue.SimpleQueue()
    sdk.ROS2Subscriber(topic, kind, heard.put, **place)
    say(ready=True)
    say(numbers=[float(heard.get(timeout=30).position[0]) for _ in range(int(count))])


def publish(place: dict[str, Any], topic: str, kind: str, fields: str) -> None:
    """Publish the same message 20 times a second until killed."""
    publisher = sdk.ROS2Publisher(topic, kind, **place)
    say(ready=True)
    while True:
        publisher.publish(**json.loads(fields))
        time.sleep(0.05)


def call(place: dict[str, Any], service: str, kind: str, fields: str) -> None:
    client = sdk.ROS2ServiceClient(service, kind, timeout=20.0, **place)
    response = client.call(**json.loads(fields))
    say(response={"success": response.success, "message": response.message})


def serve(place: dict[str, Any], service: str, kind: str, fields: str) -> None:
    server = sdk.ROS2ServiceServer(service, kind, mode="queue", **place)
    say(ready=True)
    while True:
        key, _ = server.take_request()
        server.send_response(key, server.response_msg_class(**json.loads(fields)))


if __name__ == "__main__":
    definitions, port, task, *words = sys.argv[1:]
    get_registry(definitions)  # else it fetches them from the network
    place = {"router_ip": "127.0.0.1", "router_port": int(port)}
    {"echo": echo, "publish": publish, "call": call, "serve": serve}[task](place, *words)
