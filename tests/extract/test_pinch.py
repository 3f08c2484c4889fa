from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from extract.models import APART, LENGTH, Model, box, figure_3, mesh, planar, sphere
from rtee.actions.types import Primitive
from rtee.extract.canonical import canonical
from rtee.extract.evidence import Inspector
from rtee.extract.extraction import extract
from rtee.extract.multi import MultiSearch
from rtee.extract.pinch import PinchProbe, PinchSearch, pinch_search
from rtee.extract.ranking import FoundPinch
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.hand.tessellation import binary_stl

CONFIG = Path(__file__).resolve().parents[2] / "config"


def pinches(hand: Hand, **options: object) -> dict[tuple[str, ...], Primitive]:
    found = extract(hand, **options).primitives  # type: ignore[arg-type]
    return {p.elements: p for p in found if "Pinch" in p.name}


def sliders(left: tuple[str, ...], right: tuple[str, ...], gap: float = 0.02) -> Model:
    """Return two tips that slide towards each other along x, by up to 30 mm each."""
    model = Model()
    for name, side, shapes in (("left", -1, left), ("right", 1, right)):
        model.link(name, *shapes).finger(name, name)
        model.joint(
            f"{name}_x",
            "base",
            name,
            kind="prismatic",
            xyz=(side * gap / 2, 0, 0),
            axis=(-side, 0, 0),
            limits=(0, 0.03),
        )
    return model


def test_the_deepest_pose_is_stored_with_its_evidence(tmp_path: Path) -> None:
    pad = box((0.001, 0.2, 0.2))
    model = sliders(
        (box((0.1, 0.2, 0.2), (-0.05, 0, 0)),), (box((0.1, 0.2, 0.2), (0.05, 0, 0)), pad)
    )
    found = pinches(model.load(tmp_path))["left", "right"]
    evidence = found.evidence[0]
    assert dict(found.posture.position) == {"left_x": 0.03, "right_x": 0.03}
    assert evidence.depth == pytest.approx(0.0405, abs=1e-6)
    assert evidence.distance == 0.0
    assert evidence.frame_distance == pytest.approx(0.04, abs=1e-6)
    assert evidence.normal is not None
    assert abs(evidence.normal[0]) == pytest.approx(1.0)
    assert evidence.contact_at == pytest.approx(0.0195 / 0.06, abs=1e-4)
    assert evidence.clear
    assert evidence.path_clear


def test_any_shape_of_a_tip_can_make_the_contact(tmp_path: Path) -> None:
    far = sphere(0.001, (-0.5, 0, 0))
    small = (far, sphere(0.005, (0, 0.03, 0)), far)
    model = sliders(small, (far, far, sphere(0.005, (0, 0.03, 0))))
    found = pinches(model.load(tmp_path))["left", "right"]
    assert found.evidence[0].depth == pytest.approx(0.01, abs=1e-5)
    assert found.evidence[0].point is not None
    assert found.evidence[0].point[1] == pytest.approx(0.03, abs=1e-3)


def test_of_several_shapes_none_near_enough_means_no_pinch(tmp_path: Path) -> None:
    model = sliders((sphere(0.001), sphere(0.001, (-0.1, 0, 0))), (sphere(0.001),), gap=0.1)
    assert pinches(model.load(tmp_path))["left", "right"].name == "PinchLoose"


@pytest.mark.parametrize(("gap", "name"), [(0.0, "PinchTight"), (0.001, "PinchLoose")])
@pytest.mark.parametrize("closed", [0.0, 0.03])
def test_where_jaws_have_their_zero_decides_nothing(
    closed: float, gap: float, name: str, tmp_path: Path
) -> None:
    """Jaws that end at each other, or right before, whether they count their way out or in."""
    jaw = (box((0.02, 0.02, 0.04)),)
    model = sliders(jaw, jaw, gap + 0.02 + 2 * closed)
    limits = f'lower="{closed - 0.03}" upper="{closed}"'
    model.parts = [part.replace('lower="0" upper="0.03"', limits) for part in model.parts]
    found = pinches(model.load(tmp_path))["left", "right"]
    assert found.name == name
    assert dict(found.posture.position) == {"left_x": closed, "right_x": closed}
    assert found.evidence[0].distance == pytest.approx(gap, abs=1e-7)


def test_jaws_that_meet_only_at_their_limits_touch_there(tmp_path: Path) -> None:
    """Two plates of pliers, which turn about one pin and lie flat on each other when closed."""
    model = Model()
    for name, side, limits in (("left", -1, (-1.0, 0.0)), ("right", 1, (0.0, 1.0))):
        plate = box((0.002, 0.01, 0.04), (side * 0.001, 0, 0.03))
        model.link(name, plate).finger(name, name)
        model.joint(f"{name}_turn", "base", name, limits=limits)
    found = pinches(model.load(tmp_path))["left", "right"]
    assert found.name == "PinchTight"
    assert dict(found.posture.position) == {"left_turn": 0.0, "right_turn": 0.0}
    assert found.evidence[0].distance == 0.0


def test_a_loose_pinch_is_the_closest_pose_within_the_limits(tmp_path: Path) -> None:
    model = planar(Model(), "a", side=1)
    planar(model, "b", side=-1)
    model.parts = [part.replace('upper="1.2"', 'upper="0.2"') for part in model.parts]
    found = pinches(model.load(tmp_path))["a", "b"]
    gap = 2 * (APART - LENGTH * math.sin(0.2) - 0.005 * math.cos(0.2))
    assert found.name == "PinchLoose"
    assert found.evidence[0].distance == pytest.approx(gap, abs=1e-5)
    assert found.evidence[0].depth == 0.0
    assert found.evidence[0].contact_at is None


def blocked(post: str, gap: float = 0.02) -> Model:
    """Return sliders whose left one carries an arm that runs into a post of the base."""
    arm = box((0.002, 0.1, 0.002), (0, 0.2, 0))
    model = sliders((), (box((0.1, 0.2, 0.2), (0.05, 0, 0)),), gap)
    model.parts = [
        part.replace(
            '<parent link="base"/><child link="left"/>', '<parent link="lift"/><child link="left"/>'
        )
        for part in model.parts
        if '<link name="left">' not in part
    ]
    # What a joint of the base's own carries would be adjacent to the post.
    model.link("lift").joint(
        "left_y", "base", "lift", kind="prismatic", axis=(0, 1, 0), limits=(0, 1e-6)
    )
    model.link("left", box((0.1, 0.2, 0.2), (-0.05, 0, 0))).link("arm", arm).joint(
        "weld", "left", "arm", kind="fixed"
    )
    return model.link("post", post).joint("stand", "base", "post", kind="fixed")


def test_the_deepest_clear_pose_comes_before_the_deepest(tmp_path: Path) -> None:
    model = blocked(box((0.01, 0.01, 0.01), (0.0165, 0.2, 0)))
    found = pinches(model.load(tmp_path))["left", "right"]
    first, *rest = found.evidence
    assert first.clear
    assert first.path_clear
    # The arm, 1 mm thick to each side and 10 mm off, comes to 1 mm from the post's face, which
    # is at 11.5 mm.
    assert found.posture.position["left_x"] == pytest.approx(0.0195, abs=1e-4)
    assert first.clearance == pytest.approx(0.001, abs=1e-4)
    assert first.depth < max(e.depth for e in rest)
    worst = max(rest, key=lambda e: e.depth)
    assert worst.colliding == (("arm", "post"),)
    assert not worst.clear
    assert not worst.path_clear


def phalanx(file: Path, radius: float, length: float) -> str:
    """Return the mesh of a round bar of eight sides along z with a blunt end, as a shape."""
    narrow = 0.85 * radius
    rows = [(0.9 * radius, 0.0), (radius, 0.1 * length), (narrow, length - narrow)]
    rows += [
        (narrow * math.cos(t), length - narrow + narrow * math.sin(t)) for t in (0.2, 0.88, 1.57)
    ]
    turns = np.exp(2j * np.pi * np.arange(8) / 8)
    rings = np.array([[(r * c.real, r * c.imag, z) for c in turns] for r, z in rows])
    ends = [np.broadcast_to(ring.mean(axis=0), (8, 3)) for ring in (rings[0], rings[-1])]
    skin = np.array([ends[0], *rings, ends[1]])
    after = np.roll(skin, -1, axis=1)
    triangles = [(skin[:-1], after[:-1], after[1:]), (skin[:-1], after[1:], skin[1:])]
    corners = [np.stack(three, axis=2).reshape(-1, 3, 3) for three in triangles]
    file.write_bytes(binary_stl(np.concatenate(corners)))
    return mesh(file)


def test_a_minimum_that_is_clear_as_it_is_is_not_passed_over(tmp_path: Path) -> None:
    """The way to the deepest is blocked; what the search makes of that is 6 % shallower."""
    model = Model().link("palm", box((0.025, 0.08, 0.08), (0, 0, 0.04)))
    model.joint("stand", "base", "palm", kind="fixed")
    for name, length, radius in (
        ("i1", 0.038, 0.007), ("i2", 0.04, 0.0065), ("t1", 0.03, 0.009), ("t2", 0.057, 0.007),
    ):  # fmt: skip
        model.link(name, phalanx(tmp_path / f"{name}.stl", radius, length))
    model.joint("index", "palm", "i1", xyz=(0, -0.03, 0.082), limits=(0, 2.09))
    follow = '<mimic joint="index" multiplier="1.06" offset="0.72"/>'
    model.joint("bend", "i1", "i2", xyz=(0, 0, 0.038), limits=(0, 3), mimic=follow)
    model.joint(
        "turn", "palm", "t1", xyz=(0.01, -0.034, 0.012), rpy=(0, 0.991, -0.11),
        axis=(0, 0, 1), limits=(-2.1, 0),
    )  # fmt: skip
    model.joint(
        "thumb", "t1", "t2", xyz=(0, 0, 0.032), rpy=(0.411, -0.383, 0),
        axis=(1, 0, 0), limits=(0, 2.09),
    )  # fmt: skip
    model.finger("index", "i2", "palm").finger("thumb", "t2", "palm")
    (found,) = pinches(model.load(tmp_path)).values()
    executed, deepest = found.evidence
    assert executed.clear
    assert executed.path_clear
    assert not deepest.path_clear
    assert executed.depth > 0.98 * deepest.depth


def test_clear_postures_are_sought_from_other_minima_too(tmp_path: Path) -> None:
    """From the deepest ones, it ends 2 mm deep between two fingers with a third between them."""
    model = Model().link("palm", box((0.08, 0.09, 0.06), (0, 0, 0.03)))
    model.joint("stand", "base", "palm", kind="fixed")
    for finger, y in (("a", -0.03), ("b", 0.0), ("c", 0.03)):
        parent, place = "palm", (0.0, y, 0.11)
        for i, (length, axis, limits) in enumerate(
            (
                (0.03, (1, 0, 0), (-0.4, 0.4)),
                (0.038, (0, 1, 0), (0, 2)),
                (0.038, (0, 1, 0), (-0.1, 1.57)),
                (0.042, (0, 1, 0), (-0.1, 1.57)),
            )
        ):
            name = f"{finger}{i}"
            model.link(name, phalanx(tmp_path / f"{name}.stl", 0.0115, length))
            model.joint(f"{name}_joint", parent, name, xyz=place, axis=axis, limits=limits)
            parent, place = name, (0.0, 0.0, length)
        model.finger(finger, parent, "palm")
    form = canonical(model.load(tmp_path))
    inspector = Inspector.of(form.hand, form.unit)
    first, second = (form.hand.finger(name) for name in "ac")
    search = pinch_search(inspector, first, second, "depth")
    assert search is not None
    probe = search.probe()
    assert probe is not None
    executed = search.finish(probe).candidates[0]
    assert executed.usable
    assert executed.evidence.depth / form.unit > 0.01


def test_a_pose_behind_an_obstacle_comes_last(tmp_path: Path) -> None:
    model = Model().link("wall", box((0.02, 0.1, 0.02), (0.05, 0, 0.07)))
    model.joint("stand", "base", "wall", kind="fixed")
    # Deeper and deeper behind the plate the higher the ball comes, but the wall is in the way.
    plate = (
        '<origin xyz="0.12 0 0.05" rpy="0 -0.3 0"/><geometry><box size="0.02 0.1 0.4"/></geometry>'
    )
    model.link("plate", plate).joint("hold", "base", "plate", kind="fixed").finger("plate", "plate")
    model.link("carriage").link("ball", sphere(0.01)).finger("ball", "ball")
    model.joint("x", "base", "carriage", kind="prismatic", axis=(1, 0, 0), limits=(0, 0.1))
    model.joint("z", "carriage", "ball", kind="prismatic", axis=(0, 0, 1), limits=(0, 0.12))
    found = pinches(model.load(tmp_path))["plate", "ball"]
    assert found.evidence[0].clear
    assert found.evidence[0].path_clear
    behind = [e for e in found.evidence if not e.path_clear]
    assert behind
    assert max(e.depth for e in behind) > found.evidence[0].depth


def test_only_an_unclear_pose_is_kept_and_says_so(tmp_path: Path) -> None:
    model = blocked(box((0.05, 0.01, 0.01), (0.0125, 0.2, 0)), gap=0.035)
    found = pinches(model.load(tmp_path))["left", "right"]
    assert not any(evidence.clear for evidence in found.evidence)
    assert found.evidence[0].colliding == (("arm", "post"),)


def test_contact_at_every_configuration_is_no_pinch(tmp_path: Path) -> None:
    for limit, names in ((0.1, set()), (1.5, {"PinchTight"})):
        model = Model().link("palm").joint("turn", "base", "palm", axis=(0, 0, 1))
        for name, side in (("a", -1), ("b", 1)):
            model.link(name, sphere(0.02, (0, 0, 0.03))).finger(name, name)
            model.joint(
                name, "palm", name, xyz=(0.005 * side, 0, 0), axis=(0, side, 0), limits=(0, limit)
            )
        found = pinches(model.load(tmp_path))
        assert {pinch.name for pinch in found.values()} == names


def test_a_continuous_actuator_takes_part(tmp_path: Path) -> None:
    model = Model()
    for name, side in (("a", -1), ("b", 1)):
        model.link(name, box((0.02, 0.02, 0.1), (0, 0, 0.05))).finger(name, name)
        model.joint(name, "base", name, kind="continuous", xyz=(0.05 * side, 0, 0))
    found = pinches(model.load(tmp_path))["a", "b"]
    assert found.name == "PinchTight"
    assert found.evidence[0].depth == pytest.approx(0.02, abs=1e-5)


def test_a_hand_without_geometry_has_no_pinches(tmp_path: Path) -> None:
    model = Model()
    for name in ("a", "b"):
        model.link(name).joint(name, "base", name).finger(name, name)
    assert pinches(model.load(tmp_path)) == {}


def test_stored_postures_hold_what_their_evidence_says(tmp_path: Path) -> None:
    hand = figure_3(4).load(tmp_path)
    inspector = Inspector.of(hand)
    for elements, primitive in pinches(hand).items():
        tips = inspector.scene.tips[elements]  # tips are named like fingers
        for posture, evidence in zip(primitive.postures, primitive.evidence, strict=True):
            u = np.array([posture.position[name] for name in hand.actuator_names])
            inspector.scene.place(u)
            assert inspector.scene.touching(tips)
            assert -inspector.scene.witness(tips).distance == pytest.approx(
                evidence.depth, abs=1e-8
            )
            assert (u >= hand.lower).all()
            assert (u <= hand.upper).all()
            for name in set(hand.actuator_names) - set(posture.involved):
                assert posture.position[name] == hand.actuator(name).rest


def test_rank_by_opposition_never_puts_a_worse_opposed_one_first(tmp_path: Path) -> None:
    hand = figure_3(4).load(tmp_path)
    by_depth, by_opposition = (pinches(hand, rank=rank) for rank in ("depth", "opposition"))
    for elements in by_depth:
        first, other = (found[elements].evidence[0] for found in (by_opposition, by_depth))
        assert first.opposition is not None
        assert other.opposition is not None
        if first.clear == other.clear and first.path_clear == other.path_clear:
            assert first.opposition.force_closure >= other.opposition.force_closure


def test_the_result_does_not_depend_on_repetition_or_jobs(tmp_path: Path) -> None:
    hand = figure_3(4).load(tmp_path)
    first, again, two = (extract(hand, jobs=jobs).primitives for jobs in (1, 1, 2))
    assert first == again == two


def test_progress_is_told(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    extract(figure_3(4).load(tmp_path), progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == list(range(1, len(told) + 1))
    assert told[-1][0] == told[-1][1]


def test_pinches_in_the_way_of_other_links_are_searched_before_groups_of_three(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: list[tuple[int, bool]] = []
    finish, run = PinchSearch.finish, MultiSearch.run

    def finished(self: PinchSearch, probe: PinchProbe) -> FoundPinch:
        begun.append((2, probe.blocked))
        return finish(self, probe)

    def ran(self: MultiSearch) -> FoundPinch | None:
        begun.append((len(self.fingers), True))
        return run(self)

    monkeypatch.setattr(PinchSearch, "finish", finished)
    monkeypatch.setattr(MultiSearch, "run", ran)
    extract(load_hand(CONFIG / "robotiq_3f"))
    # Of its pairs, those with the middle finger have another link in the way.
    assert begun == [(2, True), (2, True), (3, True), (2, False)]
