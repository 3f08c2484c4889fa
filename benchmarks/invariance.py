"""Test whether the extraction depends on how a model is written; print Markdown.

    python benchmarks/invariance.py [--hands schunk_svh some/hand.urdf …] [--jobs 0] [--every]

Of each hand, twenty files are written that mean the same: elements of the URDF and the SRDF in
other orders, other names, the base turned, moved or mounted on an arm, mirror images, half and
twice the size with the clearance scaled, too. Each is extracted. Per pinch, those of several
fingers too, the depths of the executed and of the deepest posture are compared with those of the
original, at its scale. Printed is what differs by more than 0.5 % or in being clear, and per hand
the worst share.
"""

from __future__ import annotations

import math
import random
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from common import HELP, Table, command_line

from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.config import HandConfig
from rtee.hand.config_schema import ActuatorLimits
from rtee.hand.limits import Overrides
from rtee.hand.load import build_hand, load_configured, load_model
from rtee.hand.meshes import resolve_mesh
from rtee.hand.model import Hand, JointRole
from rtee.hand.srdf import read_srdf
from rtee.hand.urdfread import read_urdf
from rtee.types import JointKind

HANDS = ("robotiq_2f_85", "robotiq_3f", "heri_ii", "schunk_svh", "allegro", "leap_hand")
SAME = 0.005
"""Largest difference of depths that count as the same, as a share."""

NOTHING = 1e-5
"""Depths that differ by less are the same in any case [m]."""


@dataclass
class Model:
    """A hand's files, as they are changed.

    Attributes:
        hand: The hand as given.
        urdf: The URDF.
        srdf: The SRDF.
        scale: Size of the changed hand, relative to the given one.
        names: New names of links and joints, where they change.
        fingers: New names of fingers, where they change.
    """

    hand: Hand
    urdf: ET.Element
    srdf: ET.Element
    scale: float = 1.0
    names: dict[str, str] = field(default_factory=dict)
    fingers: dict[str, str] = field(default_factory=dict)

    def load(self, folder: Path) -> Hand:
        """Write the files and load the hand."""
        for name, element in (("urdf", self.urdf), ("srdf", self.srdf)):
            (folder / f"hand.{name}").write_bytes(ET.tostring(element))
        given = self.hand
        rest, limits = {}, {}
        for spec in given.actuators:
            factor = self.scale if spec.kind is JointKind.PRISMATIC else 1.0
            name = self.names.get(spec.name, spec.name)
            rest[name] = spec.rest * factor
            # Those of hand.yaml may be narrower than the URDF's.
            if math.isfinite(spec.lower) and math.isfinite(spec.upper):
                limits[name] = ActuatorLimits(lower=spec.lower * factor, upper=spec.upper * factor)
        ignored = [j.name for j in given.joints if j.role is JointRole.IGNORED]
        overrides = Overrides(
            HandConfig(
                name="variation",
                urdf="hand.urdf",
                rest=rest,
                limits=limits,
                ignore=[self.names.get(name, name) for name in ignored],
                clearance=given.clearance * self.scale,
            ),
            name="variation",
            package_dirs=given.package_dirs,
        )
        return build_hand(
            read_urdf(folder / "hand.urdf"), read_srdf(folder / "hand.srdf"), overrides
        )


def read(hand: Hand, srdf: Path | None) -> Model:
    """Return the files of a hand, with absolute addresses of meshes."""
    urdf = ET.fromstring(hand.urdf.text)
    for mesh in urdf.iter("mesh"):
        found = resolve_mesh(mesh.get("filename", ""), hand.urdf.path, hand.package_dirs)
        mesh.set("filename", f"file://{found.resolve()}")
    for link in urdf.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    if srdf is not None:
        return Model(hand, urdf, ET.fromstring(srdf.read_text()))
    # Fingers found in the tree, written down as they would be in an SRDF.
    root = ET.Element("robot", name=hand.name)
    for finger in hand.fingers:
        group = ET.SubElement(root, "group", name=finger.name)
        ET.SubElement(group, "chain", base_link=finger.base, tip_link=finger.links[-1])
    group = ET.SubElement(root, "group", name="end_effector_fingers")
    for finger in hand.fingers:
        ET.SubElement(group, "group", name=finger.name)
    return Model(hand, urdf, root)


Change = Callable[[Model], None]


def reordered(seed: int | None, *, urdf: bool = True, srdf: bool = True) -> Change:
    """Return a change that reverses the order of elements, or shuffles it with a seed."""

    def change(model: Model) -> None:
        parts = [model.urdf] * urdf + [*model.srdf.iter()] * srdf
        for element in parts:
            children = list(element)
            if seed is None:
                children.reverse()
            else:
                random.Random(seed).shuffle(children)
            element[:] = children

    return change


def first_last(model: Model) -> None:
    """Move the first joint that moves to the end of the URDF."""
    joint = next(j for j in model.urdf.findall("joint") if j.get("type") != "fixed")
    model.urdf.remove(joint)
    model.urdf.append(joint)


def renamed(prefix: str, *, fingers: bool) -> Change:
    """Return a change of the names of links, joints and, if so wanted, fingers."""

    def change(model: Model) -> None:
        elements = [e for e in model.urdf if e.tag in ("link", "joint")]
        # Numbers in an order that has nothing to do with that of the elements.
        numbers = list(range(len(elements)))
        random.Random(len(elements)).shuffle(numbers)
        for number, element in zip(numbers, elements, strict=True):
            model.names[element.get("name", "")] = f"{prefix}{number}"
        own = {finger.name for finger in model.hand.fingers}
        if fingers:
            order = sorted(own)
            random.Random(1).shuffle(order)
            model.fingers = {name: f"{prefix}_f{i}" for i, name in enumerate(order)}
        for element in model.urdf.iter():
            for key in ("name", "link", "joint"):
                if element.tag in ("link", "joint", "parent", "child", "mimic"):
                    old = element.get(key)
                    if old in model.names:
                        element.set(key, model.names[old])
        for element in model.srdf.iter():
            for key in ("base_link", "tip_link", "link1", "link2", "parent_link", "name"):
                old = element.get(key, "")
                if element.tag == "group" or (key == "name" and element.tag == "end_effector"):
                    if old in model.fingers:
                        element.set(key, model.fingers[old])
                elif old in model.names and (key != "name" or element.tag != "group_state"):
                    element.set(key, model.names[old])

    return change


def based(
    xyz: Sequence[float], rpy: Sequence[float], *, arm: bool = False, slack: bool = False
) -> Change:
    """Return a change that hangs the hand on a new root, or on an arm of solid links."""

    def change(model: Model) -> None:
        root = model.hand.urdf.root
        new = ET.SubElement(model.urdf, "link", name="stand")
        if arm:
            collision = ET.SubElement(new, "collision")
            ET.SubElement(collision, "origin", xyz=_text([-x for x in xyz]))
            geometry = ET.SubElement(collision, "geometry")
            ET.SubElement(geometry, "box", size=_text([0.05 * model.scale] * 3))
        joint = ET.SubElement(
            model.urdf, "joint", name="stands", type="revolute" if slack else "fixed"
        )
        ET.SubElement(joint, "parent", link="stand")
        ET.SubElement(joint, "child", link=model.names.get(root, root))
        ET.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))
        if slack:
            ET.SubElement(joint, "axis", xyz="0 0 1")
            ET.SubElement(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
            ET.SubElement(model.srdf, "passive_joint", name="stands")

    return change


def mirrored(axis: int) -> Change:
    """Return a change to the mirror image in the plane across an axis."""

    def change(model: Model) -> None:
        arrow = [-1.0 if i == axis else 1.0 for i in range(3)]
        turn = [-sign for sign in arrow]
        for joint in model.urdf.iter("joint"):
            # The axis of a rotation is no arrow: its other components are reversed.
            slides = joint.get("type") == "prismatic"
            for element in joint.findall("axis"):
                _multiply(element, "xyz", arrow if slides else turn)
            if joint.find("axis") is None and joint.get("type") in ("revolute", "continuous"):
                ET.SubElement(joint, "axis", xyz=_text([turn[0], 0, 0]))
        for element in model.urdf.iter("origin"):
            _multiply(element, "xyz", arrow)
            if element.get("rpy"):
                _multiply(element, "rpy", turn)
        for mesh in model.urdf.iter("mesh"):
            mesh.set("scale", mesh.get("scale", "1 1 1"))
            _multiply(mesh, "scale", arrow)

    return change


def scaled(factor: float) -> Change:
    """Return a change of all lengths."""

    def change(model: Model) -> None:
        model.scale *= factor
        for element in model.urdf.iter("origin"):
            if element.get("xyz"):
                _multiply(element, "xyz", [factor] * 3)
        for name, key in (
            ("box", "size"),
            ("sphere", "radius"),
            ("cylinder", "radius"),
            ("cylinder", "length"),
        ):
            for element in model.urdf.iter(name):
                _multiply(element, key, [factor] * 3)
        for mesh in model.urdf.iter("mesh"):
            mesh.set("scale", mesh.get("scale", "1 1 1"))
            _multiply(mesh, "scale", [factor] * 3)
        kinds = {joint.get("name"): joint.get("type") for joint in model.urdf.iter("joint")}
        for joint in model.urdf.iter("joint"):
            slides = joint.get("type") == "prismatic"
            for limit in joint.findall("limit"):
                for key in ("lower", "upper"):
                    if slides and limit.get(key):
                        _multiply(limit, key, [factor])
            for mimic in joint.findall("mimic"):
                ours = factor if slides else 1.0
                theirs = factor if kinds.get(mimic.get("joint")) == "prismatic" else 1.0
                mimic.set("multiplier", mimic.get("multiplier", "1"))
                _multiply(mimic, "multiplier", [ours / theirs])
                if mimic.get("offset"):
                    _multiply(mimic, "offset", [ours])

    return change


def _multiply(element: ET.Element, key: str, factors: Sequence[float]) -> None:
    values = [float(value) for value in element.get(key, "0 0 0").split()]
    products = [a * b for a, b in zip(values, factors, strict=False)]
    element.set(key, _text(products))


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


VARIATIONS: dict[str, tuple[Change, ...]] = {
    "URDF reversed": (reordered(None, srdf=False),),
    "URDF shuffled": (reordered(1, srdf=False),),
    "URDF shuffled again": (reordered(2, srdf=False),),
    "one joint last": (first_last,),
    "SRDF reversed": (reordered(None, urdf=False),),
    "SRDF shuffled": (reordered(1, urdf=False),),
    "all shuffled": (reordered(3),),
    "links renamed": (renamed("a", fingers=False),),
    "all renamed": (renamed("zz", fingers=True),),
    "base turned": (based((0.0, 0.0, 0.0), (0.3, 0.5, 0.7)),),
    "base turned over": (based((0.0, 0.0, 0.0), (math.pi / 2, 0.0, math.pi)),),
    "base moved": (based((0.3, -0.2, 1.1), (0.0, 0.0, 0.0)),),
    "on an arm": (based((0.1, 0.2, 0.7), (0.2, -0.4, 1.0), arm=True),),
    "on a slack joint": (based((0.0, 0.1, 0.5), (1.0, 0.2, 0.0), arm=True, slack=True),),
    "mirrored in y": (mirrored(1),),
    "mirrored in x": (mirrored(0),),
    "half the size": (scaled(0.5),),
    "twice the size": (scaled(2.0),),
    "three times, shuffled": (scaled(3.0), reordered(4)),
    "all at once": (
        scaled(0.5),
        mirrored(1),
        reordered(5),
        renamed("q", fingers=True),
        based((0.1, 0.0, 0.4), (0.9, 0.1, -0.5)),
    ),
}
"""Twenty ways to write the same hand."""


def variation(hand: Hand, srdf: Path | None, name: str, folder: Path) -> tuple[Model, Hand]:
    """Return a changed model of a hand, loaded from files in a folder."""
    model = read(hand, srdf)
    for change in VARIATIONS[name]:
        change(model)
    return model, model.load(folder)


Pinches = dict[frozenset[str], Primitive]


def pinches(hand: Hand, jobs: int, names: dict[str, str] | None = None) -> Pinches:
    """Return the pinches of a hand by the original names of their fingers."""
    back = {new: old for old, new in (names or {}).items()}
    return {
        frozenset(back.get(f, f) for f in p.elements): p
        for p in extract(hand, jobs=jobs).primitives
        if p.evidence
    }


def sizes(pinch: Primitive) -> tuple[float, float]:
    """Return the depths, or minus the distances, of the executed and the deepest posture [m]."""
    gaps = [e.depth - e.distance for e in pinch.evidence]
    return gaps[0], max(gaps)


def differences(before: Pinches, after: Pinches, scale: float) -> dict[frozenset[str], str]:
    """Return what differs between the pinches of a hand and those of another model of it."""
    found = {}
    for fingers in before.keys() | after.keys():
        if fingers not in before or fingers not in after:
            found[fingers] = "missing" if fingers in before else "new"
            continue
        one, other = before[fingers], after[fingers]
        told = [
            f"{what} {1e3 * a:.3f} -> {1e3 * b / scale:.3f} mm"
            for what, a, b in zip(("executed", "deepest"), sizes(one), sizes(other), strict=True)
            if abs(b / scale - a) > max(NOTHING, SAME * abs(a))
        ]
        flags = [(p.kind, p.evidence[0].clear, p.evidence[0].path_clear) for p in (one, other)]
        if flags[0] != flags[1]:
            told.append(f"{flags[0]} -> {flags[1]}")
        if told:
            found[fingers] = ", ".join(told)
    return found


def loaded(name: str) -> tuple[Hand, Path | None]:
    """Return a hand by its name or its URDF, and its SRDF."""
    if name.endswith(".urdf"):
        srdf = Path(name).with_suffix(".srdf")
        return load_model(name, srdf if srdf.exists() else None), srdf if srdf.exists() else None
    hand, config = load_configured(name)
    folder = hand.urdf.path.parent
    return hand, None if config.srdf is None else folder / config.srdf


def main(arguments: Sequence[str]) -> None:
    parser = command_line(__doc__, jobs=0, every=False)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help=HELP["hands"])
    given = parser.parse_args(arguments)
    table = Table("hand", "variation", "fingers", "what differs")
    for name in given.hands:
        hand, srdf = loaded(name)
        original, count, differing = pinches(hand, given.jobs), 0, 0
        for title in VARIATIONS:
            with tempfile.TemporaryDirectory() as folder:
                model, changed = variation(hand, srdf, title, Path(folder))
                found = pinches(changed, given.jobs, model.fingers)
            different = differences(original, found, model.scale)
            count, differing = count + len(original), differing + len(different)
            if given.every and not different:
                table.row(hand.name, title, "", "nothing")
            for fingers, what in sorted(different.items(), key=lambda item: sorted(item[0])):
                table.row(hand.name, title, ", ".join(sorted(fingers)), what)
        table.row(hand.name, "**all**", "", f"**{differing} of {count}**")


if __name__ == "__main__":
    main(sys.argv[1:])
