"""Emulated Feetech servos, asked by bytes: instructions, memory, protection, objects."""

from __future__ import annotations

from typing import Any

import pytest

from rtee.drivers.emulators import make_emulator
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import Frame, Instruction, Status
from rtee.drivers.feetech.emulator import FeetechEmulator, FeetechProperties
from rtee.drivers.feetech.servo import FeetechServoProperties
from rtee.drivers.feetech.table import FAMILIES, Register
from rtee.errors import ConfigError
from tests.drivers.objects import obstruct


def line(family: str = "sts", ids: tuple[int, ...] = (1,), **properties: Any) -> FeetechEmulator:
    servo = FeetechServoProperties(**properties.pop("servo", {}))
    made = FeetechEmulator(FeetechProperties(family, ids, servo, **properties))  # type: ignore[arg-type]
    made.step(0.0)
    return made


def ask(emulator: FeetechEmulator, text: str, now: float = 0.0) -> list[str]:
    answers = emulator.feed(bytes.fromhex(text), now)
    return [answer.hex(" ").upper() for answer in answers]


def write(emulator: FeetechEmulator, number: int, register: Register, value: int) -> None:
    params = bytes([register.address]) + emulator.family.pack(register, value)
    emulator.feed(Frame(number, Instruction.WRITE, params).to_bytes(), 0.0)


@pytest.mark.parametrize(
    ("family", "request_", "answer"),
    [
        ("scs", "FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
        ("scs", "FF FF 01 04 02 03 02 F3", "FF FF 01 04 00 05 04 F1"),
        ("sts", "FF FF 01 04 02 03 02 F3", "FF FF 01 04 00 09 03 EE"),
        ("scs", "FF FF 01 04 02 38 02 BE", "FF FF 01 04 00 01 FF FA"),
        ("scs", "FF FF 01 04 03 28 01 CE", "FF FF 01 02 00 FC"),
        ("scs", "FF FF 01 09 03 2A 01 FF 00 00 03 E8 DD", "FF FF 01 02 00 FC"),
        ("sts", "FF FF 01 02 09 F3", "FF FF 01 02 00 FC"),
        ("sts", "FF FF 01 02 0A F2", "FF FF 01 02 00 FC"),
    ],
)
def test_it_answers_as_published(family: str, request_: str, answer: str) -> None:
    assert ask(line(family), request_) == [answer]


def test_the_state_of_a_servo_is_as_published() -> None:
    servos = line("scs", servo={"voltage": 5.0})
    servos.ordered[0].axis.temperature = 30.0
    assert ask(servos, "FF FF 01 04 02 38 0B B5") == [
        "FF FF 01 0D 00 01 FF 00 00 00 00 32 1E 00 00 00 A1"
    ]


def test_several_answer_a_sync_read_one_after_the_other_where_their_family_does() -> None:
    special = {
        1: FeetechServoProperties(voltage=7.4),
        2: FeetechServoProperties(voltage=7.4, start=1000.0),
    }
    servos = line(ids=(1, 2), special=special)
    for servo in servos.ordered:
        servo.axis.temperature = 30.0
    together = "FF FF FE 06 82 38 0F 01 02 2F"
    state = "FF FF 01 11 00 00 08 00 00 00 00 4A 1E 00 00 00 {}"
    # The published example has the same up to the position that the loop follows.
    assert [one[:44] for one in ask(servos, together)] == [
        state[:44],
        "FF FF 02 11 00 E8 03 00 00 00 00 4A 1E 00 00",
    ]
    # An id that is not there leaves a gap, and the rest goes on.
    assert len(ask(servos, Frame(0xFE, 0x82, b"\x38\x0f\x01\x07\x02").to_bytes().hex())) == 2
    read = "FF FF FE 06 82 38 02 01 02 3C"
    assert ask(line("scs", (1, 2)), read) == []
    assert len(ask(line("scs", (1, 2), sync_read=True), read)) == 2


def test_what_is_sent_to_all_is_obeyed_by_all_and_answered_by_none() -> None:
    servos = line("scs", tuple(range(1, 9)))
    torque = "FF FF FE 14 83 28 01 01 01 02 01 03 01 04 01 05 01 06 01 07 01 08 01 15"
    assert ask(servos, torque) == []
    assert [servo.get(table.TORQUE) for servo in servos.ordered] == [1] * 8
    assert ask(servos, "FF FF FE 04 03 28 00 D2") == []
    assert [servo.get(table.TORQUE) for servo in servos.ordered] == [0] * 8
    goals = "01 01 87 02 02 76 03 01 87 04 02 76 05 01 87 06 02 76 07 01 87 08 02 76"
    ask(servos, f"FF FF FE 1C 83 2A 02 {goals} 12")
    assert [servo.get(table.GOAL_POSITION) for servo in servos.ordered] == [391, 630] * 4


def test_a_ping_to_all_is_answered_in_turn_or_garbled_by_two() -> None:
    ping = "FF FF FE 02 01 FE"
    assert ask(line(ids=(5,)), ping) == ["FF FF 05 02 00 F8"]
    assert ask(line(ids=(1, 2)), ping) == ["FF FF 01 02 00 FC", "FF FF 02 02 00 FB"]
    assert ask(line("scs", ids=(1, 2)), ping) == ["FF FF 00 02 00 F8"]  # FC and FB on one wire


def test_a_new_id_is_confirmed_under_the_old_one() -> None:
    """LeRobot's set-up and ORCA's wait for that; the servo answers to the new id from then on."""
    servos = line()
    assert ask(servos, "FF FF 01 04 03 05 06 EC") == ["FF FF 01 02 00 FC"]
    assert ask(servos, "FF FF 01 02 01 FB") == []
    assert ask(servos, "FF FF 06 02 01 F6") == ["FF FF 06 02 00 F7"]


def test_the_table_goes_on_to_the_factorys_registers() -> None:
    """Rustypot reads 80 to 86: thresholds, speeds and accelerations that the factory sets."""
    [answer] = ask(line(), "FF FF 01 04 02 50 07 A1")
    assert answer.startswith("FF FF 01 09 00")
    assert ask(line(), "FF FF 01 04 02 50 08 A0") == ["FF FF 01 02 00 FC"]


def test_a_servo_of_another_id_or_a_wrong_checksum_gets_silence() -> None:
    assert ask(line(), "FF FF 02 02 01 FA") == []
    assert ask(line(), "FF FF 01 02 01 FA") == []
    assert ask(line(), "FF FF 01 02 77 85") == []  # no instruction


def test_settings_are_stored_only_when_unlocked() -> None:
    servos = line("scs", (1,), servo={"reboot_time": 0.0})
    write(servos, 1, table.P, 20)
    assert servos.ordered[0].get(table.P) == 20
    servos.power_cycle(0.0)
    assert servos.ordered[0].get(table.P) == 15
    # Unlock, give it the id 5, lock under the new one.
    for text in ("FF FF 01 04 03 30 00 C7", "FF FF 01 04 03 05 05 ED", "FF FF 05 04 03 30 01 C2"):
        assert len(ask(servos, text)) == 1
    servos.power_cycle(0.0)
    assert servos.ordered[0].number == 5
    assert servos.ordered[0].get(FAMILIES["scs"].lock) == 1
    assert ask(servos, "FF FF 05 02 06 F2") == ["FF FF 05 02 00 F8"]  # factory values, id kept
    assert servos.ordered[0].number == 5


def test_a_write_waits_for_action() -> None:
    servos = line("scs")
    assert ask(servos, "FF FF 01 05 04 2A 01 FF CB") == ["FF FF 01 02 00 FC"]
    servo = servos.ordered[0]
    write(servos, 1, table.GOAL_POSITION, 600)
    assert (servo.get(table.PENDING), servo.get(table.GOAL_POSITION)) == (1, 600)
    assert ask(servos, "FF FF FE 02 05 FA") == []
    assert (servo.get(table.PENDING), servo.get(table.GOAL_POSITION)) == (0, 511)


def test_it_answers_to_reading_alone_where_its_level_says_so() -> None:
    servos = line(servo={"level": 0})
    assert ask(servos, "FF FF 01 04 03 28 01 CE") == []
    assert ask(servos, "FF FF 01 02 01 FB") == ["FF FF 01 02 00 FC"]
    assert servos.ordered[0].get(table.TORQUE) == 1


@pytest.mark.parametrize(
    ("text", "position"),
    [
        ("FF FF 01 04 0B F4 01 FA", 500),
        ("FF FF 01 02 0B F1", 2048),
        ("FF FF 01 04 03 28 80 4F", 2048),
    ],
)
def test_the_present_position_becomes_what_it_is_told(text: str, position: int) -> None:
    servos = line(servo={"start": 1234.0})
    assert ask(servos, text) == ["FF FF 01 02 00 FC"]
    assert servos.ordered[0].position == position
    servos.power_cycle(0.0)
    assert servos.ordered[0].position == position


def test_a_reboot_takes_a_while() -> None:
    servos = line()
    assert ask(servos, "FF FF 01 02 08 F4") == []
    assert ask(servos, "FF FF 01 02 01 FB", 0.5) == []
    assert ask(servos, "FF FF 01 02 01 FB", 0.9) == ["FF FF 01 02 00 FC"]


def test_it_goes_to_its_goal_at_its_speed_within_its_limits() -> None:
    servos = line()
    # Acceleration 50, position 2048, time 0, speed 1000; then 600 counts on.
    ask(servos, "FF FF 01 0A 03 29 32 00 08 00 00 E8 03 A3")
    servo = servos.ordered[0]
    assert servo.get(table.TORQUE) == 1  # a goal switches it on
    write(servos, 1, table.GOAL_POSITION, 2648)
    servos.step(0.3)
    assert servo.axis.position == pytest.approx(2348, abs=5)
    assert ask(servos, "FF FF 01 04 02 3A 02 BC", 0.3) == ["FF FF 01 04 00 E8 03 0F"]
    write(servos, 1, table.GOAL_POSITION, 5000)
    servos.step(10.0)
    assert servo.position == 4095
    slow = line(servo={"phase": 8})
    ask(slow, "FF FF 01 09 03 2A D0 07 00 00 04 00 ED")
    slow.step(0.1)
    # 4 counts of 0.732 rpm are 200 steps a second.
    assert slow.ordered[0].axis.position == pytest.approx(2028, abs=1.5)


def test_a_speed_mode_turns_on_and_on() -> None:
    servos = line(servo={"limits": (0, 0)})
    write(servos, 1, table.MODE, 1)
    write(servos, 1, table.TORQUE, 1)
    ask(servos, "FF FF 01 05 03 2E E8 83 5D")  # -1000
    servos.step(5.0)
    assert servos.ordered[0].position == pytest.approx(2048 - 5000, abs=10)


@pytest.mark.parametrize(("family", "after"), [("scs", 4.0), ("sts", 2.0)])
def test_a_servo_that_pushes_on_switches_off(family: str, after: float) -> None:
    servos = line(family)
    servo = servos.ordered[0]
    obstruct(servo.axis, servo.axis.position + 10, 100.0)
    write(servos, 1, table.GOAL_POSITION, round(servo.axis.position) + 400)
    for step in range(1, 12):
        servos.step(step * 0.05)
    assert abs(servo.axis.effort) == 1000.0
    servos.step(after)
    assert (servo.status, servo.get(table.TORQUE)) == (Status(0), 1)
    servos.step(after + 0.6)
    assert (servo.status, servo.get(table.TORQUE)) == (Status.OVERLOAD, 0)
    assert ask(servos, "FF FF 01 02 01 FB", after + 0.6) == ["FF FF 01 02 20 DC"]
    write(servos, 1, table.TORQUE, 0)
    assert servo.status == Status(0)


def test_an_overload_leaves_the_protective_torque_where_its_mask_keeps_it_on() -> None:
    servos = line("sts", servo={"unload": 0})
    servo = servos.ordered[0]
    obstruct(servos.servos[1].axis, 2060.0, 50.0)
    write(servos, 1, table.GOAL_POSITION, 2400)
    for step in range(1, 60):
        servos.step(step * 0.05)
    assert servo.status == Status.OVERLOAD
    assert servo.axis.effort == pytest.approx(200.0)


def test_a_smaller_torque_is_no_overload() -> None:
    servos = line("sts")
    obstruct(servos.servos[1].axis, 2060.0, 50.0)
    write(servos, 1, table.TORQUE_LIMIT, 750)
    write(servos, 1, table.GOAL_POSITION, 2400)
    for step in range(1, 100):
        servos.step(step * 0.05)
    servo = servos.ordered[0]
    assert (servo.status, servo.axis.effort) == (Status(0), 750.0)


def test_it_gets_hot() -> None:
    servos = line("scs")
    servos.ordered[0].axis.temperature = 81.0
    servos.step(0.1)
    assert servos.ordered[0].status == Status.OVERHEATING


def test_the_servos_of_a_hand_begin_with_their_actuators_at_zero() -> None:
    made = make_emulator(
        "feetech",
        {
            "family": "scs",
            "servos": {"a": {"id": 3}, "p1": {"id": 4, "zero": 500}, "p2": {"id": 5}},
            "differential": {
                "flexion": [[-0.5, 0.0], [1.0, 1.0]],
                "pairs": {"p": {"servos": ["p1", "p2"], "actuators": ["f", "t"]}},
            },
            "emulator": {"object": "0.5"},
        },
    )
    assert isinstance(made, FeetechEmulator)
    starts = {servo.number: servo.axis.position for servo in made.ordered}
    # Half a radian is 98 counts.
    assert starts == {3: 511.0, 4: 402.0, 5: 609.0}
    closings = made.closings()
    assert [round(one.closed - one.opened) for one in closings] == [307, 294, -294]
    for one in closings:
        assert one.motor.obstacle is not None
        assert one.motor.obstacle.contact == pytest.approx((one.opened + one.closed) / 2)


def test_properties_that_cannot_be_are_told() -> None:
    with pytest.raises(ConfigError, match="family"):
        make_emulator("feetech", {"emulator": {"family": "abc"}})
    with pytest.raises(ConfigError, match="unknown property 'idz'"):
        make_emulator("feetech", {"emulator": {"idz": [1]}})
    with pytest.raises(ConfigError, match="ids"):
        make_emulator("feetech", {"emulator": {"ids": [300]}})
    with pytest.raises(ConfigError, match="unknown fault 'broken'"):
        line().inject("broken")


def test_a_position_to_calibrate_to_has_two_bytes() -> None:
    servos = line("sts")
    before = ask(servos, "FF FF 01 04 02 38 02 BE")
    # Three bytes: no source says what they mean, so they are acknowledged without effect.
    assert ask(servos, "FF FF 01 05 0B 03 02 FF EA") == ["FF FF 01 02 00 FC"]
    assert ask(servos, "FF FF 01 04 02 38 02 BE") == before


def test_a_servo_whose_protection_allows_no_current_has_no_torque() -> None:
    servos = line("hls")
    for register, value in ((table.PROTECTION_CURRENT, 0), (table.TORQUE, 1)):
        write(servos, 1, register, value)
    assert not servos.servos[1].axis.enabled
