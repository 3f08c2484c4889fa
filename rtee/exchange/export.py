"""Export of a hand's model for other programs; see `rtee export`."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from rtee.errors import ConfigError, ModelError, needing_extra
from rtee.hand.embedded_meshes import with_local_meshes
from rtee.hand.files import read_bytes, write_all
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.hand.srdfwrite import format_srdf
from rtee.hand.transmission import sample

_READ_BY_MUJOCO: Final = (".stl", ".obj")
"""Formats of meshes that MuJoCo reads."""

_COMPILER: Final = {
    # By default, MuJoCo drops fixed links, visual shapes, and the folders of meshes.
    "fusestatic": "false",
    "discardvisual": "false",
    "strippath": "false",
    # MuJoCo refuses lighter moving links, which a kinematic model may have [kg, kg·m²].
    "boundmass": "1e-3",
    "boundinertia": "1e-9",
    # Correct moments of inertia that rounding made impossible, instead of refusing them.
    "balanceinertia": "true",
}
"""MuJoCo's compiler settings in the URDF, which other programs ignore."""


class ExportFormat(StrEnum):
    """A format of export."""

    URDF = "urdf"
    MJCF = "mjcf"
    SRDF = "srdf"


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        files: The files written, including meshes.
        notes: Sentences about properties of the hand that the files represent differently.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]


def export_hand(
    folder: Path, target: Path, kinds: Collection[ExportFormat] = tuple(ExportFormat)
) -> Exported:
    """Write a hand's model into a folder: ``HAND.urdf`` with meshes, ``HAND.xml``, ``HAND.srdf``.

    Args:
        folder: The hand's folder.
        target: Folder to write to; made if needed. Replaces existing files of these names.
        kinds: Formats to write.

    Raises:
        ConfigError: if the files cannot be written, or would replace the hand's own.
        MissingExtra: if MJCF is asked for, and the extra ``sim`` is not installed.
        ModelError: if a mesh is missing, or the hand cannot be simulated.
    """
    if target.resolve() == folder.resolve():
        raise ConfigError("is the hand's own folder; export the hand to another one", path=target)
    hand = load_hand(folder)
    files: dict[Path, str | bytes] = {}
    notes: list[str] = []
    if ExportFormat.URDF in kinds:
        text, meshes, remarks = _urdf(hand)
        files |= {target / place: read_bytes(path, "mesh", ModelError) for place, path in meshes}
        files[target / f"{hand.name}.urdf"] = text
        notes += remarks
    if ExportFormat.MJCF in kinds:
        with needing_extra("exporting MJCF", "sim"):
            from rtee.exchange.mjcf_export import mjcf_of
        text, remarks = mjcf_of(hand)
        files[target / f"{hand.name}.xml"] = text
        notes += remarks
    if ExportFormat.SRDF in kinds:
        files[target / f"{hand.name}.srdf"] = format_srdf(hand, hand.disabled_collisions)
    # Only now, so that a refused format does not leave part of an export behind.
    write_all(files, folders=[target])
    return Exported(tuple(files), tuple(notes))


def _urdf(hand: Hand) -> tuple[str, list[tuple[str, Path]], list[str]]:
    """Return a hand's URDF, its meshes with their paths relative to it, and notes."""
    local = with_local_meshes(hand)
    notes = list(local.notes)
    root = _parsed(local.text)
    for element in root.iterfind("joint"):
        name = element.get("name", "")
        _drop_repeated(element)
        mimic = element.find("mimic")
        if mimic is not None and mimic.get("nlFunPos") is not None:
            notes += _straighten(hand, name, mimic)
        elif name in hand.actuator_names:
            notes += _limit(hand, name, element)
    _tell_mujoco(root)
    others = [place for place in local.meshes if not place.lower().endswith(_READ_BY_MUJOCO)]
    if others:
        notes.append(f"MuJoCo cannot read {len(others)} of the URDF's meshes, such as {others[0]}")
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n{text}\n', list(local.meshes.items()), notes


def _parsed(text: str) -> ElementTree.Element:
    """Return the root of a valid URDF's text, with comments and prefixes."""
    # ElementTree's own parser refuses undeclared prefixes, as in older plugins of Gazebo.
    parser, builder = expat.ParserCreate(), ElementTree.TreeBuilder(insert_comments=True)
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler, parser.CommentHandler = builder.data, builder.comment
    parser.Parse(text, True)
    return builder.close()


def _drop_repeated(joint: ElementTree.Element) -> None:
    """Keep only the first of repeated elements, as rtee reads them; MuJoCo refuses repetitions."""
    seen: set[str] = set()
    # A copy of the list, since the loop removes children.
    for child in list(joint):
        if isinstance(child.tag, str) and child.tag in seen:
            joint.remove(child)
        elif isinstance(child.tag, str):  # the tag of a comment is a function
            seen.add(child.tag)


def _straighten(hand: Hand, joint: str, mimic: ElementTree.Element) -> list[str]:
    """Replace a follower's expression by its best linear fit, for other programs."""
    couplings = hand.transmission.couplings
    coupling = couplings[hand.joint_index(joint)]
    master = couplings[hand.joint_index(mimic.get("joint", "").strip())]
    if coupling.actuator is None:
        return []
    actuator = hand.actuators[coupling.actuator]
    at = sample(actuator.lower, actuator.upper)
    x = np.array([master.value(u) for u in at])
    y = np.array([coupling.value(u) for u in at])
    # About its mean, so that a fixed master gives a constant instead of a division by zero.
    spread = float(np.sum((x - x.mean()) ** 2))
    slope = float(np.sum((x - x.mean()) * (y - y.mean()))) / spread if spread > 0.0 else 0.0
    offset = float(y.mean() - slope * x.mean())
    mimic.set("multiplier", repr(slope))
    mimic.set("offset", repr(offset))
    error = float(np.abs(slope * x + offset - y).max())
    return [
        f"joint '{joint}' follows '{mimic.get('joint')}' by nlFunPos; programs that do not know "
        f"nlFunPos use the closest line, which is up to {error:.2g} off"
    ]


def _limit(hand: Hand, name: str, element: ElementTree.Element) -> list[str]:
    """Give an actuator its limits, including those of hand.yaml; return notes."""
    limit, spec, before = element.find("limit"), hand.actuator(name), hand.urdf.joints[name]
    notes = []
    if before.kind == "continuous":
        ends = math.isfinite(spec.lower) + math.isfinite(spec.upper)
        if ends == 2:
            # Readers ignore the limits of a continuous joint.
            element.set("type", "revolute")
        elif ends == 1:
            notes.append(
                f"joint '{name}' has only one limit; a URDF needs both, so it has none there"
            )
        if limit is None and ends == 2:
            limit = ElementTree.SubElement(element, "limit", effort="0", velocity="0")
    if limit is None:
        return notes
    for attribute, value, old in (
        ("lower", spec.lower, before.lower),
        ("upper", spec.upper, before.upper),
        ("velocity", spec.velocity, before.velocity),
        ("effort", spec.effort, before.effort),
    ):
        if value != old and math.isfinite(value):
            limit.set(attribute, repr(float(value)))
    return notes


def _tell_mujoco(root: ElementTree.Element) -> None:
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    for attribute, value in _COMPILER.items():
        # These are defaults: settings in the URDF take precedence.
        compiler.set(attribute, compiler.get(attribute, value))
