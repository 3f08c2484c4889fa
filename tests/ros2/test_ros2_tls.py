"""A ROS 2 graph over TLS, whose router lets some steer and others only watch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

pytest.importorskip("cryptography", reason="needs the extra secure")

from rtee.errors import NoRouter
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.files import write_together
from rtee.messages.requests import Role
from rtee.remote import authority
from rtee.remote.credentials import IDENTITY_VARIABLE, Credentials, common_name
from rtee.ros2 import Context

from .conftest import free_endpoint, open_router
from .test_ros2_nodes import STRING, TRIGGER, until

pytestmark = pytest.mark.anyio

_ALL = ["put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"]
_ALL += ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
_WATCHING = ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]


def _rule(name: str, flow: str, messages: list[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": messages,
        "key_exprs": ["0/**", "@ros2_lv/0/**"],
    }


def _access(steering: list[str], watching: list[str]) -> dict[str, Any]:
    people = [*steering, *watching]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            _rule("heard", "egress", _ALL),
            _rule("steer", "ingress", _ALL),
            _rule("watch", "ingress", _WATCHING),
        ],
        "subjects": [{"id": one, "cert_common_names": [one]} for one in people],
        "policies": [
            {"rules": ["heard"], "subjects": people},
            {"rules": ["steer"], "subjects": steering},
            {"rules": ["watch"], "subjects": watching},
        ],
    }


async def test_the_router_decides_who_steers_and_who_watches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "secure"
    authority.make_authority(folder, "robot")
    names = {}
    for who in ("hand", "planner", "screen"):
        person, text = authority.add_client(folder, who, Role.OPERATOR)
        names[who] = common_name(person.name)
        write_together({tmp_path / f"{who}.pem": text}, private=True)
    access = _access([names["hand"], names["planner"]], [names["screen"]])
    endpoint = free_endpoint().replace("tcp/", "tls/")
    settings = Ros2Settings(router=endpoint)

    def opened(who: str) -> Any:
        monkeypatch.setenv(IDENTITY_VARIABLE, str(tmp_path / f"{who}.pem"))
        return Context.open(settings, {}, router_needed=True)

    files = Credentials(folder).files()
    secured = {
        "transport__link__tls__root_ca_certificate": files["authority"],
        "transport__link__tls__listen_private_key": files["key"],
        "transport__link__tls__listen_certificate": files["certificate"],
        "transport__link__tls__enable_mtls": True,
    }
    with open_router(endpoint, **secured, access_control=access):
        async with opened("hand") as hand, opened("planner") as planner, opened("screen") as screen:
            trigger = hand.interfaces.service(TRIGGER)

            async def stop(request: Any) -> Any:
                return trigger.response(success=True)

            node = hand.node("hand")
            node.service("~/stop", trigger, stop)
            publisher = node.publisher("/news", STRING)
            client = planner.node("planner").client("/hand/stop", trigger)
            await client.wait(300)
            assert (await client.call(trigger.request(), 20)).success

            got: list[Any] = []
            watching = screen.node("screen")
            watching.subscription("/news", STRING, got.append)
            await until(lambda: publisher.heard)
            publisher.publish(publisher.type.message(data="seen"))
            await until(lambda: bool(got))
            refused = watching.client("/hand/stop", trigger)
            await refused.wait(300)
            with pytest.raises(TimeoutError):
                await refused.call(trigger.request(), 0.5)
            await planner.graph.ready()
            assert "/screen" not in {one.node.full for one in planner.graph.nodes()}

        stranger = tmp_path / "other"
        authority.make_authority(stranger, "robot")
        _, text = authority.add_client(stranger, "planner", Role.OPERATOR)
        write_together({tmp_path / "stranger.pem": text}, private=True)
        with anyio.fail_after(300), pytest.raises(NoRouter):
            async with opened("stranger"):
                pass
