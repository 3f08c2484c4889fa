"""The service ``~/get_type_description``, which describes a type of a node to other nodes."""

from __future__ import annotations

from typing import Any

from rtee.errors import MessageError
from rtee.messages.schema import full_name
from rtee.ros2.hashes import referred
from rtee.ros2.message import Message
from rtee.ros2.node import Node

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
