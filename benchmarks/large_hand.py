"""A hand with 24 actuators, laid out as tendon-driven anthropomorphic hands are.

Two wrist joints, four joints in each of three fingers, five in the little finger (its metacarpal
moves, too) and five in the thumb. All shapes are boxes, cylinders and spheres. The dimensions are
those of a large human hand, rounded to whole millimetres.
"""

from __future__ import annotations

from pathlib import Path

FINGERS = {"ff": (0.033, 0.095, -0.05), "mf": (0.011, 0.099, 0.0), "rf": (-0.011, 0.095, 0.05)}
"""Of each finger the place of its knuckle on the palm, x and z [m], and its cant [rad]."""

PHALANGES = (0.045, 0.025, 0.026)
"""Lengths of a finger's phalanges [m]."""

RADIUS = 0.008
"""Radius of a finger's phalanges [m]."""

THUMB_RADIUS = 0.010
"""Radius of the thumb's phalanges [m]."""


def _link(name: str, shapes: str = "") -> str:
    return f'<link name="{name}">{shapes}</link>\n'


def _box(size: str, xyz: str) -> str:
    origin = f'<origin xyz="{xyz}"/>'
    return f'<collision>{origin}<geometry><box size="{size}"/></geometry></collision>'


def _phalanx(length: float, radius: float) -> str:
    rod = f'<cylinder radius="{radius}" length="{length:.4f}"/>'
    middle = f'<origin xyz="0 0 {length / 2:.4f}"/>'
    end = f'<origin xyz="0 0 {length:.4f}"/>'
    ball = f'<sphere radius="{radius}"/>'
    return (
        f"<collision>{middle}<geometry>{rod}</geometry></collision>"
        f"<collision>{end}<geometry>{ball}</geometry></collision>"
    )


def _joint(
    name: str,
    parent: str,
    child: str,
    place: tuple[str, str],
    axis: str,
    limits: tuple[float, float],
) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place[0]}" rpy="{place[1]}"/><axis xyz="{axis}"/>'
        f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="2" velocity="3"/></joint>\n'
    )


def urdf() -> str:
    """Return the URDF."""
    parts = ['<?xml version="1.0"?>\n<robot name="large_hand">\n']
    parts += [_link("forearm", _box("0.07 0.06 0.10", "0 0 -0.07")), _link("wrist")]
    parts += [_link("palm", _box("0.080 0.022 0.085", "0 0 0.048"))]
    none = "0 0 0"
    parts += [_joint("wrj2", "forearm", "wrist", (none, none), "0 1 0", (-0.52, 0.17))]
    parts += [_joint("wrj1", "wrist", "palm", ("0 0 0.01", none), "1 0 0", (-0.70, 0.49))]
    for finger, (x, z, cant) in FINGERS.items():
        parts += _finger(finger, "palm", (f"{x} 0 {z}", f"0 {-cant} 0"))
    parts += [_link("lfmetacarpal", _box("0.016 0.018 0.05", "0 0 0.025"))]
    place = ("-0.033 0 0.021", "0 -0.10 0")
    parts += [_joint("lfj5", "palm", "lfmetacarpal", place, "0.57 0 0.82", (0.0, 0.785))]
    parts += _finger("lf", "lfmetacarpal", ("0 0 0.066", none))
    parts += _thumb()
    return "".join([*parts, "</robot>\n"])


def _finger(finger: str, base: str, place: tuple[str, str]) -> list[str]:
    names = [f"{finger}{part}" for part in ("knuckle", "proximal", "middle", "distal")]
    parts = [_link(names[0])]
    parts += [
        _link(n, _phalanx(length, RADIUS)) for n, length in zip(names[1:], PHALANGES, strict=True)
    ]
    # The knuckle is a link without shape: two joints at one point, for spreading and bending.
    parts += [_joint(f"{finger}j4", base, names[0], place, "0 -1 0", (-0.349, 0.349))]
    offsets = ("0 0 0", f"0 0 {PHALANGES[0]}", f"0 0 {PHALANGES[1]}")
    for number, parent, child, offset in zip((3, 2, 1), names, names[1:], offsets, strict=False):
        limits = (-0.262, 1.571) if number == 3 else (0.0, 1.571)
        parts += [_joint(f"{finger}j{number}", parent, child, (offset, "0 0 0"), "1 0 0", limits)]
    return parts


def _thumb() -> list[str]:
    names = ["thbase", "thproximal", "thhub", "thmiddle", "thdistal"]
    shapes = {"thproximal": _phalanx(0.038, THUMB_RADIUS), "thmiddle": _phalanx(0.032, RADIUS)}
    shapes["thdistal"] = _phalanx(0.0275, RADIUS)
    parts = [_link(name, shapes.get(name, "")) for name in names]
    rows = [
        ("thj5", "palm", "thbase", ("0.034 -0.009 0.029", "0 0.785 0"), "0 0 -1", (-1.047, 1.047)),
        ("thj4", "thbase", "thproximal", ("0 0 0", "0 0 0"), "1 0 0", (0.0, 1.222)),
        ("thj3", "thproximal", "thhub", ("0 0 0.038", "0 0 0"), "1 0 0", (-0.209, 0.209)),
        ("thj2", "thhub", "thmiddle", ("0 0 0", "0 0 0"), "0 -1 0", (-0.698, 0.698)),
        ("thj1", "thmiddle", "thdistal", ("0 0 0.032", "0 0 0"), "0 -1 0", (-0.262, 1.571)),
    ]
    return parts + [_joint(*row) for row in rows]


def srdf() -> str:
    """Return the SRDF, which names the fingers."""
    chains = {"ff": "palm", "mf": "palm", "rf": "palm", "lf": "palm", "th": "palm"}
    groups = "".join(
        f'<group name="{finger}"><chain base_link="{base}" tip_link="{finger}distal"/></group>\n'
        for finger, base in chains.items()
    )
    members = "".join(f'<group name="{finger}"/>' for finger in chains)
    return (
        f'<?xml version="1.0"?>\n<robot name="large_hand">\n{groups}'
        f'<group name="fingers">{members}</group>\n</robot>\n'
    )


def write(folder: Path) -> Path:
    """Write both files into a folder; return the URDF's path."""
    (folder / "large_hand.srdf").write_text(srdf())
    path = folder / "large_hand.urdf"
    path.write_text(urdf())
    return path
