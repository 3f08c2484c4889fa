"""Mass, motors and couplings are those of the hand: known, or derived with a note."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.scene import build_hand, grasp_centre, make_simulation
from rtee.drivers.mujoco.servos import effort_note
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ConfigError, ModelError
from rtee.hand.catalog import hand_names
from rtee.hand.config_schema import ActuatorDynamics
from rtee.hand.load import hand_folder, load_hand, load_model
from rtee.hand.model import Hand
from rtee.trials.grasp_placement import Places
from rtee.trials.trial import Trial
from rtee.trials.work import attempt
from rtee.types import JointKind


def simulate(hand: Hand, **options: object) -> Simulation:
    return make_simulation(hand, SimOptions(**options), hand.actuator_names, 0.004)


def run(simulation: Simulation, goal: np.ndarray, seconds: float) -> None:
    everything = np.ones(len(goal), dtype=bool)
    for _ in range(round(seconds / 0.004)):
        simulation.command(goal, np.full(len(goal), np.inf), everything)
        simulation.advance()


@pytest.mark.samples("robotiq_3f", "heri_ii", "qb_softhand", "schunk_svh")
@pytest.mark.parametrize("name", hand_names())
def test_mass_and_its_distribution_are_those_of_the_urdf(name: str) -> None:
    hand = load_hand(name)
    model = simulate(hand).model
    checked = 0
    for link, found in hand.urdf.links.items():
        if found.inertia is None or not found.mass > 0.0:
            continue
        body = model.body(LINK + link)
        assert body.mass[0] == pytest.approx(found.mass, rel=1e-6)
        assert body.ipos == pytest.approx(found.inertia.xyz, abs=1e-9)
        xx, xy, xz, yy, yz, zz = found.inertia.moments
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert sorted(body.inertia) == pytest.approx(moments.tolist(), rel=1e-4, abs=1e-12)
        checked += 1
    assert checked


TILTED = """<robot name="rod"><link name="base"/><link name="rod"><inertial>
<origin xyz="0.01 0.02 0.03" rpy="0 0 1.5707963"/><mass value="0.2"/>
<inertia ixx="{xx}" ixy="0" ixz="0" iyy="2e-4" iyz="0" izz="2.5e-4"/></inertial>
<collision><geometry><sphere radius="0.01"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="2" effort="{effort}"/></joint></robot>
"""


def rod(folder: Path, xx: str = "1e-4", effort: str = "2") -> Hand:
    path = folder / "rod.urdf"
    path.write_text(TILTED.format(xx=xx, effort=effort))
    return load_model(path)


def test_an_inertia_that_is_turned_in_its_link_stays_turned(tmp_path: Path) -> None:
    model = simulate(rod(tmp_path)).model
    body = model.body(LINK + "rod")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    tensor = turn.reshape(3, 3) @ np.diag(body.inertia) @ turn.reshape(3, 3).T
    assert np.diag(tensor) == pytest.approx([2e-4, 1e-4, 2.5e-4], rel=1e-5)


def test_an_inertia_that_no_body_can_have_is_replaced_and_noted(tmp_path: Path) -> None:
    built = build_hand(rod(tmp_path, xx="1e-2"), SimOptions())
    assert any("inertia assumed for 1 link(s): rod" in note for note in built.notes)
    assert built.spec.compile().body(LINK + "rod").mass[0] == pytest.approx(0.2)


def test_fingers_have_weight(tmp_path: Path) -> None:
    hand = replace(rod(tmp_path), dynamics={"turn": ActuatorDynamics(dry_friction=0.0)})
    simulation = simulate(hand)
    run(simulation, hand.rest, 1.0)
    lever = 0.2 * 9.81 * 0.01  # the centre of mass is 10 mm beside the axis
    assert abs(simulation.effort[0]) == pytest.approx(lever, rel=0.05)


def test_a_large_effort_limit_is_no_missing_one(tmp_path: Path) -> None:
    assert build_hand(rod(tmp_path, effort="25"), SimOptions()).servos["turn"].limit == 25.0
    assert effort_note(rod(tmp_path)) == []
    lacking = rod(tmp_path, effort="0")
    assert build_hand(lacking, SimOptions()).servos["turn"].limit == 10.0
    (note,) = effort_note(lacking)
    assert note.startswith("no effort limit for actuator turn; 10 N·m is assumed")
    both = (
        *lacking.actuators,
        replace(lacking.actuators[0], name="slide", kind=JointKind.PRISMATIC),
    )
    (note,) = effort_note(replace(lacking, actuators=both))
    assert note.startswith(
        "no effort limit for actuators turn, slide; 10 N·m and 1000 N are assumed"
    )


@pytest.mark.samples("robotiq_2f_85-*")
@pytest.mark.parametrize(("name", "sheet"), [("robotiq_2f_85", 235.0), ("robotiq_2f_140", 125.0)])
def test_grippers_grip_as_strongly_as_their_sheets_say(name: str, sheet: float) -> None:
    # A cube lies at the fingertips, where the sheets give the force; a longer object also lies
    # nearer to the linkage, which presses harder there.
    result = attempt(name, Trial("Grasp", object="box:0.04x0.04x0.04"))
    assert result.held, result.reason
    assert dict(result.forces)["finger_1"] == pytest.approx(sheet, rel=0.1)


def test_what_hand_yaml_knows_of_a_motor_is_used_and_the_rest_is_told() -> None:
    hand = load_hand("allegro")
    built = build_hand(hand, SimOptions())
    servo = built.servos["joint_0"]
    assert (servo.kp, servo.kd) == (1.0, 0.04)
    model = built.spec.compile()
    row = model.actuator("joint_0").id
    assert model.actuator_gainprm[row, 0] == 1.0
    assert model.actuator_biasprm[row, 1:3] == pytest.approx([-1.0, -0.04])
    note = next(note for note in built.notes if "'joint_0'" in note)
    assert "armature" in note
    assert "kp" not in note
    derived = build_hand(load_hand("heri_ii"), SimOptions()).notes
    assert any("'motor_thumb'" in note and "kp 66" in note for note in derived)


def test_the_integral_gain_takes_the_weight(tmp_path: Path) -> None:
    soft = replace(
        rod(tmp_path), dynamics={"turn": ActuatorDynamics(kp=1.0, kd=0.1, dry_friction=0.0)}
    )
    simulation = simulate(soft)
    run(simulation, soft.rest, 2.0)
    assert abs(simulation.position[0]) > 0.015
    simulation.set_gain("ki.turn", 2.0)
    run(simulation, soft.rest, 4.0)
    assert abs(simulation.position[0]) < 0.002
    simulation.set_gain("ki.turn", 0.0)
    run(simulation, soft.rest, 2.0)
    assert abs(simulation.position[0]) > 0.015


def test_an_integral_never_exceeds_the_effort_limit(tmp_path: Path) -> None:
    hand = replace(rod(tmp_path), dynamics={"turn": ActuatorDynamics(ki=100.0)})
    simulation = simulate(hand)
    simulation.command(np.array([0.8]), np.array([0.05]), np.ones(1, dtype=bool))
    for _ in range(500):
        simulation.advance()
        assert abs(simulation.effort[0]) <= 0.05 + 1e-9
    run(simulation, np.array([0.2]), 2.0)
    assert simulation.position[0] == pytest.approx(0.2, abs=0.02)


def test_after_a_reset_all_goes_as_at_first(tmp_path: Path) -> None:
    hand = replace(rod(tmp_path), dynamics={"turn": ActuatorDynamics(kp=1.0, kd=0.1, ki=2.0)})
    simulation = simulate(hand)
    ways = []
    for _ in range(2):
        way = []
        for _ in range(100):
            simulation.advance()
            way.append(float(simulation.position[0]))
        ways.append(way)
        simulation.command(np.array([0.8]), np.array([0.01]), np.ones(1, dtype=bool))
        simulation.advance()
        simulation.power(False)
        simulation.reset()
    assert ways[0] == ways[1]
    assert simulation.model.actuator_forcerange[0].tolist() == [-2.0, 2.0]


def fixed_object(hand: Hand, shape: str, offset: tuple[float, float, float]) -> Simulation:
    """Return a hand around an object that does not move, beside the middle of the fingertips."""
    place = np.eye(4)
    place[:3, 3] = grasp_centre(hand) + np.array(offset)
    options = SimOptions(object=shape, support="floating", gravity=0.0)
    simulation = make_simulation(hand, options, hand.actuator_names, 0.004, place=place)
    dof = int(simulation.model.joint("object").dofadr[0])
    simulation.model.dof_armature[dof : dof + 6] = 1e3
    return simulation


ADAPTIVE = {
    "robotiq_3f": ("sphere:0.04", (0.0, 0.02, 0.0)),
    "heri_ii": ("sphere:0.03", (0.0, 0.0, -0.03)),
    "qb_softhand": ("cylinder:0.025x0.3", (0.0, 0.0, 0.0)),
    "robotiq_2f_85": ("cylinder:0.02x0.1", (0.0, 0.01, 0.0)),
    "robotiq_2f_140": ("sphere:0.03", (0.0, 0.0, -0.03)),
}


@pytest.mark.samples("robotiq_3f", "heri_ii", "robotiq_2f_85")
@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_finger_that_is_stopped_lets_the_others_go_on(name: str) -> None:
    shape, offset = ADAPTIVE[name]
    adaptive = load_hand(name)
    ends = []
    for hand in (replace(adaptive, dynamics={}), adaptive):
        goal = np.where(
            np.abs(hand.upper - hand.rest) >= np.abs(hand.lower - hand.rest), hand.upper, hand.lower
        )
        if name == "robotiq_3f":
            goal[0] = 0.0  # the spread stays in the middle
        simulation = fixed_object(hand, shape, offset)
        run(simulation, goal, 2.4)
        error = simulation.joints - hand.transmission.joints(simulation.hand_position)
        coupled = [c.actuator is not None for c in hand.transmission.couplings]
        ends.append((simulation.hand_position - hand.rest, error[coupled]))
    (stiff, _), (soft, lag) = ends
    share = np.abs(soft) - np.abs(stiff)
    assert share.max() > 0.02  # an actuator goes on where a rigid transmission stops it
    assert lag.min() < -0.05  # joints that are stopped stay behind
    assert lag.max() > 0.05  # … and others are ahead


def test_fingers_share_the_effort_of_their_actuator() -> None:
    hand = load_hand("robotiq_3f")
    simulation = fixed_object(hand, "cylinder:0.025x0.3", (0.02, 0.0, 0.0))
    run(simulation, np.array([0.0, hand.upper[1]]), 2.4)
    forces = simulation.contact_forces
    assert forces.min() > 0.7 * forces.max()


@pytest.mark.parametrize("name", ADAPTIVE)
def test_without_an_object_joints_follow_as_the_transmission_says(name: str) -> None:
    hand = load_hand(name)
    simulation = simulate(hand)
    goal = hand.rest + 0.2 * (np.nan_to_num(hand.upper, posinf=1.0) - hand.rest)
    run(simulation, goal, 2.0)
    coupled = [c.actuator is not None for c in hand.transmission.couplings]
    follows = hand.transmission.joints(simulation.hand_position)
    assert simulation.hand_position == pytest.approx(goal, abs=0.02)
    assert simulation.joints[coupled] == pytest.approx(follows[coupled], abs=0.02)


def configured(folder: Path, dynamics: str) -> Hand:
    source = hand_folder("robotiq_3f")[0]
    text = (source / "hand.yaml").read_text()
    begin, end = text.index("dynamics:"), text.index("loop:")
    for file in ("robotiq_3f.urdf", "robotiq_3f.srdf"):
        (folder / file).write_bytes((source / file).read_bytes())
    (folder / "hand.yaml").write_text(text[:begin] + dynamics + text[end:])
    return load_hand(folder)


def test_shares_give_the_relation_of_torques(tmp_path: Path) -> None:
    text = "dynamics:\n  finger_1_joint_1: {coupling: tendon, shares: {'*_joint_1': 3, '*_2': 1}}\n"
    known = configured(tmp_path, text).dynamics["finger_1_joint_1"]
    assert known.joints is not None
    assert len(known.joints) == 6
    assert known.shares == {name: 3.0 if name.endswith("_1") else 1.0 for name in known.joints}
    simulation = simulate(configured(tmp_path, text))
    tendon = simulation.model.tendon("tendon/finger_1_joint_1")
    first = int(simulation.model.tendon_adr[tendon.id])
    weights = simulation.model.wrap_prm[first : first + 6]
    assert weights[0] / weights[1] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dynamics:\n  finger_9: {kp: 1.0}\n\n", "finger_9: unknown actuator"),
        ("dynamics:\n  finger_1_joint_1: {joints: ['thumb*']}\n\n", "is called 'thumb\\*'"),
        ("dynamics:\n  finger_1_joint_1: {kp: -1.0}\n\n", "greater than 0"),
        ("dynamics:\n  finger_1_joint_1: {stiff: 1.0}\n\n", "unknown key"),
    ],
)
def test_a_mistake_in_the_dynamics_names_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        configured(tmp_path, text)
    assert error.value.line


def test_shares_that_move_nothing_are_refused(tmp_path: Path) -> None:
    text = (
        "dynamics:\n  palm_finger_1_joint:\n    coupling: tendon\n"
        "    shares: {palm_finger_1_joint: 1, palm_finger_2_joint: 1}\n\n"
    )
    with pytest.raises(ModelError, match="moves no joint"):
        build_hand(configured(tmp_path, text), SimOptions())


def test_each_finger_of_a_linkage_shares_among_its_own_joints(tmp_path: Path) -> None:
    text = "dynamics:\n  finger_1_joint_1: {coupling: linkage}\n"
    model = simulate(configured(tmp_path, text)).model
    names = {model.tendon(number).name for number in range(model.ntendon)}
    fingers = {"finger_1", "finger_2", "finger_middle"}
    assert {name for name in names if name.startswith("tendon/")} == {
        f"tendon/finger_1_joint_1/{finger}" for finger in fingers
    }
    for finger in fingers:
        tendon = model.tendon(f"tendon/finger_1_joint_1/{finger}").id
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        joints = [model.joint(i).name for i in model.wrap_objid[first : first + count]]
        assert joints[:-1] == [f"{finger}_joint_{number}" for number in (1, 2, 3)]


@pytest.mark.parametrize(("coupling", "back"), [("tendon", True), ("linkage", False)])
def test_fingers_of_linkages_do_not_push_one_another_back(
    tmp_path: Path, coupling: str, back: bool
) -> None:
    text = f"dynamics:\n  finger_1_joint_1: {{coupling: {coupling}}}\n"
    hand = configured(tmp_path, text)
    simulation = simulate(hand, object="box:0.05x0.05x0.05", support="floating", gravity=0.0)
    library = ActionLibrary.load(load_hand("robotiq_3f"), hand_folder("robotiq_3f")[0] / "actions")
    place = Places(simulation, hand, library.find("Grasp")).find(1)[0]
    simulation.reset()
    around = simulation.surroundings
    around.place(around.base_pose @ place.pose)
    before = around.position_in_hand[0]
    simulation.command(np.array([0.0, 0.6]), np.array([8.0, 4.9]), np.ones(2, dtype=bool))
    for _ in range(round(2.0 / 0.004)):
        simulation.advance()
    # Two fingers against one: along x they close.
    assert bool(abs(around.position_in_hand[0] - before) > 0.02) == back
    assert min(simulation.contact_forces) > 1.0


@pytest.mark.parametrize("radius", [0.01, 0.025, 0.035])
def test_a_grip_opens_at_once(radius: float) -> None:
    """The reference has gone on into the object; it does not come back from there first."""
    hand = load_hand("robotiq_2f_85")
    simulation = simulate(hand, object=f"sphere:{radius}")
    closed = hand.rest + 0.8
    run(simulation, closed, 2.0)
    gripped = simulation.position
    assert (gripped < closed - 0.05).all()
    run(simulation, hand.rest, 0.1)
    assert (simulation.position < gripped - 0.05).all()
