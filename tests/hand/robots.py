"""Robots as people describe them: grippers, hands on arms, linkages; written as URDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

Numbers = Sequence[float]


def box(x: float, y: float, z: float, at: Numbers = (0, 0, 0)) -> str:
    """Return a box with these edges [m]."""
    return _shape(f'<box size="{x} {y} {z}"/>', at)


def sphere(radius: float, at: Numbers = (0, 0, 0)) -> str:
    return _shape(f'<sphere radius="{radius}"/>', at)


def _shape(geometry: str, at: Numbers) -> str:
    return f'<origin xyz="{_text(at)}"/><geometry>{geometry}</geometry>'


def _text(values: Numbers) -> str:
    return " ".join(f"{value:.12g}" for value in values)


@dataclass
class Robot:
    """A robot description that grows part by part; names get the prefix of the part."""

    name: str = "robot"
    parts: list[str] = field(default_factory=list)

    def link(self, name: str, *shapes: str, inside: str = "", seen: bool = True) -> Robot:
        """Add a link with collision shapes; ``inside``: further elements."""
        bodies = "".join(f"<collision>{shape}</collision>" for shape in shapes)
        bodies += "".join(f"<visual>{shape}</visual>" for shape in shapes if seen)
        self.parts.append(f'<link name="{name}">{bodies}{inside}</link>')
        return self

    def joint(
        self,
        name: str,
        parent: str,
        child: str,
        at: Numbers = (0, 0, 0),
        axis: Numbers = (0, 1, 0),
        limits: tuple[float, float] | None = (0.0, 0.9),
        *,
        kind: str = "revolute",
        rpy: Numbers = (0, 0, 0),
        mimic: str = "",
        inside: str = "",
    ) -> Robot:
        """Add a moving joint; ``mimic``: the joint it follows, with a factor after a blank."""
        master, _, factor = mimic.partition(" ")
        follows = f'<mimic joint="{master}" multiplier="{factor or 1}"/>' if mimic else ""
        bounds = "" if limits is None else f'lower="{limits[0]:.12g}" upper="{limits[1]:.12g}" '
        self.parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{_text(at)}" rpy="{_text(rpy)}"/><axis xyz="{_text(axis)}"/>'
            f'<limit {bounds}effort="5" velocity="2"/>{follows}{inside}</joint>'
        )
        return self

    def weld(
        self, parent: str, child: str, at: Numbers = (0, 0, 0), rpy: Numbers = (0, 0, 0)
    ) -> Robot:
        self.parts.append(
            f'<joint name="{child}_weld" type="fixed"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{_text(at)}" rpy="{_text(rpy)}"/></joint>'
        )
        return self

    @property
    def text(self) -> str:
        return f'<robot name="{self.name}">\n' + "\n".join(self.parts) + "\n</robot>\n"

    def write(self, folder: Path) -> Path:
        """Write the URDF into a folder."""
        path = folder / f"{self.name}.urdf"
        path.write_text(self.text, encoding="utf-8")
        return path


PALM = box(0.08, 0.06, 0.02)
JAW = box(0.012, 0.015, 0.05, (0, 0, 0.025))


def jaws(robot: Robot | None = None, prefix: str = "", base: str = "base") -> Robot:
    """Add two jaws that turn towards each other on a palm, 48 mm apart at rest."""
    robot = robot or Robot("jaws")
    robot.link(prefix + base, PALM)
    for side, x in (("left", -0.03), ("right", 0.03)):
        robot.link(f"{prefix}{side}_distal", JAW)
        robot.joint(
            f"{prefix}{side}_joint", prefix + base, f"{prefix}{side}_distal", (x, 0, 0.01),
            (0, -x / 0.03, 0),
        )  # fmt: skip
    return robot


def linkage(robot: Robot | None = None, prefix: str = "", *, inner: bool = True) -> Robot:
    """Add a parallel gripper of outer knuckles with fingertips, and inner knuckles as bars."""
    robot = robot or Robot("linkage")
    master = f"{prefix}left_knuckle_joint"
    robot.link(f"{prefix}base", box(0.06, 0.05, 0.03))
    for side, s in (("left", -1.0), ("right", 1.0)):
        name, axis = prefix + side, (0, -s, 0)
        follows = "" if side == "left" else master
        robot.link(f"{name}_knuckle", box(0.012, 0.02, 0.03, (0.01 * s, 0, 0.015)))
        robot.joint(
            f"{name}_knuckle_joint", f"{prefix}base", f"{name}_knuckle", (0.03 * s, 0, 0.015),
            axis, (0, 0.7), mimic=follows,
        )  # fmt: skip
        if inner:
            robot.link(f"{name}_inner_knuckle", box(0.008, 0.02, 0.04, (0, 0, 0.02)))
            robot.joint(
                f"{name}_inner_knuckle_joint", f"{prefix}base", f"{name}_inner_knuckle",
                (0.012 * s, 0, 0.02), axis, (0, 0.7), mimic=master,
            )  # fmt: skip
        robot.link(f"{name}_finger_tip", box(0.012, 0.02, 0.045, (0, 0, 0.0225)))
        robot.joint(
            f"{name}_finger_tip_joint", f"{name}_knuckle", f"{name}_finger_tip",
            (0.01 * s, 0, 0.04), axis, (-0.7, 0), mimic=f"{master} -1",
        )  # fmt: skip
    return robot


def fingers(robot: Robot, names: Sequence[str], base: str = "palm", prefix: str = "") -> Robot:
    """Add a palm with a thumb and fingers of two joints each, side by side opposite the thumb."""
    robot.link(prefix + base, box(0.08, 0.09, 0.02))
    others = [name for name in names if name != "thumb"]
    for name in names:
        thumb = name == "thumb"
        y = 0.0 if thumb else 0.022 * (others.index(name) - (len(others) - 1) / 2.0)
        x, axis = (-0.03, (0, 1, 0)) if thumb else (0.03, (0, -1, 0))
        full, above = prefix + name, prefix + base
        for part, at in (("proximal", (x, y, 0.01)), ("distal", (0, 0, 0.03))):
            robot.link(f"{full}_{part}", box(0.012, 0.015, 0.028, (0, 0, 0.015)))
            robot.joint(f"{full}_{part}_joint", above, f"{full}_{part}", at, axis, (0, 0.8))
            above = f"{full}_{part}"
    return robot


ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


def arm(robot: Robot, base: str, prefix: str = "", joints: Sequence[str] = ARM) -> str:
    """Add an arm's links and joints to ``base``; return its last link."""
    above, at = base, (0.0, 0.0, 0.03)
    for number, name in enumerate(joints):
        link, axis = (
            f"{prefix}arm_link_{number + 1}",
            (0, int(number % 3 != 0), int(number % 3 == 0)),
        )
        robot.link(link, box(0.03, 0.03, 0.08, (0, 0, 0.05)))
        robot.joint(prefix + name, above, link, at, axis, (-1.5, 1.5))
        above, at = link, (0.0, 0.0, 0.1)
    return above
