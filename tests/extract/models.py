"""Small hands made of boxes, written as URDF and SRDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rtee.hand.load import load_model
from rtee.hand.model import Hand


@dataclass
class Model:
    """A robot description that grows part by part; the links hang on ``base``."""

    name: str = "model"
    parts: list[str] = field(default_factory=list)
    groups: dict[str, tuple[str, str]] = field(default_factory=dict)
    extra: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.parts.append('<link name="base"/>')

    def link(self, name: str, *shapes: str) -> Model:
        collisions = "".join(f"<collision>{shape}</collision>" for shape in shapes)
        self.parts.append(f'<link name="{name}">{collisions}</link>')
        return self

    def joint(
        self,
        name: str,
        parent: str,
        child: str,
        *,
        kind: str = "revolute",
        xyz: Sequence[float] = (0, 0, 0),
        rpy: Sequence[float] = (0, 0, 0),
        axis: Sequence[float] = (0, 1, 0),
        limits: tuple[float, float] = (0.0, 1.0),
        mimic: str = "",
    ) -> Model:
        bounds = (
            "" if kind in ("continuous", "fixed") else f'lower="{limits[0]}" upper="{limits[1]}"'
        )
        self.parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{_triple(xyz)}" rpy="{_triple(rpy)}"/><axis xyz="{_triple(axis)}"/>'
            f'<limit {bounds} velocity="1" effort="1"/>{mimic}</joint>'
        )
        return self

    def finger(self, name: str, tip: str, base: str = "base") -> Model:
        self.groups[name] = (base, tip)
        return self

    def disable(self, first: str, second: str) -> Model:
        self.extra.append(f'<disable_collisions link1="{first}" link2="{second}" reason="Never"/>')
        return self

    def load(self, folder: Path) -> Hand:
        urdf, srdf = folder / f"{self.name}.urdf", folder / f"{self.name}.srdf"
        urdf.write_text(f'<robot name="{self.name}">{"".join(self.parts)}</robot>')
        chains = "".join(
            f'<group name="{name}"><chain base_link="{base}" tip_link="{tip}"/></group>'
            for name, (base, tip) in self.groups.items()
        )
        members = "".join(f'<group name="{name}"/>' for name in self.groups)
        srdf.write_text(
            f'<robot name="{self.name}">{chains}<group name="end_effector_fingers">{members}'
            f"</group>{''.join(self.extra)}</robot>"
        )
        return load_model(urdf, srdf)


def _triple(values: Sequence[float]) -> str:
    return " ".join(str(value) for value in values)


def box(size: Sequence[float], xyz: Sequence[float] = (0, 0, 0)) -> str:
    return f'<origin xyz="{_triple(xyz)}"/><geometry><box size="{_triple(size)}"/></geometry>'


def sphere(radius: float, xyz: Sequence[float] = (0, 0, 0)) -> str:
    return f'<origin xyz="{_triple(xyz)}"/><geometry><sphere radius="{radius}"/></geometry>'


def mesh(path: Path, xyz: Sequence[float] = (0, 0, 0)) -> str:
    return f'<origin xyz="{_triple(xyz)}"/><geometry><mesh filename="{path}"/></geometry>'


LENGTH = 0.1
WIDTH = 0.02
APART = 0.05

_FINGER = box((0.01, WIDTH, LENGTH), (0, 0, LENGTH / 2))


def planar(
    model: Model, name: str, *, side: float, y: float = 0.0, actuator: str = "", base: str = "base"
) -> Model:
    """Add a finger that flexes in a plane y = const, towards x = 0 from one side of it.

    With an actuator it mimics that one.
    """
    mimic = f'<mimic joint="{actuator}"/>' if actuator else ""
    x = 0.0 if base != "base" else side * APART
    return (
        model.link(name, _FINGER)
        .joint(
            f"{name}_flexion",
            base,
            name,
            xyz=(x, y, 0),
            axis=(0, -side, 0),
            limits=(0.0, 1.2),
            mimic=mimic,
        )
        .finger(name, name)
    )


def figure_3(variant: int) -> Model:
    """Return one of the four planar-fingered hands of the paper's figure 3."""
    model = Model(f"figure_3_{variant}")
    if variant <= 2:
        planar(model, "thumb", side=1)
        return planar(model, "first", side=-1, actuator="thumb_flexion" if variant == 1 else "")
    planar(model, "first", side=-1, y=-0.03)
    planar(model, "second", side=-1, y=0.03)
    if variant == 3:
        return planar(model, "thumb", side=1)
    model.link("swivel").joint(
        "thumb_swivel", "base", "swivel", xyz=(APART, 0, 0), axis=(0, 0, 1), limits=(-0.7, 0.7)
    )
    return planar(model, "thumb", side=1, base="swivel")
