"""MJCF becomes the hand that it describes; what cannot is refused in a sentence."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from hand.test_scaffold import stl  # noqa: E402
from rtee_process import RTEE  # noqa: E402

from rtee.errors import ConfigError, ModelError  # noqa: E402
from rtee.exchange import mjcf_files  # noqa: E402
from rtee.exchange.export import ExportFormat, export_hand  # noqa: E402
from rtee.exchange.mjcf_import import import_mjcf  # noqa: E402
from rtee.exchange.reading import as_urdf, mjcf_as_urdf  # noqa: E402
from rtee.extract.extraction import extract  # noqa: E402
from rtee.hand.geometry import HandGeometry  # noqa: E402
from rtee.hand.kinematics import Kinematics  # noqa: E402
from rtee.hand.load import load_hand, load_model  # noqa: E402
from rtee.hand.model import Hand, JointRole  # noqa: E402
from rtee.hand.scaffold import make_hand  # noqa: E402
from rtee.units import AngleUnit  # noqa: E402

CONFIG = Path(__file__).parents[2] / "config"


def made(folder: Path, text: str, **more: object) -> Hand:
    """Return the hand that an MJCF text describes."""
    file = folder / "hand.xml"
    file.write_text(text)
    return imported(file, **more)


def imported(file: Path, **more: object) -> Hand:
    out = file.parent / "made"
    out.mkdir(exist_ok=True)
    found = import_mjcf(file, out)
    return load_model(found.urdf, passive=found.passive or (), **more)  # type: ignore[arg-type]


def notes_of(file: Path) -> str:
    return "\n".join(import_mjcf(file, file.parent / "made").notes)


def coupling(hand: Hand, joint: str) -> tuple[str, float, float]:
    """Return what a joint follows, its slope and its offset."""
    found = hand.transmission.couplings[hand.joint_index(joint)]
    assert found.linear
    assert found.actuator is not None
    zero, one = found.value(0.0), found.value(1.0)
    return hand.actuator_names[found.actuator], one - zero, zero


FINGER = """
  <body name="{name}" pos="{x} 0 0.02">
    <joint name="{name}_1" axis="0 1 0" range="0 90"/>
    <geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.04"/>
    <body name="{name}_tip" pos="0 0 0.045">
      <joint name="{name}_2" axis="0 1 0" range="0 90"/>
      <geom type="box" size="0.006 0.008 0.015" pos="0 0 0.015"/>
    </body>
  </body>"""


def hand_of(extra: str, *, fingers: str = "", head: str = "") -> str:
    """Return a palm with two fingers of two joints, and what is added."""
    two = FINGER.format(name="a", x=-0.03) + FINGER.format(name="b", x=0.03).replace(
        "0 1 0", "0 -1 0"
    )
    return f"""<mujoco model="two">
{head}
<worldbody>
  <geom type="plane" size="1 1 0.1"/>
  <body name="palm" pos="0 0 0.3">
    <geom type="box" size="0.05 0.02 0.02"/>
    {two}{fingers}
  </body>
</worldbody>
{extra}
</mujoco>"""


PAD = "v 0 0 0\nv 0.01 0 0\nv 0 0.02 0\nv 0 0 0.03\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"

MOTORS = """<actuator>
  <position name="A" joint="a_1" ctrlrange="0 1.2" forcerange="-2 2" kp="5"/>
  <position joint="a_2" kp="5"/>
  <motor joint="b_1" gear="3" ctrlrange="-1 1"/>
  <position joint="b_2" gear="2" ctrlrange="0 2" kp="5"/>
</actuator>"""


def test_motors_give_actuators_limits_and_efforts(tmp_path: Path) -> None:
    hand = made(tmp_path, hand_of(MOTORS))
    assert hand.name == "two"
    assert hand.base == "palm"
    assert hand.actuator_names == ("a_1", "a_2", "b_1", "b_2")
    half = np.pi / 2
    assert hand.lower == pytest.approx([0.0] * 4)
    assert hand.upper == pytest.approx([1.2, half, half, 1.0])
    assert [a.effort for a in hand.actuators] == pytest.approx([2.0, np.inf, 3.0, np.inf])
    assert {finger.tip for finger in hand.fingers} == {"a_tip", "b_tip"}
    assert "a plane of body" not in notes_of(tmp_path / "hand.xml")


def test_limits_of_velocities_are_none_of_positions(tmp_path: Path) -> None:
    extra = """<actuator>
      <intvelocity joint="a_1" kp="5" ctrlrange="-0.1 0.1" actrange="0 1.2"/>
      <position joint="b_1" kp="5" ctrlrange="0 1.1"/>
    </actuator>"""
    hand = made(tmp_path, hand_of(extra))
    assert hand.lower == pytest.approx([0.0, 0.0])
    assert hand.upper == pytest.approx([1.2, 1.1])


def test_without_actuators_every_free_joint_is_one(tmp_path: Path) -> None:
    tied = '<equality><joint joint1="a_2" joint2="a_1" polycoef="0.1 0.5 0 0 0"/></equality>'
    hand = made(tmp_path, hand_of(tied))
    assert hand.actuator_names == ("a_1", "b_1", "b_2")
    assert coupling(hand, "a_2") == ("a_1", pytest.approx(0.5), pytest.approx(0.1))
    assert "no actuators" in notes_of(tmp_path / "hand.xml")


def test_joints_without_motors_are_passive(tmp_path: Path) -> None:
    hand = made(tmp_path, hand_of('<actuator><position joint="a_1"/></actuator>'))
    assert [j.name for j in hand.joints if j.role is JointRole.PASSIVE] == ["a_2", "b_1", "b_2"]


def test_polynomials_become_expressions(tmp_path: Path) -> None:
    extra = """<equality>
      <joint joint1="a_2" joint2="a_1" polycoef="0.01 0.5 0.2 -0.1 0.03"/>
      <joint joint1="b_2" joint2="a_2" polycoef="0.2 2 0 0 0"/>
      <joint joint1="b_1" polycoef="0.3 0 0 0 0"/>
    </equality><actuator><position joint="a_1" kp="1"/></actuator>"""
    hand = made(tmp_path, hand_of(extra))
    assert hand.actuator_names == ("a_1",)
    assert hand.joint_names == ("a_1", "a_2", "b_2")  # the one that is held is fixed
    for u in np.linspace(0.0, 1.5, 7):
        a_2 = np.polynomial.polynomial.polyval(u, [0.01, 0.5, 0.2, -0.1, 0.03])
        found = hand.transmission.joints(np.array([u]))
        assert found == pytest.approx([u, a_2, 0.2 + 2.0 * a_2], abs=1e-14)


@pytest.mark.parametrize(
    ("one", "other", "polynomial", "bent"),
    [
        # What follows a held joint, and what a held joint follows.
        ("b_1", "b_2", "0.35 0.5 0.25 0 0", 0.35 + 0.5 * 0.2 + 0.25 * 0.2**2),
        ("b_2", "b_1", "0.1 0.5 0 0 0", (0.2 - 0.1) / 0.5),
    ],
)
def test_what_is_coupled_with_a_held_joint_is_held(
    tmp_path: Path, one: str, other: str, polynomial: str, bent: float
) -> None:
    extra = """<equality>
      <joint joint1="b_2" polycoef="0.2 0 0 0 0"/>
      <joint joint1="{}" joint2="{}" polycoef="{}"/>
      <joint joint1="a_2" joint2="b_1" polycoef="0 2 0 0 0"/>
    </equality><actuator><position joint="a_1" kp="1"/></actuator>"""
    hand = made(tmp_path, hand_of(extra.format(one, other, polynomial)))
    assert hand.joint_names == ("a_1",)
    text = notes_of(tmp_path / "hand.xml")
    assert all(f"joint '{name}' is held" in text for name in ("a_2", "b_1", "b_2"))
    turn = Kinematics(hand).link_pose("b", hand.rest)[:3, :3]
    # Its axis is -y.
    assert np.arctan2(turn[2, 0], turn[0, 0]) == pytest.approx(bent)


def test_a_tendon_that_a_motor_pulls_and_equalities_between_tendons(tmp_path: Path) -> None:
    extra = """<tendon>
      <fixed name="pull"><joint joint="a_1" coef="0.5"/><joint joint="b_1" coef="0.5"/></fixed>
      <fixed name="a"><joint joint="a_2" coef="2"/><joint joint="a_1" coef="-1"/></fixed>
    </tendon>
    <equality>
      <joint joint1="b_1" joint2="a_1"/>
      <tendon tendon1="a" polycoef="0.1 0 0 0 0"/>
      <joint joint1="b_2" joint2="b_1" polycoef="0 0.25 0 0 0"/>
    </equality>
    <actuator><position name="grip" tendon="pull" ctrlrange="0 1" kp="1" forcerange="-4 4"/>
    </actuator>"""
    hand = made(tmp_path, hand_of(extra))
    assert hand.actuator_names == ("a_1",)
    assert hand.upper == pytest.approx([1.0])
    assert hand.actuators[0].effort == pytest.approx(4.0)
    assert coupling(hand, "b_1")[1] == pytest.approx(1.0)
    assert coupling(hand, "a_2")[1:] == (pytest.approx(0.5), pytest.approx(0.05))
    assert coupling(hand, "b_2")[1] == pytest.approx(0.25)


def test_an_underactuated_finger_shares_its_tendon_by_springs_or_factors(tmp_path: Path) -> None:
    tendon = """<tendon><fixed name="t">
      <joint joint="a_1" coef="1"/><joint joint="a_2" coef="2"/>
    </fixed></tendon>
    <actuator><position tendon="t" ctrlrange="0 1" kp="1"/>
    <position joint="b_1"/><position joint="b_2"/></actuator>"""
    hand = made(tmp_path, hand_of(tendon))
    assert hand.actuator_names == ("a_1", "b_1", "b_2")
    assert coupling(hand, "a_2")[1] == pytest.approx(2.0)
    assert "share a tendon" in notes_of(tmp_path / "hand.xml")
    # The tendon pulls both; the joint with the softer spring gives more: q = coef · tension / k.
    text = hand_of(tendon).replace('"a_1" axis', '"a_1" stiffness="1" axis')
    sprung = made(tmp_path, text.replace('"a_2" axis', '"a_2" stiffness="4" axis'))
    assert coupling(sprung, "a_2")[1] == pytest.approx(0.5)
    assert "share a tendon" not in notes_of(tmp_path / "hand.xml")


LIMITED = """<tendon>
  <fixed name="crossed" limited="true" range="{range}">
    <joint joint="a_1" coef="-0.008"/><joint joint="a_2" coef="0.01"/>
  </fixed>
</tendon>
<actuator>
  <position name="A" joint="a_1" ctrlrange="0 1.2" kp="5"/>
  <position joint="b_1" kp="5"/><position joint="b_2" kp="5"/>{more}
</actuator>"""


def test_a_tendon_that_may_hardly_move_couples_its_joints(tmp_path: Path) -> None:
    """Hands with a last joint that crossing tendons turn are written like this."""
    stiff = """<default><joint stiffness="0.05" springref="30"/></default>"""
    text = hand_of(LIMITED.format(range="-0.001 0.0014", more=""), head=stiff)
    hand = made(tmp_path, text)
    assert hand.actuator_names == ("a_1", "b_1", "b_2")
    by, slope, offset = coupling(hand, "a_2")
    assert by == "a_1"
    assert slope == pytest.approx(0.8, abs=1e-6)
    assert offset == pytest.approx(0.02, abs=1e-6)
    assert "tendon 'crossed' can move by only 0.0024" in notes_of(tmp_path / "hand.xml")
    # One that only ends the motion couples nothing, and a motor of its own decides.
    made(tmp_path, hand_of(LIMITED.format(range="-0.02 0.02", more="")))
    assert import_mjcf(tmp_path / "hand.xml", tmp_path / "made").passive == ("a_2",)
    assert "crossed" not in notes_of(tmp_path / "hand.xml")
    own = '<position joint="a_2" kp="5"/>'
    hand = made(tmp_path, hand_of(LIMITED.format(range="-0.001 0.001", more=own)))
    assert hand.actuator_names == ("a_1", "a_2", "b_1", "b_2")


def test_angles_that_count_as_degrees_by_default_are_told(tmp_path: Path) -> None:
    radians = hand_of(MOTORS).replace("0 90", "0 1.5")
    note = "count as degrees, and no hinge turns beyond 1.5°"
    hand = made(tmp_path, radians)
    assert hand.upper[1] == pytest.approx(np.radians(1.5))
    assert note in notes_of(tmp_path / "hand.xml")
    hand = made(tmp_path, radians.replace("<worldbody>", '<compiler angle="radian"/><worldbody>'))
    assert hand.upper[1] == pytest.approx(1.5)
    assert "degrees" not in notes_of(tmp_path / "hand.xml")
    made(tmp_path, hand_of(MOTORS))
    assert "degrees" not in notes_of(tmp_path / "hand.xml")


def test_the_unit_of_angles_is_given(tmp_path: Path) -> None:
    radians = hand_of(MOTORS).replace("0 90", "0 1.5")
    file = tmp_path / "hand.xml"
    file.write_text(radians)
    imported = import_mjcf(file, tmp_path, radians=True)
    assert load_model(imported.urdf).upper[1] == pytest.approx(1.5)
    assert "degrees" not in " ".join(imported.notes)
    file.write_text(radians.replace("<worldbody>", '<compiler angle="radian"/><worldbody>'))
    with pytest.raises(ConfigError, match="files without <compiler angle>"):
        import_mjcf(file, tmp_path, radians=False)
    with pytest.raises(ConfigError, match="--angle needs --mjcf"):
        as_urdf(file, None, (), (), angle=AngleUnit.RADIAN)


def test_meshes_and_textures_are_looked_for_in_their_own_folders(tmp_path: Path) -> None:
    for name in ("model", "meshes", "pictures"):
        (tmp_path / name).mkdir()
    (tmp_path / "meshes" / "m.obj").write_text(PAD)
    file = tmp_path / "model" / "hand.xml"
    file.write_text(
        hand_of(
            '<asset><mesh name="m" file="m.obj"/></asset>',
            head='<compiler meshdir="../meshes" texturedir="../pictures"/>',
            fingers='<body name="m"><joint range="0 90"/><geom type="mesh" mesh="m"/></body>',
        )
    )
    out = tmp_path / "made"
    out.mkdir()
    with pytest.raises(ModelError, match="outside of") as told:
        import_mjcf(file, out)
    # In the pictures' folder, which is outside as well, no mesh is looked for.
    assert str(told.value).endswith(f"--package-dir {(tmp_path / 'meshes').resolve()}")
    found = import_mjcf(file, out, [tmp_path / "meshes"])
    assert "m" in load_model(found.urdf).urdf.links


DIFFERENTIAL = """<tendon>
  <fixed name="left"><joint joint="a_1" coef="0.5"/><joint joint="a_2" coef="1"/></fixed>
  <fixed name="right"><joint joint="a_1" coef="0.5"/><joint joint="a_2" coef="-1"/></fixed>
</tendon>
<actuator>
  <position name="m" tendon="left" kp="5" ctrlrange="-0.5 0.9" forcerange="-2 2"/>
  <position name="n" tendon="right" kp="5" ctrlrange="-0.5 0.5" forcerange="-3 3"/>
  <position joint="b_1" kp="5"/><position joint="b_2" kp="5"/>
</actuator>"""


def test_the_joints_of_a_differential_are_the_actuators(tmp_path: Path) -> None:
    hand = made(tmp_path, hand_of(DIFFERENTIAL))
    assert hand.actuator_names == ("a_1", "a_2", "b_1", "b_2")
    # With the tendons at m and n, a_1 = m + n and a_2 = (m - n) / 2.
    assert hand.lower[:2] == pytest.approx([0.0, 0.0])
    assert hand.upper[:2] == pytest.approx([1.4, 0.7])
    # By virtual work: half of either tendon's force at a_1, all of both at a_2.
    assert [a.effort for a in hand.actuators][:2] == pytest.approx([2.5, 5.0])
    assert "actuators 'm' and 'n' move joints 'a_1', 'a_2' together" in notes_of(
        tmp_path / "hand.xml"
    )


def test_what_follows_a_joint_of_a_differential_follows_it(tmp_path: Path) -> None:
    third = """<body name="a_end" pos="0 0 0.04"><joint name="a_3" axis="0 1 0" range="0 90"/>
      <geom type="box" size="0.005 0.005 0.01" pos="0 0 0.012"/></body>"""
    text = hand_of(
        DIFFERENTIAL
        + """<equality>
      <joint joint1="a_3" joint2="a_2" polycoef="0 0.8 0 0 0"/></equality>"""
    )
    text = text.replace(
        '<joint name="a_2" axis="0 1 0" range="0 90"/>',
        '<joint name="a_2" axis="0 1 0" range="0 90"/>' + third,
    )
    hand = made(tmp_path, text)
    assert coupling(hand, "a_3") == ("a_2", pytest.approx(0.8), pytest.approx(0.0))


def test_a_joint_that_follows_two_motors_with_joints_of_their_own_is_refused(
    tmp_path: Path,
) -> None:
    extra = """<tendon><fixed name="sum"><joint joint="a_2" coef="1"/>
      <joint joint="a_1" coef="-1"/><joint joint="b_1" coef="-1"/></fixed></tendon>
    <equality><tendon tendon1="sum"/></equality>
    <actuator><position joint="a_1"/><position joint="b_1"/><position joint="b_2"/></actuator>"""
    with pytest.raises(ModelError, match="'a_2' follows 'actuator_0' and 'actuator_1' at once"):
        made(tmp_path, hand_of(extra))


def test_motors_that_leave_no_freedom_are_refused(tmp_path: Path) -> None:
    many = MOTORS.replace(
        "</actuator>", "</actuator><equality><joint joint1='a_1' joint2='b_1'/></equality>"
    )
    with pytest.raises(ModelError, match="fewer degrees of freedom"):
        made(tmp_path, hand_of(many))


SQUARE = """<mujoco model="square">
<compiler angle="radian"/>
<worldbody><body name="base"><geom type="box" size="0.05 0.01 0.005"/>
  <body name="crank" pos="{x} 0 0.01">
    <joint name="crank" axis="0 1 0" range="-0.8 0.8"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 {crank}"/>
    <body name="coupler" pos="0 0 {crank}">
      <joint name="coupler" axis="0 1 0"/>
      <geom type="capsule" size="0.004" fromto="0 0 0 0.04 0 0"/>
    </body>
  </body>
  <body name="rocker" pos="0.04 0 0.01">
    <joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
  </body>
</body></worldbody>
<equality><connect body1="coupler" body2="rocker" anchor="0.04 0 0"/></equality>
<actuator><position joint="crank" kp="1"/></actuator>
</mujoco>"""


def test_a_closed_linkage_is_solved(tmp_path: Path) -> None:
    parallel = made(tmp_path, SQUARE.format(x=0, crank=0.03))
    assert parallel.actuator_names == ("crank",)
    # The sides of a parallelogram stay parallel.
    assert coupling(parallel, "rocker")[1:] == (
        pytest.approx(1.0, abs=1e-8),
        pytest.approx(0.0, abs=1e-8),
    )
    assert coupling(parallel, "coupler")[1] == pytest.approx(-1.0, abs=1e-8)
    assert "is solved" in notes_of(tmp_path / "hand.xml")


def test_a_linkage_of_unequal_sides_follows_a_curve_and_its_limits(tmp_path: Path) -> None:
    text = SQUARE.format(x=0, crank=0.03).replace("0.04 0 0.01", "0.045 0 0.01").replace(
        'anchor="0.04', 'anchor="0.045').replace("range=\"-0.8 0.8\"", 'range="-2.6 1.0"').replace(
        'body2="rocker"', 'body2="rocker"')  # fmt: skip
    text = text.replace('pos="0.045 0 0.01">', 'pos="0.045 0 0.005">')
    hand = made(tmp_path, text)
    rocker = hand.transmission.couplings[hand.joint_index("rocker")]
    coupler = hand.transmission.couplings[hand.joint_index("coupler")]
    assert not rocker.linear
    # The pin, reached along both ways, is one point; connect takes where it is as drawn.
    for u in np.linspace(hand.lower[0], hand.upper[0], 9):
        turn = u + coupler.value(u)
        by_crank = np.array([0.03 * np.sin(u), 0.01 + 0.03 * np.cos(u)])
        by_crank += 0.045 * np.array([np.cos(turn), -np.sin(turn)])
        q = rocker.value(u)
        by_rocker = np.array([0.045 + 0.035 * np.sin(q), 0.005 + 0.035 * np.cos(q)])
        assert by_crank == pytest.approx(by_rocker, abs=1e-6)
    assert "become its limits" in notes_of(tmp_path / "hand.xml") or hand.lower[0] == pytest.approx(
        -2.6
    )


PUSHED = """<mujoco model="pushed">
<worldbody><body name="base"><geom type="box" size="0.02 0.02 0.005"/>
  <body name="slider" pos="-0.05 0.02 0">
    <joint name="push" type="slide" axis="1 0 0" range="-0.01 0.01"/>
    <geom type="box" size="0.003 0.003 0.003"/>
    <body name="rod">
      <joint name="rod" axis="0 0 1"/>
      <geom type="capsule" size="0.002" fromto="0 0 0 0.05 0 0"/>
    </body>
  </body>
  <body name="crank">
    <joint name="crank" axis="0 0 1"/>
    <geom type="capsule" size="0.002" fromto="0 0 0 0 0.02 0"/>
  </body>
</body></worldbody>
<equality><connect body1="rod" body2="crank" anchor="0.05 0 0"/></equality>
<actuator><position joint="push" kp="100"/></actuator>
</mujoco>"""


def test_a_slide_turns_a_short_crank(tmp_path: Path) -> None:
    hand = made(tmp_path, PUSHED)
    assert (hand.lower[0], hand.upper[0]) == pytest.approx((-0.01, 0.01))
    crank = hand.transmission.couplings[hand.joint_index("crank")]
    for u in np.linspace(-0.01, 0.01, 9):
        q = crank.value(u)
        # The rod keeps its length between the slider and the end of the crank.
        rod = np.array([-0.02 * np.sin(q), 0.02 * np.cos(q)]) - (u - 0.05, 0.02)
        assert np.linalg.norm(rod) == pytest.approx(0.05, abs=1e-7)


def test_a_linkage_with_too_few_motors_or_too_many_is_refused(tmp_path: Path) -> None:
    open_chain = SQUARE.format(x=0, crank=0.03).replace(
        '<geom type="capsule" size="0.004" fromto="0 0 0 0.04 0 0"/>',
        '<joint name="slack" type="slide" axis="1 0 0"/><geom size="0.004"/>',
    )
    with pytest.raises(
        ModelError, match="2 degrees of freedom that no spring decides, and one actuator"
    ):
        made(tmp_path, open_chain)
    both = SQUARE.format(x=0, crank=0.03).replace(
        '<position joint="crank" kp="1"/>', '<position joint="crank"/><position joint="rocker"/>'
    )
    with pytest.raises(ModelError, match="2 actuators move joints"):
        made(tmp_path, both)
    endless = SQUARE.format(x=0, crank=0.03).replace(' range="-0.8 0.8"', "")
    with pytest.raises(ModelError, match="has no range"):
        made(tmp_path, endless)


ADAPTIVE = """<mujoco model="adaptive"><compiler angle="radian"/>
<worldbody><body name="base"><geom type="box" size="0.05 0.02 0.005"/>{right}{left}</body>
</worldbody>
<equality>
  <connect body1="r_follower" body2="r_coupler" anchor="-0.012 0 0.01"/>
  <connect body1="l_follower" body2="l_coupler" anchor="-0.012 0 0.01"/>
  <joint joint1="l_driver" joint2="r_driver"/>
</equality>
<tendon><fixed name="split"><joint joint="r_driver" coef="0.5"/><joint joint="l_driver" coef="0.5"/>
</fixed></tendon>
<actuator><general name="grip" tendon="split" ctrlrange="0 255" gainprm="0.235294"
  biasprm="0 -100 -10" biastype="affine" forcerange="-5 5"/></actuator>
</mujoco>"""

SIDE = """<body name="{s}_driver" pos="{x} 0 0.01" euler="0 0 {turn}">
  <joint name="{s}_driver" axis="0 1 0" range="0 0.8"/>
  <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
  <body name="{s}_coupler" pos="0 0 0.03">
    <joint name="{s}_coupler" axis="0 1 0" range="-1.5 0"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
  </body></body>
<body name="{s}_link" pos="{inner} 0 0.02" euler="0 0 {turn}">
  <joint name="{s}_link" axis="0 1 0" range="-0.3 1.2" stiffness="0.05" springref="2.6"/>
  <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
  <body name="{s}_follower" pos="0 0 0.03">
    <joint name="{s}_follower" axis="0 1 0" range="-0.9 0.9"/>
    <geom type="box" size="0.004 0.01 0.02" pos="0.012 0 0.02"/>
  </body></body>"""


def test_springs_and_stops_decide_what_an_adaptive_linkage_leaves_open(tmp_path: Path) -> None:
    right = SIDE.format(s="r", x=-0.04, inner=-0.028, turn=0)
    left = SIDE.format(s="l", x=0.04, inner=0.028, turn=3.141592653589793)
    hand = made(tmp_path, ADAPTIVE.format(right=right, left=left))
    assert hand.actuator_names == ("r_driver",)
    # 255 stand for 0.6 rad.
    assert hand.upper == pytest.approx([0.6], abs=2e-3)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hand.xml"))
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    # Beside rtee: MuJoCo's own dynamics, stiff and with weak springs, until all is at rest.
    model.opt.timestep, model.dof_damping[:], model.dof_armature[:] = 2e-4, 0.02, 1e-3
    model.eq_solref[:] = model.jnt_solref[:] = [0.002, 1.0]
    model.jnt_stiffness *= 0.05
    data = mujoco.MjData(model)
    for target in (0.0, 0.3, 0.55):
        data.ctrl[0] = 255 * target / 0.6
        mujoco.mj_step(model, data, 15000)
        u = np.array([data.joint("r_driver").qpos[0]])
        found = dict(zip(hand.joint_names, hand.transmission.joints(u), strict=True))
        for joint in hand.joint_names:
            # MuJoCo's equalities and stops give way a little.
            assert found[joint] == pytest.approx(data.joint(joint).qpos[0], abs=0.02), joint


STRETCHED = """<mujoco model="stretched"><compiler angle="radian"/>
<worldbody><body name="base"><geom type="box" size="0.05 0.02 0.005"/>
  <site name="post" pos="-0.02 0 0.075"/>
  <body name="driver" pos="-0.03 0 0.01">
    <joint name="driver" axis="0 1 0" range="-0.3 0.4"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
    <body name="coupler" pos="0 0 0.03">
      <joint name="coupler" axis="0 1 0"/>
      <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
      <site name="on_coupler" pos="0 0 0.03"/>
    </body></body>
  <body name="link" pos="0.01 0 0.01">
    <joint name="link" axis="0 1 0"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/>
    <body name="follower" pos="0 0 0.03">
      <joint name="follower" axis="0 1 0"/>
      <geom type="box" size="0.004 0.01 0.02" pos="0 0 0.02"/>
      <site name="on_follower" pos="0.01 0 0.03"/>
    </body></body>
  <site name="anchor" pos="0.04 0 0.05"/>
</body></worldbody>
<equality><connect body1="follower" body2="coupler" anchor="-0.04 0 0.03"/></equality>
<tendon>{cords}</tendon>
<actuator><position joint="driver" kp="50" kv="0.5"/></actuator>
</mujoco>"""

CORDS = """
<spatial name="right" stiffness="40" springlength="0.005"><site site="anchor"/>
  <site site="on_follower"/></spatial>
<spatial name="left" stiffness="60" springlength="{}"><site site="post"/>
  <site site="on_coupler"/></spatial>"""


@pytest.mark.samples("0 0.003")
@pytest.mark.parametrize("rest", ["0", "0.004", "0 0.003"])
@pytest.mark.heavy
def test_the_springs_of_spatial_tendons_decide_what_a_linkage_leaves_open(
    tmp_path: Path, rest: str
) -> None:
    hand = made(tmp_path, STRETCHED.format(cords=CORDS.format(rest)))
    assert hand.actuator_names == ("driver",)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hand.xml"))
    # Beside rtee: MuJoCo's own dynamics with stiff equalities, until all is at rest.
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.timestep, model.dof_damping[:], model.dof_armature[:] = 5e-4, 5e-3, 1e-3
    model.eq_solref[:], model.eq_solimp[:, :2] = [0.002, 1.0], 0.999
    data = mujoco.MjData(model)
    for target in (-0.25, 0.0, 0.35):
        data.ctrl[0] = target
        mujoco.mj_step(model, data, 8000)
        # The springs hold the driver back a little.
        u = np.array([data.joint("driver").qpos[0]])
        found = dict(zip(hand.joint_names, hand.transmission.joints(u), strict=True))
        for joint in hand.joint_names:
            assert found[joint] == pytest.approx(data.joint(joint).qpos[0], abs=1e-3), joint


@pytest.mark.heavy
def test_the_spring_of_a_spatial_tendon_outside_of_linkages_is_noted(tmp_path: Path) -> None:
    cords = CORDS.format("0").replace('site="anchor"', 'site="outside"')
    text = STRETCHED.format(cords=cords).replace(
        '<site name="anchor"',
        '''<body name="lone" pos="0.04 0 0.05">
  <joint name="lone" axis="0 1 0" range="-1 1"/><geom size="0.003"/>
  <site name="outside" pos="0 0 0.001"/></body><site name="anchor"''',
    )
    made(tmp_path, text)
    assert "the spring of the spatial tendon 'right' is ignored" in notes_of(tmp_path / "hand.xml")


def test_a_slack_tendon_decides_nothing(tmp_path: Path) -> None:
    slack = STRETCHED.format(
        cords='<spatial name="slack" stiffness="40" springlength="0 1"><site site="anchor"/>'
        '<site site="on_follower"/></spatial>'
    )
    with pytest.raises(ModelError, match="2 degrees of freedom that no spring decides"):
        made(tmp_path, slack)


SPATIAL = """<tendon><spatial name="cord">
<site site="on_palm"/><site site="on_tip"/></spatial></tendon>
<actuator><position name="pull" tendon="cord"/>
    <position joint="b_1"/><position joint="b_2"/></actuator>"""


def test_a_spatial_tendon_moves_one_degree_of_freedom(tmp_path: Path) -> None:
    text = hand_of(SPATIAL, fingers='<site name="on_palm" pos="-0.05 0 0.02"/>').replace(
        'pos="0 0 0.015"/>', 'pos="0 0 0.015"/><site name="on_tip"/>', 1
    )
    with pytest.raises(ModelError, match=r"spatial tendon of 'pull'.*2 degrees of freedom"):
        made(tmp_path, text)
    tied = text.replace(
        "</mujoco>", "<equality><joint joint1='a_2' joint2='a_1'/></equality></mujoco>"
    )
    hand = made(tmp_path, tied)
    assert hand.actuator_names == ("a_1", "b_1", "b_2")
    assert coupling(hand, "a_2")[1] == pytest.approx(1.0)


ODD = """<mujoco model="odd">
<compiler angle="degree" eulerseq="zyx" meshdir="assets"/>
<default><default class="seen"><geom contype="0" conaffinity="0" group="1"/></default>
<default class="hidden"><geom contype="0" conaffinity="0" group="4"/></default>
<default class="link"><joint axis="0 1 0" range="-40 80" limited="true"/></default></default>
<asset><mesh name="shell" file="shell.stl" scale="2 2 2"/>
<texture name="t" type="2d" file="no.png"/>
<material name="m" texture="t"/></asset>
<worldbody>
  <body name="palm" pos="1 2 3" euler="10 20 30">
    <geom type="mesh" mesh="shell" pos="0.01 0.02 0" euler="5 0 40" material="m"/>
    <geom class="hidden" size="0.5"/>
    <include file="parts/finger.xml"/>
    <body name="slider" pos="0 0.03 0" quat="0.8 0.2 0 0.4">
      <joint name="slide" type="slide" axis="1 1 0" range="0 0.03" ref="0.01"/>
      <geom class="seen" type="cylinder" size="0.004 0.01"/>
      <geom type="cylinder" size="0.004 0.01" pos="0.001 0 0" euler="0 90 0"/>
    </body>
  </body>
</worldbody>
<contact><exclude body1="palm" body2="slider"/></contact>
<actuator>
  <general joint="swing"/><general joint="bend"/><general joint="turn"/><general joint="slide"/>
</actuator>
</mujoco>"""

PART = """<mujocoinclude>
  <body name="finger" pos="0.02 0 0.05" axisangle="1 0 1 25" childclass="link">
    <joint name="swing" axis="1 0 0" pos="0 0.004 -0.01"/>
    <joint name="bend" pos="0.001 0.002 0.003" ref="10"/>
    <geom type="capsule" size="0.006 0.02" pos="0 0 0.02"/>
    <body name="tip" pos="0 0 0.045">
      <joint name="turn" type="hinge" pos="0 0 -0.002" limited="false"/>
      <geom type="ellipsoid" size="0.006 0.004 0.01" pos="0 0 0.01"/>
    </body>
  </body>
</mujocoinclude>"""


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    for place, content in (
        ("odd.xml", ODD.encode()), ("parts/finger.xml", PART.encode()), ("assets/shell.stl", stl()),
    ):  # fmt: skip
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(content)
    return tmp_path / "odd.xml"


def test_every_shape_is_where_mujoco_has_it(odd: Path) -> None:
    hand = imported(odd)
    assert hand.actuator_names == ("swing", "bend", "turn", "slide")
    assert hand.actuator("turn").kind == "continuous"
    (odd.parent / "assets" / "no.png").touch()
    text = odd.read_text().replace('<texture name="t" type="2d" file="no.png"/>', "")
    bare = odd.with_name("bare.xml")
    bare.write_text(text.replace(' texture="t"', ""))
    model = mujoco.MjModel.from_xml_path(str(bare))
    data, kinematics = mujoco.MjData(model), Kinematics(hand)
    palm = model.body("palm").id
    rng = np.random.default_rng(3)
    for _ in range(5):
        u = rng.uniform(-0.3, 0.3, 4) * [1, 1, 1, 0.02]
        data.qpos[:] = model.qpos0
        for name, value in zip(hand.actuator_names, u, strict=True):
            data.qpos[model.joint(name).qposadr[0]] += value
        mujoco.mj_kinematics(model, data)
        base = np.eye(4)
        base[:3, :3], base[:3, 3] = data.xmat[palm].reshape(3, 3), data.xpos[palm]
        for link in ("palm", "finger", "tip", "slider"):
            theirs = [
                np.linalg.inv(base) @ [*data.geom_xpos[geom], 1.0]
                for geom in range(model.ngeom)
                if model.geom_bodyid[geom] == model.body(link).id and model.geom_contype[geom]
            ]
            ours = [
                kinematics.link_pose(link, u) @ [*shape.xyz, 1.0]
                for shape in hand.urdf.links[link].collisions
                if not (shape.kind == "sphere" and link == "finger")  # a capsule's ends
            ]
            assert np.array(ours) == pytest.approx(np.array(theirs), abs=1e-9), link


def test_limits_count_from_the_drawing_and_groups_say_what_is_seen(odd: Path) -> None:
    hand = imported(odd)
    assert hand.actuator("bend").lower == pytest.approx(np.radians(-50.0))
    assert hand.actuator("bend").upper == pytest.approx(np.radians(70.0))
    assert (hand.actuator("slide").lower, hand.actuator("slide").upper) == pytest.approx(
        (-0.01, 0.02)
    )
    links = hand.urdf.links
    assert [shape.kind for shape in links["slider"].collisions] == ["cylinder"]
    assert len(links["slider"].visuals) == 2
    assert [shape.kind for shape in links["palm"].collisions] == ["mesh"]
    assert [shape.kind for shape in links["finger"].collisions] == ["cylinder", "sphere", "sphere"]
    found = import_mjcf(odd, odd.parent / "made")
    assert found.excluded == (("palm", "slider", "excluded in the MJCF"),)
    # Twice as large as its file, as the model scales it.
    vertices = np.frombuffer(
        (odd.parent / "made/meshes/shell_0.stl").read_bytes()[84:], dtype=np.uint8
    )
    corners = vertices.reshape(-1, 50)[:, 12:48].copy().view("<f4").reshape(-1, 3)
    assert np.ptp(corners, axis=0).max() == pytest.approx(0.02 * np.sqrt(2), rel=0.5)


SAME = (
    "cia402_gripper",
    "dagana",
    "onrobot_3fg15",
    "robotiq_2f_85",
    "robotiq_3f",
    "inspire_rh56",
    "schunk_svh",
)


@pytest.mark.samples("robotiq_2f_85")
@pytest.mark.parametrize("name", SAME)
def test_a_hand_read_back_from_its_own_mjcf_has_the_same_primitives(
    tmp_path: Path, name: str
) -> None:
    export_hand(CONFIG / name, tmp_path, [ExportFormat.MJCF, ExportFormat.SRDF])
    hand = load_hand(CONFIG / name)
    with mjcf_as_urdf(tmp_path / f"{name}.xml") as model:
        again = make_hand(
            name, model.urdf, tmp_path / f"{name}.srdf", into=tmp_path / "config",
            passive=model.passive, excluded=model.excluded,
        ).hand  # fmt: skip
    assert again.actuator_names == hand.actuator_names
    assert [f.tip for f in again.fingers] == [f.tip for f in hand.fingers]
    assert again.rest == pytest.approx(hand.rest, abs=1e-9)
    ours, theirs = (
        {(p.name, p.elements): p for p in extract(h, jobs=1).primitives} for h in (again, hand)
    )
    assert ours.keys() == theirs.keys()
    for key, primitive in theirs.items():
        assert ours[key].posture.involved == primitive.posture.involved
        for actuator in primitive.posture.involved:
            assert ours[key].posture.position[actuator] == pytest.approx(
                primitive.posture.position[actuator], abs=1e-4
            )


@pytest.mark.samples("qb_softhand", "heri_ii", "schunk_svh", "robotiq_2f_85")
@pytest.mark.parametrize(
    "name", sorted(folder.parent.name for folder in CONFIG.glob("*/hand.yaml"))
)
def test_every_hand_read_back_moves_as_it_did(tmp_path: Path, name: str) -> None:
    export_hand(CONFIG / name, tmp_path, [ExportFormat.MJCF])
    hand, again = load_hand(CONFIG / name), imported(tmp_path / f"{name}.xml")
    assert again.actuator_names == hand.actuator_names
    assert (again.lower, again.upper) == (pytest.approx(hand.lower), pytest.approx(hand.upper))
    ours, theirs = Kinematics(again), Kinematics(hand)
    # As far as a polynomial of degree four is off the curves of HERI II.
    close = 1e-9 if hand.transmission.linear else 0.06
    for share in (0.0, 0.3, 1.0):
        u = np.where(np.isfinite(hand.lower), hand.lower + share * (hand.upper - hand.lower), share)
        for link in hand.urdf.links:
            assert ours.link_pose(link, u) == pytest.approx(theirs.link_pose(link, u), abs=close)


def refused(folder: Path, text: str | bytes) -> ModelError:
    file = folder / "hand.xml"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(ModelError) as found:
        import_mjcf(file, folder)
    assert "\n" not in str(found.value)
    assert str(found.value).startswith(str(file))
    return found.value


@pytest.mark.parametrize(
    ("text", "what", "line"),
    [
        ("", "is not XML", 1),
        ("<mujoco><worldbody></mujoco>", "is not XML", 1),
        ("<robot name='a'/>", "URDF (give it with --urdf)", 1),
        ("<sdf/>", "whose root element is <mujoco>", 1),
        ("<mujoco/>", "no joint that a motor could move", None),
        ('<!DOCTYPE m [<!ENTITY a "b">]>\n<mujoco/>', "document type or entities", 1),
        ("<mujoco>\n<worldbody>\n<body tye='1'/></worldbody></mujoco>", "attribute: 'tye'", 3),
        (hand_of("").replace('pos="0 0 0.3">', 'pos="0 0 0.3"><freejoint/>'), "is free", None),
        (hand_of("").replace('range="0 90"', 'type="ball"'), "is a ball joint", None),
        (hand_of('<asset><mesh name="m" file="../../secret.stl"/></asset>'), "outside of", 26),
        (hand_of('<asset><mesh name="m" file="/etc/passwd"/></asset>'), "outside of", 26),
        (hand_of('<asset><texture file="../t.png" type="2d"/></asset>'), "outside of", 26),
        (hand_of('<include file="../../x.xml"/>'), "outside of", 26),
        (hand_of('<include file="x.xml"/>'), "does not exist", 26),
        (hand_of('<asset><model name="m" file="x.xml"/></asset>'), "attaches other models", 26),
        (hand_of('<extension><plugin plugin="p"/></extension>'), "plugin of MuJoCo", 26),
        (hand_of("", fingers='<replicate count="9999999"><site/></replicate>'), "makes many", None),
        (hand_of("", fingers='<flexcomp type="grid" count="999 999 99"/>'), "flexible", None),
        (hand_of("", fingers="<body/>" * 1001), "a hand has at most 300", None),
        (hand_of('<actuator><position joint="c_1"/></actuator>'), "c_1", None),
        (hand_of('<actuator><position body="palm"/></actuator>'), "'body'", None),
        (hand_of('<actuator><adhesion body="palm" ctrlrange="0 1"/></actuator>'), "neither", None),
        (hand_of("").replace('range="0 90"', 'type="slide"', 1), "has no range", None),
        (hand_of(MOTORS).replace('"0 1.2"', '"2 3"'), "do not overlap", None),
    ],
)  # fmt: skip
def test_what_is_no_hand_is_refused_in_a_sentence(
    tmp_path: Path, text: str, what: str, line: int | None
) -> None:
    error = refused(tmp_path, text)
    assert what in error.message
    if line is not None:
        assert error.line == line


def test_missing_meshes_count_where_they_touch(tmp_path: Path) -> None:
    asset = '<asset><mesh name="m" file="m.stl"/></asset>'
    error = refused(tmp_path, hand_of(asset, fingers='<geom type="mesh" mesh="m"/>'))
    assert "mesh 'm.stl' (line 26) does not exist" in error.message
    (tmp_path / "m.stl").write_text("version https://git-lfs")
    error = refused(tmp_path, hand_of(asset, fingers='<geom type="mesh" mesh="m"/>'))
    assert "git lfs pull" in error.message
    seen = hand_of(asset, fingers='<geom type="mesh" mesh="m" contype="0" conaffinity="0"/>')
    assert made(tmp_path, seen).actuator_names == ("a_1", "a_2", "b_1", "b_2")
    assert "a shape was left out: mesh 'm.stl' cannot be read" in notes_of(tmp_path / "hand.xml")


def test_links_in_the_file_system_lead_nowhere_either(tmp_path: Path) -> None:
    outside, inside = tmp_path / "outside", tmp_path / "inside"
    outside.mkdir()
    inside.mkdir()
    (outside / "part.xml").write_text("<mujocoinclude><statistic/></mujocoinclude>")
    (inside / "part.xml").symlink_to(outside / "part.xml")
    error = refused(inside, hand_of('<include file="part.xml"/>'))
    assert "outside of" in error.message
    # Unless the user says so.
    assert import_mjcf(inside / "hand.xml", inside, [outside]).urdf.is_file()


def test_a_huge_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "hand.xml").open("wb") as file:
        file.truncate(65_000_000)
    with pytest.raises(ModelError, match="larger than 64 MB"):
        import_mjcf(tmp_path / "hand.xml", tmp_path)
    monkeypatch.setattr(mjcf_files, "MAX_SIZE", 1000)
    (tmp_path / "part.xml").write_text("<mujocoinclude>" + " " * 2000 + "</mujocoinclude>")
    assert "includes more than" in refused(tmp_path, hand_of('<include file="part.xml"/>')).message


def test_includes_that_include_each_other_end(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text('<mujocoinclude><include file="part.xml"/></mujocoinclude>')
    assert "refuses it" in refused(tmp_path, hand_of('<include file="part.xml"/>')).message


@pytest.mark.parametrize("seed", range(200))
def test_damaged_files_are_read_or_refused(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    text = bytearray(
        hand_of(MOTORS + "<equality><joint joint1='a_2' joint2='b_2'/></equality>").encode()
    )
    for _ in range(int(rng.integers(1, 4))):
        place = int(rng.integers(0, len(text)))
        if rng.random() < 0.5:
            text[place] = int(rng.integers(32, 127))
        else:
            del text[place : place + int(rng.integers(1, 30))]
    file = tmp_path / "hand.xml"
    file.write_bytes(text)
    with contextlib.suppress(ModelError):
        load_model(import_mjcf(file, tmp_path).urdf)


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*RTEE, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_commands_take_mjcf(tmp_path: Path) -> None:
    file = tmp_path / "hand.xml"
    file.write_text(hand_of(MOTORS))
    ran = run("new", "mine", "--mjcf", file, "--into", tmp_path / "config")
    assert ran.returncode == 0, ran.stderr
    hand = load_hand(tmp_path / "config" / "mine")
    assert hand.actuator_names == ("a_1", "a_2", "b_1", "b_2")
    ran = run("extract", "--mjcf", file, "--jobs", 1)
    assert ran.returncode == 0, ran.stderr
    assert "PinchTight" in ran.stdout
    file.write_text("<mujoco>\n<worldbody><light/><bod/></worldbody></mujoco>")
    ran = run("new", "other", "--mjcf", file, "--into", tmp_path / "config")
    assert ran.returncode == 2
    assert ran.stderr.startswith(f"rtee: {file}:2: MuJoCo refuses it: ")
    assert ran.stderr.count("\n") == 1
    assert not (tmp_path / "config" / "other").exists()
    ran = run("new", "other", "--urdf", file, "--into", tmp_path / "config")
    assert "give it by --mjcf" in ran.stderr


SCENE = """<mujoco model="scene">
<worldbody>
  <body name="cube" pos="0.5 0 0.1"><freejoint/><geom name="cube" type="box" size="0.02 0.02 0.02"/>
    <site name="on_cube"/></body>
  <body name="torso" pos="0 0 1"><freejoint name="floating"/><geom size="0.1"/>
    <body name="head" pos="0 0 0.2"><joint name="neck" type="ball"/><geom size="0.05"/></body>
    <body name="arm" pos="0 0.2 0"><joint name="elbow" axis="0 0 1" range="-90 90"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0.1 0"/>
      {palm}
    </body>
  </body>
</worldbody>
<contact><exclude body1="cube" body2="palm"/><pair geom1="cube" geom2="on_palm"/></contact>
<equality><weld body1="cube" body2="head" active="false"/></equality>
<sensor><framepos objtype="site" objname="on_cube"/></sensor>
{motors}
<keyframe><key name="home" qpos="{qpos}"/></keyframe>
</mujoco>"""


def scene() -> str:
    """Return a floating robot with a hand on its arm, and a free object."""
    bare = hand_of("")
    palm = bare[bare.index('<body name="palm"') : bare.index("</worldbody>")]
    palm = palm.replace('type="box" size="0.05', 'name="on_palm" type="box" size="0.05', 1)
    motors = MOTORS.replace("</actuator>", '<position joint="elbow"/></actuator>')
    free = "0 0 0 1 0 0 0 "
    return SCENE.format(palm=palm, motors=motors, qpos=free + free + "1 0 0 0 " + "0 " * 5)


def test_a_hand_is_taken_out_of_a_floating_robot_among_free_objects(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(scene())
    into = ("--into", tmp_path / "config")
    ran = run("new", "mine", "--mjcf", file, "--root", "palm", *into)
    assert ran.returncode == 0, ran.stderr
    said = ran.stdout + ran.stderr
    assert "body 'cube' is free and not part of the hand, so it is left out" in said
    for body in ("torso", "head"):
        assert f"body '{body}', outside the hand, stands still as drawn" in said
    (tmp_path / "alone").mkdir()
    alone = made(tmp_path / "alone", hand_of(MOTORS))
    hand = load_hand(tmp_path / "config" / "mine")
    assert hand.actuator_names == alone.actuator_names
    assert (hand.lower, hand.upper) == (pytest.approx(alone.lower), pytest.approx(alone.upper))
    u = 0.5 * np.array(alone.upper)
    for link in ("a_tip", "b_tip"):
        assert Kinematics(hand).link_pose(link, u) == pytest.approx(
            Kinematics(alone).link_pose(link, u), abs=1e-9
        )


def test_a_hand_whose_own_base_floats_is_taken_as_it_stands(tmp_path: Path) -> None:
    file = tmp_path / "afloat.xml"
    palm = '<body name="palm" pos="0 0 0.3">'
    bare = hand_of(MOTORS)
    assert palm in bare
    file.write_text(bare.replace(palm, f"{palm}<freejoint/>"))
    ran = run("new", "mine", "--mjcf", file, "--root", "palm", "--into", tmp_path / "config")
    assert ran.returncode == 0, ran.stderr
    assert "body 'palm', the hand's base, stands still as drawn" in ran.stdout + ran.stderr


def test_without_a_root_or_with_an_unknown_one_a_floating_robot_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(scene())
    with pytest.raises(ModelError, match=r"is free; .* with --root"):
        import_mjcf(file, tmp_path)
    with pytest.raises(ModelError, match=r"'plam'.*palm"):
        import_mjcf(file, tmp_path, root="plam")
    # A joint of the hand itself stays what it is.
    with pytest.raises(ModelError, match="is a ball joint"):
        import_mjcf(file, tmp_path, root="torso")


def test_passive_joints_and_excluded_pairs_stay_with_a_given_srdf(tmp_path: Path) -> None:
    text = hand_of(
        '<actuator><position joint="a_1"/><position joint="b_1"/></actuator>'
        '<contact><exclude body1="a_tip" body2="b"/></contact>'
    )
    (tmp_path / "hand.xml").write_text(text)
    (tmp_path / "g.srdf").write_text(
        '<robot name="two"><group name="a"><chain base_link="palm" tip_link="a_tip"/></group>'
        "</robot>"
    )
    with mjcf_as_urdf(tmp_path / "hand.xml") as model:
        hand = make_hand("mine", model.urdf, tmp_path / "g.srdf", into=tmp_path / "config",
                         passive=model.passive, excluded=model.excluded).hand  # fmt: skip
    assert [j.name for j in hand.joints if j.role is JointRole.PASSIVE] == ["a_2", "b_2"]
    assert ("a_tip", "b", "excluded in the MJCF") in [
        (*sorted(pair[:2]), pair[2]) for pair in hand.disabled_collisions
    ]


@pytest.mark.parametrize("number", ["nan", "inf", "-1e300", "0 1e11 0"])
def test_numbers_without_an_end_are_refused_where_they_are(tmp_path: Path, number: str) -> None:
    text = hand_of(f"<tendon><fixed><joint joint='a_1' coef='{number}'/></fixed></tendon>")
    error = refused(tmp_path, text)
    assert "not finite or beyond 1e+10" in error.message
    assert error.line == 26


def test_what_mujoco_warns_of_is_noted_and_written_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    old = '<joint name="a_2" axis="0 1 0" range="0 90"/>'
    light = old + '<inertial pos="0 0 0" mass="1e9" diaginertia="1e-14 1e-14 1e-14"/>'
    light += old.replace("a_2", "a_3")  # twice about the same axis
    made(tmp_path, hand_of(MOTORS).replace(old, light))
    assert "MuJoCo warns" in notes_of(tmp_path / "hand.xml")
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_frames_and_meshes_as_obj(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "pad.obj").write_text(PAD)
    head = '<compiler meshdir="assets"/><asset><mesh file="pad.obj"/></asset>'
    fingers = """<frame pos="0 0.03 0" euler="0 0 90"><body name="c" pos="0.01 0 0">
      <joint name="c_1" axis="1 0 0" range="0 30"/><geom type="mesh" mesh="pad"/></body></frame>"""
    extra = MOTORS.replace("</actuator>", '<motor joint="c_1" ctrlrange="-1 1"/></actuator>')
    hand = made(tmp_path, hand_of(extra, fingers=fingers, head=head))
    joint = hand.urdf.joints["c_1"]
    assert joint.xyz == pytest.approx((0.0, 0.04, 0.0), abs=1e-12)
    assert joint.rpy == pytest.approx((0.0, 0.0, np.pi / 2))
    (pad,) = hand.urdf.links["c"].collisions
    vertices, _ = HandGeometry(hand).triangles("c")
    # Where the file has them, though MuJoCo moves a mesh to its centre of mass.
    assert vertices.min(axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-7)
    assert vertices.max(axis=0) == pytest.approx([0.01, 0.02, 0.03], abs=1e-7)
    assert pad.kind == "mesh"


def test_a_passive_joint_that_does_not_exist_is_told(tmp_path: Path) -> None:
    file = tmp_path / "hand.xml"
    file.write_text(hand_of(MOTORS))
    found = import_mjcf(file, tmp_path)
    with pytest.raises(ModelError, match="unknown joint 'nobody' under 'passive'"):
        load_model(found.urdf, passive=("nobody",))


def test_a_mesh_that_mujoco_would_make_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "hand.xml"
    asset = '<asset><mesh name="big" builtin="supersphere" params="1000 1 1"/></asset>'
    file.write_text(hand_of(MOTORS).replace("<worldbody>", f"{asset}<worldbody>", 1))
    with pytest.raises(ModelError, match="a mesh that MuJoCo generates cannot be read"):
        import_mjcf(file, tmp_path)
