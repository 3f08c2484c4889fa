"""Every hand becomes a model whose couplings hold; what can't be simulated is refused."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtee.errors import ConfigError, ModelError
from rtee.hand.catalog import hand_names
from rtee.hand.load import load_hand, load_model

pytest.importorskip("mujoco")

from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.scene import approach, build_hand, downward, make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.model import Hand, JointRole


def simulate(hand: Hand, period: float = 0.004, **options: object) -> Simulation:
    return make_simulation(hand, SimOptions(**options), hand.actuator_names, period)


def model(folder: Path, body: str) -> Hand:
    path = folder / "test.urdf"
    path.write_text(f'<robot name="test"><link name="base"/>{textwrap.dedent(body)}</robot>')
    return load_model(path)


SHAPE = '<collision><origin xyz="{}"/><geometry><box size="{}"/></geometry></collision>'
TIP = f'<link name="tip">{SHAPE.format("0 0 0.05", "0.01 0.01 0.05")}</link>'
LIMIT = '<limit lower="0" upper="1" velocity="2" effort="1"/>'


def joint(name: str, child: str, more: str = LIMIT, at: str = "0 0 0") -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="base"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="1 0 0"/>{more}</joint>'
    )


@pytest.mark.samples("dagana")
@pytest.mark.parametrize("name", ["dagana", "heri_ii", "qb_softhand"])
def test_a_kept_model_with_another_friction_is_the_one_built_anew(name: str) -> None:
    hand = load_hand(name)
    kept = build_hand(hand, SimOptions())
    for friction in (0.3, None):  # the second one shows that the first left no trace
        options = SimOptions(object="drill", object_scale=1.07, friction=friction, carrier="arm")
        anew, copied = (
            make_simulation(hand, options, hand.actuator_names, 0.004, built=built)
            for built in (None, kept)
        )
        arrays = [
            field
            for field in dir(anew.model)
            if isinstance(getattr(anew.model, field), np.ndarray) and not field.startswith("_")
        ]
        assert {"geom_friction", "pair_friction", "body_inertia", "wrap_prm"} < set(arrays)
        for field in arrays:
            both = (getattr(one.model, field).tobytes() for one in (anew, copied))
            assert next(both) == next(both), field
        assert copied.notes == anew.notes
        assert copied.data.qacc.tobytes() == anew.data.qacc.tobytes()


@pytest.mark.samples("robotiq_3f", "heri_ii", "qb_softhand", "schunk_svh")
@pytest.mark.parametrize("name", hand_names())
def test_every_hand_compiles_and_its_couplings_hold(name: str) -> None:
    hand = load_hand(name)
    simulation = simulate(hand, gravity=0.0)
    assert simulation.model.nu == len(hand.actuators)
    assert simulation.joints == pytest.approx(hand.transmission.joints(hand.rest), abs=1e-9)
    assert len(simulation.data.contact) == 0
    goal = hand.rest + 0.15 * (np.nan_to_num(hand.upper, posinf=1.0) - hand.rest)
    everything = np.ones(len(goal), dtype=bool)
    for share in np.linspace(0.0, 1.0, 120):
        reference = hand.rest + share * (goal - hand.rest)
        simulation.command(reference, np.full(len(goal), np.inf), everything)
        simulation.advance()
        coupled = [r for r, c in enumerate(hand.transmission.couplings) if c.actuator is not None]
        follows = hand.transmission.joints(simulation.position)
        assert simulation.joints[coupled] == pytest.approx(follows[coupled], abs=5e-3)
    for _ in range(100):
        simulation.advance()
    assert simulation.position == pytest.approx(goal, abs=0.02)


def test_what_was_made_up_is_noted(tmp_path: Path) -> None:
    hand = model(
        tmp_path,
        joint("bend", "tip", '<limit lower="0" upper="1" velocity="2" effort="0"/>') + TIP,
    )
    notes = " ".join(build_hand(hand, SimOptions()).notes)
    assert "mass assumed for 1 link(s): tip" in notes
    assert "actuator 'bend': kp 200, critical damping" in notes


def test_the_error_of_a_single_polynomial_is_stated() -> None:
    rigid = replace(load_hand("heri_ii"), dynamics={})
    notes = build_hand(rigid, SimOptions()).following
    assert any("LFB1__LFP1_1" in note and "off" in note for note in notes)


def test_the_mass_of_the_urdf_is_kept() -> None:
    hand = load_hand("robotiq_3f")
    simulation = simulate(hand)
    given = {n: link for n, link in hand.urdf.links.items() if link.has_inertial and link.mass > 0}
    assert given
    for name, link in given.items():
        assert simulation.model.body(LINK + name).mass[0] == pytest.approx(link.mass, rel=1e-6)


def test_without_limits_it_is_refused(tmp_path: Path) -> None:
    hand = model(
        tmp_path,
        joint("bend", "tip") + TIP,
    )
    endless = replace(hand, actuators=(replace(hand.actuators[0], upper=np.inf),))
    with pytest.raises(ModelError, match="'bend' has no limits"):
        build_hand(endless, SimOptions())


def test_a_massless_passive_chain_is_refused(tmp_path: Path) -> None:
    hand = model(
        tmp_path,
        joint("bend", "tip")
        + TIP
        + joint("loose", "nothing")
        + '<link name="nothing"/><link name="end"/>'
        + '<joint name="fix" type="fixed"><parent link="nothing"/><child link="end"/></joint>',
    )
    joints = tuple(
        replace(j, role=JointRole.PASSIVE) if j.name == "loose" else j for j in hand.joints
    )
    with pytest.raises(ModelError, match=r"'loose' carries neither mass.*'nothing', 'end'"):
        build_hand(replace(hand, joints=joints), SimOptions())


def test_fingers_inside_each_other_are_refused(tmp_path: Path) -> None:
    hand = model(
        tmp_path,
        "".join(
            joint(f"bend_{n}", f"tip_{n}", at=f"{x} 0 0")
            + f'<link name="tip_{n}">{SHAPE.format("0 0 0.05", "0.02 0.02 0.08")}</link>'
            for n, x in (("a", 0.0), ("b", 0.008))
        ),
    )
    assert len(hand.fingers) == 2
    with pytest.raises(ModelError, match="'tip_a' and 'tip_b' of two fingers"):
        build_hand(hand, SimOptions())


FLAT = "v 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nv 0.05 0.05 0\nf 1 2 3\nf 2 4 3\n"


def test_a_mesh_of_the_hand_without_volume_is_refused(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text(FLAT)
    shape = '<collision><geometry><mesh filename="flat.obj"/></geometry></collision>'
    hand = model(tmp_path, joint("bend", "tip") + f'<link name="tip">{shape}</link>')
    with pytest.raises(ModelError, match=r"test\.urdf: cannot be simulated: mesh 'tip/0' .*planar"):
        build_hand(hand, SimOptions())


@pytest.mark.parametrize(
    ("name", "content"),
    [("flat.obj", FLAT), ("text.stl", "solid a\nendsolid a\n"), ("empty.obj", "")],
)
def test_a_mesh_of_an_object_that_is_none_is_refused(
    tmp_path: Path, name: str, content: str
) -> None:
    hand = model(tmp_path, joint("bend", "tip") + TIP)
    (tmp_path / name).write_text(content)
    with pytest.raises(ConfigError, match="cannot be simulated") as caught:
        simulate(hand, object=str(tmp_path / name))
    assert caught.value.path == tmp_path / name
    assert "\n" not in str(caught.value)


def test_pairs_disabled_in_the_srdf_are_never_checked() -> None:
    hand = load_hand("schunk_svh")
    assert hand.disabled_collisions
    first, second, _ = hand.disabled_collisions[0]
    spec = build_hand(hand, SimOptions()).spec
    excluded = {frozenset((e.bodyname1, e.bodyname2)) for e in spec.excludes}
    assert frozenset((LINK + first, LINK + second)) in excluded


@pytest.mark.samples("robotiq_3f", "heri_ii", "qb_softhand", "schunk_svh")
@pytest.mark.parametrize("name", hand_names())
def test_a_carried_hand_reaches_down(name: str) -> None:
    hand = load_hand(name)
    assert downward(hand) @ approach(hand) == pytest.approx([0.0, 0.0, -1.0])
    assert np.linalg.det(downward(hand)) == pytest.approx(1.0)


@pytest.mark.parametrize("carrier", ["lift", "arm"])
def test_a_hand_whose_base_is_but_a_frame_is_carried(tmp_path: Path, carrier: str) -> None:
    hand = model(tmp_path, joint("bend", "tip") + TIP)
    simulation = simulate(hand, carrier=carrier)
    simulation.surroundings.carry(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    for _ in range(250):
        simulation.advance()
    assert simulation.surroundings.base_pose[2, 3] == pytest.approx(0.1, abs=2e-3)


def test_real_models_with_meshes_compile_without_deep_contacts(shared: Path) -> None:
    folder = shared / "hands" / "robotiq_2f_85"
    urdf, srdf = folder / "robotiq_2f_85.urdf", folder / "robotiq_2f_85.srdf"
    simulation = simulate(load_model(urdf, srdf, package_dirs=[folder, folder.parent]))
    assert simulation.model.nmesh
    assert not [c for c in simulation.data.contact if c.dist < -1e-3]


@pytest.mark.parametrize("carrier", ["fixed", "arm"])
def test_a_claw_closes_against_the_jaw_it_turns_on(carrier: str) -> None:
    hand = load_hand("dagana")
    simulation = simulate(hand, carrier=carrier)
    goal = hand.upper.copy()
    for _ in range(400):
        simulation.command(goal, np.full(1, np.inf), np.ones(1, dtype=bool))
        simulation.advance()
    assert simulation.position[0] == pytest.approx(0.968, abs=0.01)  # the tips meet there
    assert simulation.contact_forces.min() > 10.0
    notes = build_hand(hand, SimOptions()).notes
    assert any("only their outer shapes" in note for note in notes)
