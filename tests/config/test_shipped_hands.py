"""The hands in config/: every one loads, is complete, and is what its page says."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Composed, Generic, Primitive, Timed
from rtee.drivers.registry import find_driver
from rtee.hand.config import DEFAULTS, HandConfig, read_document
from rtee.hand.load import load_hand
from rtee.hand.model import Hand, JointRole
from rtee.hand.validation import validated

REPOSITORY = Path(__file__).resolve().parents[2]
CONFIG = REPOSITORY / "config"
HANDS = tuple(sorted(path.parent.name for path in CONFIG.glob("*/hand.yaml")))
PAPERS = {
    "dagana",
    "heri_ii",
    "onrobot_3fg15",
    "qb_softhand",
    "robotiq_2f_140",
    "robotiq_2f_85",
    "robotiq_3f",
    "schunk_svh",
}


# Shared by all tests of a hand, which change nothing of it.
@pytest.fixture(params=HANDS, scope="module")
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def hand(name: str) -> Hand:
    return load_hand(CONFIG / name)


@pytest.fixture(scope="module")
def config(name: str) -> HandConfig:
    return read_document(CONFIG / name)[0]


@pytest.fixture(scope="module")
def library(name: str, hand: Hand) -> ActionLibrary:
    return ActionLibrary.load(hand, CONFIG / name / "actions")


def test_the_papers_hands_are_there() -> None:
    assert set(HANDS) >= PAPERS


def test_it_has_its_names(name: str, hand: Hand, config: HandConfig) -> None:
    assert hand.name == config.name == hand.urdf.name == name
    assert config.title


def test_nothing_about_it_is_noteworthy(hand: Hand) -> None:
    assert hand.notes == ()


def test_it_needs_no_mesh(name: str, hand: Hand) -> None:
    shapes = [s for link in hand.urdf.links.values() for s in (*link.collisions, *link.visuals)]
    assert shapes
    assert {shape.kind for shape in shapes} <= {"box", "cylinder", "sphere"}
    assert not [p for p in (CONFIG / name).rglob("*") if p.suffix in (".stl", ".STL", ".dae")]


def test_what_collides_is_also_seen(hand: Hand) -> None:
    for link in hand.urdf.links.values():
        assert bool(link.collisions) == bool(link.visuals), link.name


def test_every_finger_has_a_tip(hand: Hand) -> None:
    assert len(hand.fingers) >= 2
    for finger in hand.fingers:
        assert finger.tip is not None
        assert finger.tip == finger.links[-1]


def test_every_moving_joint_has_limits(hand: Hand) -> None:
    for joint in hand.urdf.joints.values():
        if joint.moving:
            assert joint.velocity > 0.0, joint.name
            assert joint.effort > 0.0, joint.name
            assert joint.upper > joint.lower, joint.name


def test_coupled_joints_stay_within_their_limits(hand: Hand) -> None:
    for i, actuator in enumerate(hand.actuators):
        u = np.tile(hand.rest, (101, 1))
        u[:, i] = np.linspace(actuator.lower, actuator.upper, len(u))
        way = hand.transmission.joints(u)
        for joint, values in zip(hand.joints, way.T, strict=True):
            if joint.role is JointRole.MIMIC:
                assert joint.lower - 1e-3 <= values.min(), joint.name
                assert values.max() <= joint.upper + 1e-3, joint.name


def test_the_rest_posture_lies_within_the_limits(hand: Hand) -> None:
    for actuator in hand.actuators:
        assert actuator.lower <= actuator.rest <= actuator.upper


def test_limits_only_tighten_the_model(name: str, hand: Hand, config: HandConfig) -> None:
    assert set(config.limits) <= {*hand.actuator_names, DEFAULTS}
    for actuator in hand.actuators:
        joint = hand.urdf.joints[actuator.name]
        assert 0.0 < actuator.velocity <= joint.velocity
        assert 0.0 < actuator.effort <= joint.effort


def test_bodies_that_move_have_mass_and_a_possible_inertia(name: str, hand: Hand) -> None:
    root = ElementTree.parse(CONFIG / name / f"{name}.urdf").getroot()
    inertials = {link.get("name"): link.find("inertial") for link in root.iter("link")}
    for joint in hand.joints:
        inertial = inertials[joint.child]
        carried = [j.child for j in hand.urdf.joints.values() if j.parent == joint.child]
        if inertial is None:  # its mass is that of a link fixed to it
            assert any(inertials[link] is not None for link in carried), joint.child
            continue
        mass = inertial.find("mass")
        moments = inertial.find("inertia")
        assert mass is not None
        assert moments is not None
        assert float(mass.get("value", "0")) > 0.0
        x, y, z = (float(moments.get(key, "0")) for key in ("ixx", "iyy", "izz"))
        assert min(x, y, z) > 0.0
        assert 2.0 * max(x, y, z) < (x + y + z) * 1.001  # the triangle inequality


def test_it_drives_nothing_unless_asked(config: HandConfig) -> None:
    assert config.driver == "kinematic"
    assert config.devices


def test_its_devices_have_drivers_and_options_they_know(config: HandConfig) -> None:
    for device in config.devices.values():
        options = find_driver(device.driver).Options
        assert options is not None
        validated(options, dict(device.options))


def test_its_actions_load(library: ActionLibrary) -> None:
    assert any(isinstance(action, Primitive) for action in library.all())
    assert isinstance(library.find("Grasp"), Composed | Generic)


def test_actions_say_what_they_are_for(library: ActionLibrary) -> None:
    for action in library.all():
        if not isinstance(action, Primitive):
            assert action.description.endswith("."), action.name


def test_actions_lie_within_the_limits(hand: Hand, library: ActionLibrary) -> None:
    for action in library.all():
        postures = (
            [step.posture for step in action.steps]
            if isinstance(action, Timed)
            else [action.posture]
        )
        for posture in postures:
            assert posture.involved
            for actuator in hand.actuators:
                assert actuator.lower <= posture.position[actuator.name] <= actuator.upper


def test_its_page_names_all_of_it(name: str, hand: Hand, library: ActionLibrary) -> None:
    page = (REPOSITORY / "docs" / "hands" / f"{name}.md").read_text(encoding="utf-8")
    actions = {action.name for action in library.all()}
    for word in (*hand.finger_names, *hand.actuator_names, *actions):
        assert word in page, word


def test_its_page_lists_its_primitives_and_limits(
    name: str, hand: Hand, library: ActionLibrary
) -> None:
    page = (REPOSITORY / "docs" / "hands" / f"{name}.md").read_text(encoding="utf-8")
    done: dict[str, list[str]] = {}
    for action in library.all("primitive"):
        assert isinstance(action, Primitive)
        done.setdefault(action.name, []).append(" + ".join(f"`{e}`" for e in action.elements))
    table = page.split("| primitive | of |\n| --- | --- |\n")[1].split("\n\n")[0]
    listed = dict(row.strip("| ").split(" | ") for row in table.splitlines())
    assert {kind: set(of.split("; ")) for kind, of in listed.items()} == {
        kind: set(of) for kind, of in done.items()
    }
    for spec in hand.actuators:
        numbers = [f"{spec.lower:.4g} … {spec.upper:.4g}", f"{spec.rest:.4g}"]
        numbers += [f"{value:.4g}" for value in (spec.velocity, spec.acceleration, spec.effort)]
        assert f"| `{spec.name}` | {' | '.join(numbers)} |" in page, spec.name


def test_the_papers_actions_are_there() -> None:
    def find(hand_name: str, action: str) -> Composed | Timed:
        hand = load_hand(CONFIG / hand_name)
        found = ActionLibrary.load(hand, CONFIG / hand_name / "actions").find(action)
        assert isinstance(found, Composed | Timed)
        return found

    grasp = find("schunk_svh", "schunkGrasp")
    assert isinstance(grasp, Composed)
    assert [(p.action, p.elements, p.scale) for p in grasp.parts] == [
        ("Trig", ("index",), 1.0),
        ("Trig", ("middle",), 1.0),
        ("Trig", ("thumb",), 0.3),
    ]
    wide = find("robotiq_3f", "timed_wide_grasp")
    assert isinstance(wide, Timed)
    assert [step.use.action for step in wide.steps] == ["Open_Wide", "Grasp"]
    drill = find("heri_ii", "drill")
    assert isinstance(drill, Timed)
    assert [step.use.action for step in drill.steps] == ["GRASP3f", "TrigOn", "TrigOff"]
    assert isinstance(find("heri_ii", "3f_grasp"), Composed)
