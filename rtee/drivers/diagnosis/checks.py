"""The checks of a diagnosis and their results."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    WARNING = "warning"
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Check:
    """A check with its result and the remedy: one line of a diagnosis.

    Attributes:
        subject: The subject of the check.
        verdict: Its result.
        text: What was found, in words.
        remedy: What to type or do; empty if the verdict is ok.
    """

    subject: str
    verdict: Verdict
    text: str
    remedy: str = ""


def ok(subject: str, text: str) -> Check:
    """Return a check that passed."""
    return Check(subject, Verdict.OK, text)


def warning(subject: str, text: str, remedy: str) -> Check:
    """Return a check that found something to improve, with the remedy."""
    return Check(subject, Verdict.WARNING, text, remedy)


def wrong(subject: str, text: str, remedy: str) -> Check:
    """Return a check that failed, with the remedy: the device cannot work."""
    return Check(subject, Verdict.WRONG, text, remedy)
