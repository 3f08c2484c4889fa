"""The EGU's images by the frames of its sheet, its parameters, and what is not an image."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.schunk_egu.codec import (
    ERRORS,
    FAST_STOP,
    MODULES,
    REMEDIES,
    WARNINGS,
    Control,
    Input,
    Output,
    Parameter,
    Status,
    data_of,
    float_of,
    float_registers,
    registers,
    text_of,
)
from rtee.errors import FrameError

OUTPUTS = [
    (
        "0C 10 00 47 00 08 10 05 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 F9 2F",
        Output(Control.RUN | Control.ACKNOWLEDGE),
    ),
    (
        "0C 10 00 47 00 08 10 01 20 00 00 10 27 00 00 20 4E 00 00 00 00 00 00 07 A3",
        Output(Control.RUN | Control.MOVE, position=10_000, speed=20_000),
    ),
    (
        "0C 10 00 47 00 08 10 01 10 00 00 00 00 00 00 00 00 00 00 32 00 00 00 E5 58",
        Output(Control.RUN | Control.GRIP, force=50),
    ),
]


@pytest.mark.parametrize(("frame", "output"), OUTPUTS)
def test_an_output_is_the_sheets_frame(frame: str, output: Output) -> None:
    words = output.to_registers()
    head = struct.pack(">BHHB", 16, Parameter.OUTPUT.register, 8, 16)
    assert rtu_frame(12, head + struct.pack(">8H", *words)) == bytes.fromhex(frame)
    assert Output.from_registers(words) == output


def test_the_input_is_asked_for_at_its_number_less_one() -> None:
    pdu = struct.pack(">BHH", 3, Parameter.INPUT.register, 8)
    assert rtu_frame(12, pdu) == bytes.fromhex("0C 03 00 3F 00 08 75 1D")


def test_an_input_is_the_sheets_frame() -> None:
    frame = bytes.fromhex(
        "0C 03 10 31 20 00 00 10 27 00 00 00 00 00 00 00 00 00 00 4F 23",
    )
    found = Input.from_registers(struct.unpack(">8H", frame[3:-2]))
    status = Status.READY | Status.SUCCESS | Status.RECEIVED | Status.REACHED
    assert found == Input(status, 10_000)
    assert rtu_frame(12, b"\x03\x10" + struct.pack(">8H", *found.to_registers())) == frame


def test_the_captured_image_after_power_up_is_read() -> None:
    data = bytes.fromhex("80 00 00 80 FB 00 00 00 00 00 00 00 D9 00 00 00")
    found = Input.from_registers(registers(data))
    assert found == Input(Status.ERROR | Status.BRAKE, 251, FAST_STOP)
    assert data_of(found.to_registers()) == data


def test_only_the_low_byte_of_the_error_counts() -> None:
    assert Input.from_registers((0, 0, 0, 0, 0, 0, 0xF4FF, 0x9401)).error == 0xF4
    assert Input.from_registers((0, 0, 0, 0, 0, 0, 0, 0x9401)).warning == 0x94


def test_an_image_of_another_length_is_refused() -> None:
    with pytest.raises(FrameError, match="6 bytes are not an image"):
        Input.from_registers((0, 0, 0))


@pytest.mark.parametrize("value", [0.0, 0.251, 40.5, -1.5])
def test_a_number_comes_back(value: float) -> None:
    assert float_of(float_registers(value)) == pytest.approx(value, rel=1e-6)
    # The low byte first, in the order of the wire.
    assert data_of(float_registers(1.0)) == bytes.fromhex("00 00 80 3F")


def test_text_ends_at_its_first_zero() -> None:
    assert text_of(registers(b"5.2.0\0\0\0")) == "5.2.0"


@given(st.tuples(*[st.integers(0, 0xFFFF)] * 8))
def test_any_eight_registers_are_images(words: tuple[int, ...]) -> None:
    assert Output.from_registers(words).to_registers() == words
    found = Input.from_registers(words)
    assert found.to_registers()[:4] == words[:4]


def test_models_errors_and_warnings_are_named() -> None:
    assert (MODULES[6], MODULES[13], MODULES[14], MODULES[19]) == (
        "EGU 50 N-B",
        "EGU 80 M-B",
        "EGK 25 N-B",
        "EGK 50 M-B",
    )
    assert set(MODULES) == set(range(6, 28))
    assert all(name for name in (*ERRORS.values(), *WARNINGS.values()))
    assert {0x28, 0xD9, 0xEF, 0xF4} <= set(ERRORS)
    # An invalid command is a fault of the driver, for which nobody knows a remedy.
    assert set(ERRORS) - set(REMEDIES) == {0xD4}
