"""The record of a first contact: questions and answers, measurements, findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from rtee.drivers.assumptions import ASSUMPTIONS, Assumption, Topic
from rtee.sample import ActuatorState


class Conclusion(StrEnum):
    """Verdict of a step on an assumption."""

    CONFIRMED = "confirmed"
    REFUTED = "refuted"
    OPEN = "not tried"


@dataclass(frozen=True, slots=True)
class ContactQuestion:
    """A question to the person at the device.

    Attributes:
        topic: Its subject.
        text: The question.
        kind: ``yes`` (y or n), ``number`` (Enter skips it) or ``enter``.
        actuator: The actuator concerned; empty: the device.
        unit: Unit of a number.
    """

    topic: Topic
    text: str
    kind: str = "yes"
    actuator: str = ""
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding of one step.

    Attributes:
        topic: Topic of the assumptions that it concerns.
        verdict: Whether it confirms or refutes them.
        text: What was found, in words.
        actuator: The actuator; empty: the device.
    """

    topic: Topic
    verdict: Conclusion
    text: str
    actuator: str = ""


@dataclass(frozen=True, slots=True)
class Sample:
    """A measurement and the command at that time.

    Attributes:
        stamp: Time, CLOCK_MONOTONIC [s].
        step: The step in progress.
        state: What was measured.
        reference: Positions commanded; empty: none.
    """

    stamp: float
    step: str
    state: ActuatorState
    reference: tuple[float, ...] = ()


@dataclass
class ContactReport:
    """The record of a first contact.

    Attributes:
        device: The device's name.
        driver: The driver's name.
        identity: The device's own description.
        findings: What the steps found, in order.
        answers: Questions and answers, in order.
        samples: Measurements, in order.
        ended: Why it ended early; empty: it did not.
    """

    device: str
    driver: str
    identity: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    answers: list[tuple[ContactQuestion, str]] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    ended: str = ""

    def judged(self) -> list[tuple[Assumption, Conclusion]]:
        """Return the assumptions of the device's page with the findings on their topics."""
        return [
            (assumption, self.verdict(assumption.topic))
            for assumption in ASSUMPTIONS.get(self.driver, ())
        ]

    def verdict(self, topic: Topic) -> Conclusion:
        """Return the verdict on a topic: one refuting finding outweighs all others."""
        said = {one.verdict for one in self.findings if one.topic is topic}
        for verdict in (Conclusion.REFUTED, Conclusion.CONFIRMED):
            if verdict in said:
                return verdict
        return Conclusion.OPEN
