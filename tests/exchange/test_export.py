"""Exported models load elsewhere, and move as rtee says."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pin = pytest.importorskip("pinocchio")

from hand.models import GRIPPER, check_meshes  # noqa: E402
from rtee_process import RTEE  # noqa: E402

from rtee.drivers.mujoco.couplings import fit, followers, span  # noqa: E402
from rtee.errors import ConfigError  # noqa: E402
from rtee.exchange.export import ExportFormat, export_hand  # noqa: E402
from rtee.hand.kinematics import Kinematics  # noqa: E402
from rtee.hand.load import load_hand, load_model  # noqa: E402
from rtee.hand.model import Hand  # noqa: E402
from rtee.hand.scaffold import make_hand  # noqa: E402
from rtee.sample import FloatArray  # noqa: E402

CONFIG = Path(__file__).parents[2] / "config"
HANDS = sorted(folder.parent.name for folder in CONFIG.glob("*/hand.yaml"))
LINEAR = 1e-9  # [m] and in entries of rotations
FITTED = 1e-4  # [rad]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    for name in HANDS:
        export_hand(CONFIG / name, folder)
    return folder


@cache
def hand_of(name: str) -> Hand:
    return load_hand(CONFIG / name)


def postures(hand: Hand) -> list[FloatArray]:
    at = np.random.default_rng(0).random((5, len(hand.actuators)))
    lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
    upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
    return [hand.rest, lower, upper, *(lower + at * (upper - lower))]


def coupled(model: mujoco.MjModel, u: dict[str, float]) -> dict[str, float]:
    """Return where a model's own equalities and springs have its joints, from the motors'."""
    q = {model.joint(int(model.actuator_trnid[i, 0])).name: u[model.actuator(i).name]
         for i in range(model.nu)}  # fmt: skip
    follows: dict[str, tuple[str | None, np.ndarray]] = {}
    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT:
            other = int(model.eq_obj2id[i])
            name = model.joint(int(model.eq_obj1id[i])).name
            follows[name] = (model.joint(other).name if other >= 0 else None, model.eq_data[i, :5])
    for i in range(model.ntendon):
        if model.tendon_stiffness[i] > 0:
            first = int(model.tendon_adr[i])
            one, two = model.wrap_objid[first : first + 2]
            a, b = model.wrap_prm[first : first + 2]
            line = np.array([model.tendon_lengthspring[i, 0], -b, 0, 0, 0]) / a
            follows[model.joint(int(one)).name] = (model.joint(int(two)).name, line)
    while any(name not in q for name in follows):
        for name, (master, data) in follows.items():
            if master is None or master in q:
                q[name] = float(np.polynomial.polynomial.polyval(q[master] if master else 0, data))
    return q


def allowed(hand: Hand) -> dict[str, float]:
    """Return how far each joint may be off [rad | m]: what its best polynomial is, and 1e-4."""
    found = dict.fromkeys(hand.joint_names, LINEAR)
    for f in followers(hand):
        if not f.coupling.linear:
            found[f.joint] = fit(f.coupling, *span(f.actuator))[1] + FITTED
    return found


@pytest.mark.samples("dagana", "qb_softhand", "robotiq_*", "schunk_svh", "wsg50")
@pytest.mark.parametrize("name", HANDS)
def test_mjcf_moves_in_mujoco_as_the_hand_does(out: Path, name: str) -> None:
    hand, model = hand_of(name), mujoco.MjModel.from_xml_path(str(out / f"{name}.xml"))
    data, kinematics, limits = mujoco.MjData(model), Kinematics(hand), allowed(hand)
    straight = hand.transmission.linear
    for u in postures(hand):
        q = coupled(model, dict(zip(hand.actuator_names, u.tolist(), strict=True)))
        truth = dict(zip(hand.joint_names, hand.transmission.joints(u).tolist(), strict=True))
        for joint, value in truth.items():
            # Passive joints follow nothing; they are set.
            assert abs(q.setdefault(joint, value) - value) <= limits[joint], joint
        # With the joints where rtee has them, every link is where rtee has it, whatever the curve.
        for values in (q, truth) if straight else (truth,):
            for joint, value in values.items():
                data.qpos[model.joint(joint).qposadr[0]] = value
            mujoco.mj_kinematics(model, data)
            for link in hand.urdf.links:
                pose, body = kinematics.link_pose(link, u), model.body(link).id
                assert data.xpos[body] == pytest.approx(pose[:3, 3], abs=LINEAR)
                assert data.xmat[body] == pytest.approx(pose[:3, :3].ravel(), abs=LINEAR)


@pytest.mark.samples("*-robotiq_*", "*-qb_softhand", "*-schunk_svh")
@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("suffix", ["xml", "urdf"])
def test_both_move_in_pinocchio_as_the_hand_does(out: Path, name: str, suffix: str) -> None:
    hand, file = hand_of(name), str(out / f"{name}.{suffix}")
    model = pin.buildModelFromMJCF(file) if suffix == "xml" else pin.buildModelFromUrdf(file)
    data, kinematics = model.createData(), Kinematics(hand)
    for u in postures(hand):
        q = pin.neutral(model)
        for joint, value in zip(hand.joint_names, hand.transmission.joints(u), strict=True):
            found = model.joints[model.getJointId(joint)]
            # A continuous joint has a cosine and a sine.
            q[found.idx_q : found.idx_q + found.nq] = (
                [value] if found.nq == 1 else [np.cos(value), np.sin(value)]
            )
        pin.framesForwardKinematics(model, data, q)
        for link in hand.urdf.links:
            pose, frame = kinematics.link_pose(link, u), data.oMf[model.getFrameId(link)]
            assert frame.translation == pytest.approx(pose[:3, 3], abs=LINEAR)
            assert frame.rotation == pytest.approx(pose[:3, :3], abs=LINEAR)


@pytest.mark.parametrize("name", HANDS)
def test_the_urdf_loads_in_mujoco_with_every_link_and_coupling(out: Path, name: str) -> None:
    hand, model = hand_of(name), mujoco.MjModel.from_xml_path(str(out / f"{name}.urdf"))
    data, kinematics = mujoco.MjData(model), Kinematics(hand)
    mimics = sum(j.mimic is not None for j in hand.urdf.joints.values() if j.moving)
    assert model.neq == mimics
    for u in postures(hand):
        for joint, value in zip(hand.joint_names, hand.transmission.joints(u), strict=True):
            data.qpos[model.joint(joint).qposadr[0]] = value
        mujoco.mj_kinematics(model, data)
        for link in set(hand.urdf.links) - {hand.base}:
            assert data.xpos[model.body(link).id] == pytest.approx(
                kinematics.link_pose(link, u)[:3, 3], abs=LINEAR
            )


@pytest.mark.parametrize("name", HANDS)
def test_urdf_and_srdf_read_back_are_the_same_hand(out: Path, name: str) -> None:
    hand = hand_of(name)
    again = load_model(out / f"{name}.urdf", out / f"{name}.srdf", ignore=[
        joint.name for joint in hand.joints if joint.role == "ignored"
    ])  # fmt: skip
    assert again.actuator_names == hand.actuator_names
    for one, other in zip(again.actuators, hand.actuators, strict=True):
        assert (one.lower, one.upper) == (other.lower, other.upper)
    assert [(f.name, f.links) for f in again.fingers] == [(f.name, f.links) for f in hand.fingers]
    assert set(again.disabled_collisions) == set(hand.disabled_collisions)
    assert again.rest == pytest.approx(hand.rest, abs=LINEAR)
    for u in postures(hand):
        assert again.transmission.joints(u) == pytest.approx(hand.transmission.joints(u), abs=1e-12)


@pytest.mark.parametrize("name", HANDS)
def test_motors_of_the_mjcf_follow_their_targets_and_tips_feel(out: Path, name: str) -> None:
    hand, model = hand_of(name), mujoco.MjModel.from_xml_path(str(out / f"{name}.xml"))
    assert [model.actuator(i).name for i in range(model.nu)] == list(hand.actuator_names)
    for i, spec in enumerate(hand.actuators):
        if np.isfinite(spec.lower):
            assert model.actuator_ctrlrange[i] == pytest.approx([spec.lower, spec.upper])
    # MuJoCo's sensors feel one body each, so that each link of a fingertip has one.
    sensors = [
        f"touch/{finger.name}" if link == finger.tip else f"touch/{finger.name}/{link}"
        for finger in hand.fingers
        for link in finger.tip_links
    ]
    assert [model.sensor(i).name for i in range(model.nsensor)] == sensors
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("rest").id)
    assert data.ctrl == pytest.approx(hand.rest)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.all(np.isfinite(data.qpos))
    # Nothing but gravity: every motor stays near its target.
    for i in range(model.nu):
        joint = int(model.actuator_trnid[i, 0])
        assert data.qpos[model.jnt_qposadr[joint]] == pytest.approx(data.ctrl[i], abs=0.03)


def test_fingertips_feel_what_they_press_on(out: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(out / "robotiq_2f_85.xml"))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    middle = np.mean([data.site(f"touch/finger_{k}").xpos for k in (1, 2)], axis=0)
    block = spec.worldbody.add_body(name="block", pos=middle)
    block.add_freejoint()
    block.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0.1)
    spec.option.gravity = [0.0, 0.0, 0.0]
    # Keyframes are as long as the positions, of which the block adds seven.
    spec.delete(spec.key("rest"))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 10)
    assert data.sensordata == pytest.approx(np.zeros(model.nsensor))
    data.ctrl[:] = 0.82
    mujoco.mj_step(model, data, 1500)
    pads = [data.sensor(f"touch/{name}").data[0] for name in ("finger_1", "finger_2")]
    assert min(pads) > 10.0


def test_what_a_polynomial_cannot_follow_is_told(tmp_path: Path) -> None:
    notes = export_hand(CONFIG / "heri_ii", tmp_path, [ExportFormat.MJCF]).notes
    assert any("'LFB1__LFP1_1' follows 'motor_finger1' by a curve" in note for note in notes)
    # This one is a polynomial of degree four.
    assert not any("'LFP1_1__LFP1_2'" in note for note in notes)


def test_only_what_is_asked_for_is_written(tmp_path: Path) -> None:
    done = export_hand(CONFIG / "dagana", tmp_path / "new", [ExportFormat.SRDF])
    assert [file.name for file in done.files] == ["dagana.srdf"]
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["dagana.srdf"]


def test_a_hands_own_folder_is_not_written_to() -> None:
    with pytest.raises(ConfigError, match="own folder"):
        export_hand(CONFIG / "dagana", CONFIG / "dagana")


@pytest.mark.samples("*wsg50")
@pytest.mark.parametrize("model", ["hands/heri_II/heri_II", "more_hands/wsg50/wsg50"])
def test_meshes_go_with_the_urdf_and_into_the_mjcf(
    shared: Path, tmp_path: Path, model: str
) -> None:
    made = make_hand("mine", (shared / model).with_suffix(".urdf"), into=tmp_path / "config")
    done = export_hand(made.folder, tmp_path / "out")
    again = load_model(tmp_path / "out" / "mine.urdf")
    check_meshes(again.urdf)
    meshes = {s.mesh for link in again.urdf.links.values() for s in link.collisions if s.mesh}
    assert all((tmp_path / "out" / mesh).is_file() for mesh in meshes)
    assert {file.suffix.lower() for file in done.files} == {".urdf", ".xml", ".srdf", ".stl"}
    for suffix in ("urdf", "xml"):
        found = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / f"mine.{suffix}"))
        assert found.nmesh >= len(meshes)
        pin_model = pin.buildModelFromMJCF if suffix == "xml" else pin.buildModelFromUrdf
        assert pin_model(str(tmp_path / "out" / f"mine.{suffix}")).nq == len(again.joints)
    assert made.hand.urdf.name == again.urdf.name


def test_hand_yaml_limits_and_names_that_mujoco_has_itself(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER.replace('"palm"', '"world"'))
    folder = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config").folder
    file = folder / "hand.yaml"
    file.write_text(file.read_text() + "limits: {left: {upper: 0.5, effort: 2.0}}\n")
    done = export_hand(folder, tmp_path / "out")
    again = load_model(tmp_path / "out" / "g.urdf")
    assert (again.actuator("left").upper, again.actuator("left").effort) == (0.5, 2.0)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "g.xml"))
    assert model.joint("left").range[1] == 0.5
    assert model.body("link/world").id > 0
    assert any("link 'world' is called 'link/world'" in note for note in done.notes)


@pytest.mark.parametrize("limit", ["", '<limit velocity="2" effort="5"/>'])
def test_limits_that_hand_yaml_gives_a_continuous_joint(tmp_path: Path, limit: str) -> None:
    given = '<limit lower="0" upper="0.8" velocity="2" effort="5"/>'
    text = GRIPPER.replace(given, limit, 1).replace("revolute", "continuous", 1)
    (tmp_path / "g.urdf").write_text(text)
    folder = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config").folder
    own = (folder / "hand.yaml").read_text()
    (folder / "hand.yaml").write_text(own + "limits: {left: {lower: -0.1, upper: 3.0}}\n")
    export_hand(folder, tmp_path / "out")
    again, before = load_model(tmp_path / "out" / "g.urdf").actuator("left"), load_hand(folder)
    assert (again.lower, again.upper) == (-0.1, 3.0)
    assert (again.velocity, again.effort) == (
        before.actuator("left").velocity,
        before.actuator("left").effort,
    )
    for suffix in ("urdf", "xml"):
        mujoco.MjModel.from_xml_path(str(tmp_path / "out" / f"g.{suffix}"))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "g.xml"))
    assert model.actuator("left").ctrlrange.tolist() == [-0.1, 3.0]
    (folder / "hand.yaml").write_text(own + "limits: {left: {lower: -0.1}}\n")
    notes = export_hand(folder, tmp_path / "half").notes
    assert any("'left' has only one limit" in note for note in notes)
    assert load_model(tmp_path / "half" / "g.urdf").actuator("left").lower == -np.inf


def test_prefixes_and_comments_stay_in_the_urdf(tmp_path: Path) -> None:
    plugin = '<gazebo><!-- old --><controller:plugin name="é" interval="1"/></gazebo>'
    (tmp_path / "g.urdf").write_text(GRIPPER.replace("</robot>", f"{plugin}</robot>"))
    folder = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config").folder
    export_hand(folder, tmp_path / "out", [ExportFormat.URDF])
    text = (tmp_path / "out" / "g.urdf").read_text()
    assert "<!-- old -->" in text
    assert '<controller:plugin name="é" interval="1" />' in text
    assert load_model(tmp_path / "out" / "g.urdf").actuator_names


def test_the_command_says_what_it_wrote(tmp_path: Path) -> None:
    ran = subprocess.run(
        [*RTEE, "export", str(CONFIG / "dagana"), "--mjcf", str(tmp_path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert f"written to {tmp_path / 'dagana.xml'}" in ran.stdout
    assert "note: actuator 'dagana_gripper_claw_joint'" in ran.stdout
