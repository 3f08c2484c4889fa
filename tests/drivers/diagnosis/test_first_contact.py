"""The first hour with a device, played: a person answers by where the fingers really are."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcap.reader import make_reader

from rtee.buses.pool import BusPool
from rtee.drivers.assumptions import ASSUMPTIONS, Topic
from rtee.drivers.diagnosis.contact_report import Conclusion, ContactQuestion, ContactReport
from rtee.drivers.diagnosis.first_contact import ContactGuide
from rtee.drivers.registry import find_driver
from rtee.log.first_contact import text_of, write
from rtee.testing import DeviceCase
from rtee.types import DeviceSpec, JointKind
from tests.drivers.test_worn_contract import FAMILIES, suite_of

pytestmark = pytest.mark.anyio

QUICK = ("robotiq_2f", "schunk_egu", "orca_touch")
"""Families whose first contact is played with every commit; of the others the motors are many."""


def spec_of(family: str, *, worn: bool) -> DeviceSpec:
    case: DeviceCase = suite_of(family).case
    # At its own speed: the suite's devices are hasty.
    emulator = {k: v for k, v in dict(case.options.get("emulator") or {}).items() if k != "haste"}
    options = {**case.options, "emulator": emulator}
    return replace(case, options=options, worn=worn).spec()


class Person:
    """Answers as somebody does who looks at the fingers.

    Args:
        truth: Where the finger is, as a part of its way [0 open, 1 closed], given the emulator.
        words: Answers by topic that replace what is seen.
    """

    def __init__(
        self, spec: DeviceSpec, pool: BusPool, truth: Callable[[Any], float], **words: str
    ) -> None:
        self.spec, self.pool, self.truth, self.words = spec, pool, truth, words
        self.asked: list[ContactQuestion] = []

    async def __call__(self, question: ContactQuestion) -> str:
        self.asked.append(question)
        if question.topic.name in self.words:
            return self.words[question.topic.name]
        if question.kind == "yes":
            return "y"
        if question.topic is Topic.SCALE and measurable(self.spec):
            one = self.spec.actuators[0]
            ends = self.spec.mechanism(one)
            per = 1e3 if one.kind is JointKind.PRISMATIC else math.degrees(1.0)
            part = self.truth(self.pool.played(self.spec.owner))
            # A ruler: a fiftieth of the way at best.
            return f"{round(part * 50) / 50 * (ends.upper - ends.lower) * per:.2f}"
        return "n" if question.topic is Topic.FORCE else ""


def measurable(spec: DeviceSpec) -> bool:
    """Return whether the emulator knows how far the fingers close: a drive knows only counts."""
    return len(spec.actuators) == 1 and spec.driver not in ("cia402", "schunk_svh", "dynamixel")


def closed(emulator: Any) -> float:
    """Return how far the fingers are really closed."""
    return float(emulator.closings()[0].part)


async def played(
    family: str,
    *,
    worn: bool,
    truth: Callable[[Any], float] = closed,
    tighter: float = 0.0,
    **words: str,
) -> tuple[ContactReport, Person]:
    spec = spec_of(family, worn=worn)
    if tighter:  # by a share of its range, in hand.yaml
        one = spec.actuators[0]
        limited = replace(one, lower=one.lower + tighter * (one.upper - one.lower))
        spec = replace(spec, actuators=(limited,), mechanisms={one.name: spec.mechanism(one)})
    async with BusPool(wire_time=False) as pool:
        person = Person(spec, pool, truth, **words)

        def unplug(off: bool) -> None:
            wire = pool.simulation(spec.owner)
            wire.unplug() if off else wire.replug()

        driver = find_driver(spec.driver)(spec, pool)
        return await ContactGuide(driver, person, unplug=unplug).run(), person


def refuted(report: ContactReport) -> set[Topic]:
    return {one.topic for one in report.findings if one.verdict is Conclusion.REFUTED}


@pytest.mark.samples(*(f"{family}-worn" for family in QUICK), "robotiq_2f-ideal")
@pytest.mark.parametrize("worn", [False, True], ids=["ideal", "worn"])
@pytest.mark.parametrize("family", sorted(FAMILIES))
async def test_nothing_is_refuted_of_a_device_as_it_is_assumed(family: str, worn: bool) -> None:
    report, person = await played(family, worn=worn)
    assert report.ended == ""
    assert refuted(report) == set(), text_of(report)
    assert report.verdict(Topic.IDENTITY) is Conclusion.CONFIRMED
    assert report.verdict(Topic.LINK) is Conclusion.CONFIRMED
    if measurable(spec_of(family, worn=worn)):
        for topic in (Topic.DIRECTION, Topic.SCALE, Topic.OFFSET, Topic.STOP):
            assert report.verdict(topic) is Conclusion.CONFIRMED, (topic, text_of(report))
    assert len(person.asked) == len(report.answers)


@pytest.mark.samples("*-robotiq_2f-worn", "offset-wsg50-worn", "direction-schunk_egu-ideal")
@pytest.mark.parametrize("worn", [False, True], ids=["ideal", "worn"])
@pytest.mark.parametrize("family", ["schunk_egu", "robotiq_2f", "wsg50"])
@pytest.mark.parametrize(
    ("truth", "found"),
    [
        # The driver takes a distance for the way of one finger, or the other way round.
        (lambda emulator: 0.5 * closed(emulator), {Topic.SCALE}),
        (lambda emulator: min(2.0 * closed(emulator), 1.6), {Topic.SCALE}),
        (lambda emulator: 1.0 - closed(emulator), {Topic.DIRECTION}),
        (lambda emulator: closed(emulator) + 0.2, {Topic.OFFSET}),
    ],
    ids=["half", "twice", "direction", "offset"],
)
async def test_a_planted_fault_is_found(
    family: str, truth: Callable[[Any], float], found: set[Topic], worn: bool
) -> None:
    report, _ = await played(family, worn=worn, truth=truth)
    assert refuted(report) == found, text_of(report)


@pytest.mark.parametrize("family", ["schunk_egu", "robotiq_2f"])
async def test_a_person_measures_from_where_the_mechanism_ends(family: str) -> None:
    report, _ = await played(family, worn=False, tighter=0.25)
    assert refuted(report) == set(), text_of(report)
    assert report.verdict(Topic.OFFSET) is Conclusion.CONFIRMED


async def test_a_device_is_kept_awake_while_a_person_measures() -> None:
    """An EGU that hears nothing for a second stops with an error."""

    class Slow(Person):
        async def __call__(self, question: ContactQuestion) -> str:
            await anyio.sleep(5.0)
            return await super().__call__(question)

    spec = spec_of("schunk_egu", worn=True)
    spec = replace(spec, options={**spec.options, "emulator": {"watch": 1.0}})
    async with BusPool(wire_time=False) as pool:
        driver = find_driver(spec.driver)(spec, pool)
        wire = {True: "unplug", False: "replug"}

        def unplug(off: bool) -> None:
            getattr(pool.simulation(spec.owner), wire[off])()

        report = await ContactGuide(driver, Slow(spec, pool, closed), unplug=unplug).run()
    assert report.ended == ""
    assert refuted(report) == set(), text_of(report)


async def test_a_wrong_device_and_a_hand_that_runs_on_are_refuted() -> None:
    report, _ = await played("robotiq_2f", worn=True, IDENTITY="n", STOP="n")
    assert refuted(report) == {Topic.IDENTITY, Topic.STOP}


async def test_a_person_may_end_it_and_the_device_is_stopped() -> None:
    report, person = await played("robotiq_2f", worn=True, SCALE="q")
    assert report.ended == "ended by the person at 'measure'"
    assert report.verdict(Topic.STOP) is Conclusion.OPEN
    assert person.asked[-1].topic is Topic.SCALE


async def test_what_is_no_number_is_asked_again() -> None:
    answers = iter(["about two", "1,5", "3"])

    class Clumsy(Person):
        async def __call__(self, question: ContactQuestion) -> str:
            if question.topic is Topic.SCALE:
                return next(answers)
            return await super().__call__(question)

    spec = spec_of("robotiq_2f", worn=False)
    async with BusPool(wire_time=False) as pool:
        driver = find_driver(spec.driver)(spec, pool)
        person = Clumsy(spec, pool, closed)
        report = await ContactGuide(driver, person, unplug=lambda off: None).run()
    asked = [question.text for question, _ in report.answers if question.topic is Topic.SCALE]
    assert asked[1].startswith("'about two' is not a number")
    assert Topic.SCALE in refuted(report)


async def test_the_report_is_one_page_and_a_recording(tmp_path: Path) -> None:
    half = lambda emulator: 0.5 * closed(emulator)  # noqa: E731 - the EGU before it was known
    report, _ = await played("schunk_egu", worn=True, truth=half)
    recording, page = write(report, ["left_finger_joint"], tmp_path / "out")
    text = page.read_text("utf-8")
    assert "model SCHUNK EGK 40 M-B" in text
    scale = next(a for a in ASSUMPTIONS["schunk_egu"] if a.topic is Topic.SCALE)
    assert f"| {scale.text} | scale | {scale.source} | **refuted** |" in text
    assert re.search(r"2\d\.\d mm reported, 1\d\.\d mm measured: 0\.[45]\d times", text)
    with recording.open("rb") as file:
        messages = [
            (channel.topic, json.loads(message.data))
            for _, channel, message in make_reader(file).iter_messages()
        ]
    topics = {topic for topic, _ in messages}
    assert topics == {"/device/device", "/device/state", "/device/question", "/device/finding"}
    states = [data for topic, data in messages if topic == "/device/state"]
    assert len(states) == len(report.samples)
    assert {"rest", "measure", "stop"} <= {data["step"] for data in states}


def test_every_family_has_assumptions_of_its_scale_and_of_silence() -> None:
    assert set(ASSUMPTIONS) == set(FAMILIES)
    for family, assumptions in ASSUMPTIONS.items():
        topics = {one.topic for one in assumptions}
        assert {Topic.SCALE, Topic.LINK} <= topics, family
        assert all(one.text for one in assumptions)
