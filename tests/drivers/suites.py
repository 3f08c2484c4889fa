"""Which tests of a suite are left to `make heavy`, since another suite shows the same."""

from __future__ import annotations

from types import FunctionType
from typing import TypeVar

import pytest

from rtee.testing import DriverContract

Suite = TypeVar("Suite", bound=type[DriverContract])

OF_THE_WIRE = (
    "test_a_faulty_wire_is_survived",
    "test_a_slow_device_leaves_a_fast_one_its_rate",
    "test_it_works_over_a_real_port_in_real_time",
    "test_unplugging_again_and_again_leaks_nothing",
)
"""Tests of the wire alone."""


def heavy(suite: Suite, *names: str) -> Suite:
    """Mark tests of a suite as heavy, but not those of the suite from which it inherits them."""
    for name in names:
        setattr(suite, name, pytest.mark.heavy(_copy(suite, name)))
    return suite


def _copy(suite: type[DriverContract], name: str) -> FunctionType:
    """Return a copy of a test, whose marks are its own."""
    test = getattr(suite, name)
    assert isinstance(test, FunctionType)
    copy = FunctionType(test.__code__, test.__globals__, name, test.__defaults__, test.__closure__)
    copy.__dict__.update(test.__dict__)
    copy.__doc__ = test.__doc__
    return copy


def few_faults(suite: Suite) -> Suite:
    """Mark as heavy the faults of the wire that decoders are fuzzed with; a class decorator.

    Left are frames that are wrong, late, lost, or there twice.
    """
    copied = _copy(suite, "test_a_faulty_wire_is_survived")
    suite.test_a_faulty_wire_is_survived = pytest.mark.samples(
        "corrupt", "delay", "drop", "duplicate"
    )(copied)  # type: ignore[method-assign]
    return suite


def same_wire(suite: Suite) -> Suite:
    """Mark as heavy what another suite of the family shows of the same wire; a class decorator."""
    return heavy(suite, *OF_THE_WIRE)
