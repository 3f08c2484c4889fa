"""Write the findings of a first contact with a device: a recording and one page."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rtee import monotonic
from rtee.drivers.diagnosis.contact_report import Conclusion, ContactReport
from rtee.hand.files import write_all
from rtee.sample import MEASURED
from rtee.values import plain

_VERSION = f"rtee {version('rtee')}"
_SCHEMA = json.dumps({"type": "object"}).encode()
"""Schema of every channel: JSON objects, whose keys name their contents."""


def write(report: ContactReport, actuators: Iterable[str], folder: Path) -> tuple[Path, Path]:
    """Write the recording and the page; return their paths.

    Args:
        report: The findings.
        actuators: The names of the device's actuators.
        folder: The folder for both; it is made.

    Raises:
        ConfigError: if they cannot be written.
    """
    name = f"first-contact-{report.device}-{time.strftime('%Y%m%d-%H%M%S')}"
    recording, page = folder / f"{name}.mcap", folder / f"{name}.md"
    write_all({recording: _recorded(report, list(actuators)), page: text_of(report)})
    return recording, page


def _recorded(report: ContactReport, actuators: list[str]) -> bytes:
    from mcap.writer import Writer

    # Stamps of the computer's clock, from those of the monotonic clock.
    wall = time.time_ns() - monotonic.now_ns()
    with io.BytesIO() as file:
        writer = Writer(file)
        writer.start(profile="", library=_VERSION)
        schema = writer.register_schema("rtee.FirstContact", "jsonschema", _SCHEMA)
        channels = {
            topic: writer.register_channel(f"/{report.device}/{topic}", "json", schema)
            for topic in ("state", "question", "finding", "device")
        }
        start = int(report.samples[0].stamp * 1e9) + wall if report.samples else time.time_ns()

        def put(topic: str, stamp: int, data: Mapping[str, Any]) -> None:
            writer.add_message(channels[topic], stamp, json.dumps(plain(data)).encode(), stamp)

        put("device", start, {"driver": report.driver, "identity": report.identity})
        for sample in report.samples:
            state = sample.state
            put(
                "state",
                int(sample.stamp * 1e9) + wall,
                {
                    "step": sample.step,
                    "actuators": actuators,
                    **{name: getattr(state, name) for name in MEASURED},
                    "touch": [] if state.touch is None else state.touch.values,
                    "reference": sample.reference,
                    "warnings": state.warnings,
                },
            )
        last = int(report.samples[-1].stamp * 1e9) + wall if report.samples else start
        for question, answer in report.answers:
            asked = {"topic": question.topic, "text": question.text, "answer": answer}
            put("question", last, asked)
        for one in report.findings:
            put("finding", last, asdict(one))
        writer.finish()  # type: ignore[no-untyped-call]
        return file.getvalue()


def text_of(report: ContactReport) -> str:
    """Return the page, in Markdown."""
    identity = ", ".join(f"{name} {value}" for name, value in report.identity.items())
    ended = f"**It ended early**, {report.ended}.\n\n" if report.ended else ""
    assumptions = (
        f"| {assumption.text} | {assumption.topic} | {assumption.source or 'none'} | "
        f"{f'**{verdict}**' if verdict is Conclusion.REFUTED else verdict} |\n"
        for assumption, verdict in report.judged()
    )
    findings = (f"| {f.topic} | {f.actuator} | {f.verdict} | {f.text} |\n" for f in report.findings)
    answers = (f"- {q.text} **{answer or '(Enter)'}**\n" for q, answer in report.answers)
    return f"""# First contact: {report.device}

Driver `{report.driver}`, {_VERSION}, {time.strftime("%Y-%m-%d %H:%M")}.
The device identifies itself as: {identity or "nothing"}.

{ended}## Assumptions

| assumption | about | source | now |
| --- | --- | --- | --- |
{"".join(assumptions)}
## Findings

| about | actuator | verdict | |
| --- | --- | --- | --- |
{"".join(findings)}
## Answers

{"".join(answers)}
Send this page and the recording beside it to the project: they hold no more than what the device \
measured and what you answered.
"""
