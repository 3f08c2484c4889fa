"""Access control for a hand, which Zenoh enforces before it delivers a message.

Everything is denied by default. Only the hand may answer queries, publish states, results and
events, and declare that it is alive. No client sees the requests of others. Each client may send
the requests that its role allows, and receive the topics published for its certificate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rtee.messages import network_key
from rtee.messages.requests import (
    ALIVE,
    ANSWERS,
    CLAIMS,
    CLIENTS,
    HELLO,
    HERE,
    INBOX,
    PLAIN,
    REQUESTS,
    SAMPLE,
    STATES,
    Role,
    topic_for,
)
from rtee.messages.topics import PUBLISHED
from rtee.remote.session import LOCAL

_MESSAGES = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
"""All types of message that Zenoh controls."""

_UNPROTECTED = ("tcp", "udp", "quic", "ws", "serial", "unixpipe", "vsock")
"""Protocols that admit anybody who reaches the endpoint."""

_HELLOS = 25.0
"""Most often that a session may say hello to a hand [1/s]: a client says it once, and repeats it
after 0.05 s if it came too fast."""

_ROUTER = "router"
"""Subject of a router that a hand connects to, whose certificate the hand has checked."""


def access_control(
    hand: str, people: Mapping[str, Role], *, plain: bool, routed: bool = False
) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` for a hand.

    Roles are assigned by common name to the certificates that are, or may later be, admitted. Their
    clients come through the hand's door (`gate_access_control`), and so through its Unix socket, or
    if ``routed`` through a router that has judged them (`router_access_control`); with ``plain``,
    clients without certificates are admitted.
    """
    subjects: dict[str, Mapping[str, Role]] = {HERE: {HERE: Role.MAINTAINER}}
    if routed:
        subjects[_ROUTER] = people
    else:
        subjects[HERE] = {HERE: Role.MAINTAINER, **people}
    if plain:
        subjects[PLAIN] = {PLAIN: Role.MAINTAINER}
    return _allowed(hand, subjects)


def router_access_control(people: Mapping[str, Role], hands: Mapping[str, str]) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` for the router of a site.

    Args:
        people: Roles by common name of the certificates of people, with any hand.
        hands: Hands by common name of their certificates. Each acts for itself only.
    """
    settings = _allowed("*", {name: {name: role} for name, role in people.items()})
    for name, hand in hands.items():
        settings["rules"].append(_all(hand, network_key(hand, "**")))
        settings["subjects"].append(_subject(name))
        settings["policies"].append({"rules": [hand], "subjects": [name]})
    return settings


def gate_access_control(hand: str, zid: str, name: str, role: Role) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` for the gateway of one certificate to a hand.

    Args:
        hand: The hand.
        zid: Identifier of its session of Zenoh.
        name: Common name of the certificate.
        role: Its role.
    """
    settings = _allowed(hand, {HERE: {name: role}})
    settings["rules"].append(_all("all", "**"))
    # The hand itself, and messages to it, which were checked when they arrived.
    settings["subjects"].append({"id": "hand", "zids": [zid]})
    settings["policies"].append({"rules": ["all"], "subjects": ["hand"]})
    return settings


def hello_limit(hand: str) -> list[dict[str, Any]]:
    """Return Zenoh's ``downsampling``, which limits how often a session may say hello to a hand.

    Messages beyond the limit are dropped on arrival: the hand has a single thread that receives for
    all its clients.
    """
    hello = {"key_expr": network_key(hand, f"{HELLO}/**"), "freq": _HELLOS}
    return [{"id": HELLO, "flows": ["ingress"], "messages": ["query"], "rules": [hello]}]


def _all(name: str, keys: str) -> dict[str, Any]:
    """Return the rule that allows all messages on some keys."""
    return {
        "id": name,
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": list(_MESSAGES),
        "key_exprs": [keys],
    }


def _allowed(hand: str, subjects: Mapping[str, Mapping[str, Role]]) -> dict[str, Any]:
    """Return ``access_control`` that gives each subject a role on some access paths."""
    paths = {path: role for allowed in subjects.values() for path, role in allowed.items()}
    common = [*_announcements(hand), *_presence(hand)]
    own = {
        path: [*_requests(hand, role, path), *_topics(hand, path)] for path, role in paths.items()
    }
    policies = [{"rules": [rule["id"] for rule in common], "subjects": list(subjects)}]
    policies += [
        {
            "rules": [rule["id"] for path in allowed for rule in own[path]],
            "subjects": [subject],
        }
        for subject, allowed in subjects.items()
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*common, *(rule for rules in own.values() for rule in rules)],
        "subjects": [_subject(subject) for subject in subjects],
        "policies": policies,
    }


def _subject(path: str) -> dict[str, Any]:
    if path == HERE:
        return {"id": path, "link_protocols": [LOCAL]}
    if path == PLAIN:
        return {"id": path, "link_protocols": list(_UNPROTECTED)}
    if path == _ROUTER:  # a hand itself has no other links with TLS
        return {"id": path, "link_protocols": ["tls"]}
    return {"id": path, "link_protocols": ["tls"], "cert_common_names": [path]}


def _rule(
    name: str, flow: str, messages: Iterable[str], hand: str, keys: Iterable[str]
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": [network_key(hand, key) for key in keys],
    }


def _announcements(hand: str) -> Iterable[dict[str, Any]]:
    """Return the rules for messages of the hand to all admitted clients."""
    groups = sorted({request.group for request in REQUESTS.values()})
    yield _rule(
        "answer", "egress", ["reply", "declare_queryable"], hand, [f"{g}/*" for g in groups]
    )
    yield _rule("alive", "egress", ["liveliness_token"], hand, [ALIVE, f"{CLAIMS}/*"])


def _presence(hand: str) -> Iterable[dict[str, Any]]:
    """Return the rules for all admitted clients."""
    yield _rule("token", "ingress", ["liveliness_token"], hand, [f"{CLIENTS}/*"])
    # A router passes on only the tokens that a client queried.
    yield _rule("tokens", "egress", ["declare_liveliness_subscriber"], hand, [f"{CLIENTS}/*"])
    find = _rule(
        "find", "ingress", ["liveliness_query", "declare_liveliness_subscriber"], hand, [ALIVE]
    )
    find["key_exprs"].append(network_key("*", ALIVE))  # for clients that don't know the name
    yield find


def _topics(hand: str, path: str) -> Iterable[dict[str, Any]]:
    """Return the rules for the topics that clients of an access path may receive."""
    topics = [topic_for(path, "**")]
    if topics == ["**"]:  # clients without a certificate share the hand's own keys
        topics = [*sorted(PUBLISHED), f"{STATES}/*", f"{ANSWERS}/*"]
    yield _rule(f"publish {path}", "egress", ["put"], hand, topics)
    yield _rule(f"watch {path}", "ingress", ["declare_subscriber"], hand, topics)
    # A client's publisher waits until it sees the hand's subscriber.
    yield _rule(
        f"receive {path}",
        "egress",
        ["declare_subscriber"],
        hand,
        [f"{INBOX}/{path}/**"],
    )


def _requests(hand: str, role: Role, path: str) -> Iterable[dict[str, Any]]:
    """Return the rules for the requests that clients of an access path may send, and for hello."""
    allowed = [
        request for request in REQUESTS.values() if request.group != HELLO and request.role <= role
    ]
    # The access path is part of the key: a client cannot say hello with another's certificate.
    names = [f"{request.group}/{request.name}" for request in allowed]
    if role is max(Role):  # a client that may send all requests is told which exist
        names = [f"{group}/*" for group in sorted({request.group for request in allowed})]
    keys = [f"{HELLO}/{path}", *names]
    yield _rule(f"{role.name.lower()} {path}", "ingress", ["query"], hand, keys)
    if REQUESTS[SAMPLE] in allowed:
        yield _rule(f"put {path}", "ingress", ["put"], hand, [f"{INBOX}/{path}/{SAMPLE}/*"])
