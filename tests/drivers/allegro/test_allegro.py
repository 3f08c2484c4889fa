"""The Allegro Hand's frames, its joint control, and the driver against the emulator."""

from __future__ import annotations

import contextlib
import math
from typing import Any, Literal

import anyio
import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee import monotonic
from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.simulated_can import SimulatedCan
from rtee.drivers.allegro import codec
from rtee.drivers.allegro.codec import Command, HandInfo, Periods, Status
from rtee.drivers.allegro.control import JointControl
from rtee.drivers.allegro.driver import AllegroDriver, AllegroOptions
from rtee.drivers.allegro.emulator import AllegroEmulator, AllegroProperties
from rtee.errors import BusTimeout, ConfigError, DeviceFault, HandshakeError, NotConnected
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting

# --- frames --------------------------------------------------------------------------------------


def test_frames_are_those_of_the_sheet() -> None:
    assert codec.order(Command.SYSTEM_ON) == CanFrame(0x100)
    assert codec.order(Command.SYSTEM_OFF) == CanFrame(0x104)
    assert Periods(3).to_frame() == CanFrame(0x204, bytes.fromhex("030000000000"))
    assert codec.request(Command.HAND_INFO) == CanFrame(0x200, remote=True)
    assert codec.request(Command.SERIAL) == CanFrame(0x220, remote=True)
    assert codec.identifier(Command.SET_TORQUE + 3) == 0x18C
    assert codec.identifier(Command.FINGER_POSE, 2) == 0x82
    assert codec.split(0x82) == (Command.FINGER_POSE, 2)
    info = HandInfo(0x0400, 0x0201, 0, 40, Status.SERVO_ON)
    assert info.to_bytes() == bytes.fromhex("00040102002801")
    assert HandInfo.from_bytes(info.to_bytes()) == info
    assert info.version == 4


def test_torques_and_positions_are_those_of_the_sheet() -> None:
    torques = [t * codec.SCALES[4].pwm_per_torque for t in (0.1, -0.2, 0.05, 0.0)]
    assert codec.pack_counts(torques) == bytes.fromhex("780010FF3C000000")
    angles = [math.radians(a) for a in (10, 45, -5, 20)]
    for version, data in ((4, "AE079022 29FC5D0F"), (5, "7200FF01C7FFE300")):
        scale = codec.SCALES[version]
        counts = [scale.to_count(a) for a in angles]
        assert codec.pack_counts(counts) == bytes.fromhex(data.replace(" ", ""))
        assert codec.read_counts(codec.pack_counts(counts)) == tuple(counts)


@given(st.floats(-2.8, 2.8), st.sampled_from([4, 5]))
def test_angles_have_an_inverse(angle: float, version: int) -> None:
    scale = codec.SCALES[version]
    assert scale.to_rad(scale.to_count(angle)) == pytest.approx(angle, abs=scale.rad_per_count)


@given(st.binary(max_size=8))
def test_any_data_is_read_or_refused(data: bytes) -> None:
    for read, size in (
        (codec.read_counts, 8), (Periods.from_bytes, 6), (HandInfo.from_bytes, None),
    ):  # fmt: skip
        if size is None or len(data) == size:
            with contextlib.suppress(CodecError):
                read(data)
        else:
            with pytest.raises(CodecError):
                read(data)


# --- control -------------------------------------------------------------------------------------


def control(**changes: float) -> JointControl:
    values = {"kp": 1.0, "kd": 0.0, "max_torque": 10.0, "smoothing": 0.005, **changes}
    return JointControl(codec.SCALES[4], **values)


def test_torques_come_with_the_complete_set_and_never_exceed_the_limits() -> None:
    made = control()
    for joint in range(16):
        made.refer(joint, 2.0)
    made.limit(5, 0.1)
    made.limit(6, 99.0)
    assert [made.receive(finger, (0, 0, 0, 0), 1.0) for finger in (2, 0, 3)] == [None] * 3
    counts = made.receive(1, (0, 0, 0, 0), 1.0)
    assert counts is not None
    assert counts[0] == [375, 675, 450, 285]
    assert counts[1] == [375, 120, 450, 285]
    assert counts[3] == [525, 405, 270, 270]


def test_a_joint_without_reference_gets_no_torque() -> None:
    made = control()
    made.refer(0, 0.1)
    made.refer(1, None)
    made.receive(0, (0, 0, 0, 0), 1.0)
    made.receive(1, (0, 0, 0, 0), 1.0)
    made.receive(2, (0, 0, 0, 0), 1.0)
    assert made.receive(3, (0, 0, 0, 0), 1.0) == [[120, 0, 0, 0], *[[0] * 4] * 3]


@pytest.mark.parametrize("lost", range(4))
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 0, 3, 1)])
def test_a_lost_frame_does_not_make_the_sets_after_it_of_two_moments(
    lost: int, order: tuple[int, ...]
) -> None:
    made = control(period=0.003)
    moments = []
    for number in range(9):
        for place, finger in enumerate(order):
            stamp = 1.0 + 0.003 * number + 1e-4 * place
            if (number, place) == (3, lost):
                continue
            if made.receive(finger, (100 * number,) * 4, stamp) is not None:
                counts = [made.scale.to_count(angle) for angle in made.position[::4]]
                moments.append(sorted({count // 100 for count in counts}))
    assert moments[:3] == [[0], [1], [2]]
    assert moments[-3:] == [[6], [7], [8]]


def test_sets_that_waited_in_the_computer_make_no_speed_of_their_own() -> None:
    made = JointControl(
        codec.SCALES[4], kp=0.0, kd=0.1, max_torque=1.0, smoothing=0.005, period=0.003
    )
    for number in range(60):
        stamp = 1.0 + 0.03 * (number // 10) + 1e-4 * (number % 10)  # ten at once, every 30 ms
        for finger in range(4):
            made.receive(finger, (10 * number,) * 4, stamp)
    step = made.scale.to_rad(10) - made.scale.to_rad(0)
    assert abs(made.velocity[0]) < 1.2 * abs(step) / 0.003


@pytest.mark.parametrize(("friction", "inertia"), [(0.005, 5e-4), (0.02, 5e-4), (0.01, 1e-3)])
def test_joints_come_to_their_goal_soon_and_stay_there_whatever_their_friction(
    friction: float, inertia: float
) -> None:
    options = AllegroOptions()
    made = control(
        kp=options.kp,
        kd=options.kd,
        ki=options.ki,
        most_integral=options.max_integral,
        max_torque=options.max_torque,
        smoothing=options.smoothing,
        period=0.003,
    )
    hand = AllegroEmulator(AllegroProperties(start=0.0, friction=friction, inertia=inertia))
    hand.on_frame(codec.order(Command.SYSTEM_ON), 0.0)
    goals = [0.05 * (number + 1) for number in range(16)]
    away = []
    for tick in range(1, 401):
        now = 0.003 * tick
        share, rate = min(now / 0.4, 1.0), (now < 0.4) / 0.4
        for joint, goal in enumerate(goals):
            made.refer(joint, share * goal, rate * goal)
        hand.step(now)
        angles = [joint.angle for joint in hand.joints]
        if now > 0.4 + 0.3:
            away.append(math.dist(angles, goals))
        for finger in range(4):
            four = [made.scale.to_count(angle) for angle in angles[4 * finger : 4 * finger + 4]]
            torques = made.receive(finger, four, now)
        assert torques is not None
        for finger, counts in enumerate(torques):
            number = codec.identifier(Command.SET_TORQUE + finger)
            hand.on_frame(CanFrame(number, codec.pack_counts(counts)), now)
    assert max(away) < 0.01


# --- driver --------------------------------------------------------------------------------------


def device(n: int = 16, **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="hand",
        hand="allegro",
        driver="allegro",
        actuators=tuple(
            ActuatorSpec(f"j{i}", JointKind.REVOLUTE, -0.5, 1.7, 8.0, 20.0, 400.0, 0.4, 0.0)
            for i in range(n)
        ),
        options=options,
        emulated=True,
    )


connected = connecting(AllegroDriver)


def hand(pool: BusPool) -> AllegroEmulator:
    found = pool.played("allegro/hand")
    assert isinstance(found, AllegroEmulator)
    return found


async def until(check: Any, seconds: float = 5.0) -> None:
    end = monotonic.now() + seconds
    while not check():
        assert monotonic.now() < end
        await anyio.sleep(0.01)


@pytest.mark.anyio
@pytest.mark.parametrize("version", [4, 5])
async def test_follows_a_reference(version: int) -> None:
    spec = device(emulator={"version": version})
    async with BusPool() as pool, connected(pool, spec) as made:
        assert made.capabilities.identity["model"] == f"Allegro Hand V{version}"
        assert made.capabilities.identity["serial"] == {4: "SAH040AR", 5: "V5AR0001"}[version]
        assert not any(Command.SET_TORQUE + f in hand(pool).frames for f in range(4))
        await made.activate()
        start = (await patiently(made.sense)).position
        goal = start + np.linspace(-0.3, 0.5, 16)
        for share in np.linspace(0.0, 1.0, 40):
            await made.move(Reference.at(start + share * (goal - start)))
            await anyio.sleep(0.01)
        await until(lambda: np.abs(np.array(made.control.position) - goal).max() < 0.03)
        assert (await patiently(made.sense)).temperature[0] == pytest.approx(30, abs=5)


@pytest.mark.parametrize(
    ("version", "left", "serial", "side"),
    [
        (4, False, b"SAH040AR", "right"),
        (4, True, b"SAH040AL", "left"),
        (5, False, b"V5AR0001", "right"),
        (5, True, b"V5AL0001", "left"),
    ],
)
def test_the_serial_number_tells_type_and_side_where_the_vendor_reads_them(
    version: Literal[4, 5], left: bool, serial: bytes, side: str
) -> None:
    hand = AllegroEmulator(AllegroProperties(version=version, left=left))
    [told] = hand.on_frame(codec.request(Command.SERIAL), 0.0)
    assert told.data == serial
    [frame] = hand.on_frame(codec.request(Command.HAND_INFO), 0.0)
    assert codec.side_of(codec.HandInfo.from_bytes(frame.data), serial.decode()) == side
    if version == 5:  # the vendor's driver: bytes[2] is the type, bytes[3] the side
        assert chr(serial[2]) in "AB"
        assert chr(serial[3]) == side[0].upper()


@pytest.mark.anyio
@pytest.mark.parametrize("version", [4, 5])
async def test_a_hand_of_the_other_side_is_refused(version: int) -> None:
    spec = device(side="right", emulator={"version": version, "left": True})
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match="a right hand, found a left one"):
            async with connected(pool, spec):
                pass


@pytest.mark.anyio
async def test_activation_holds_the_measured_pose_and_closing_switches_off() -> None:
    async with BusPool() as pool:
        async with connected(pool, device()) as made:
            await made.activate()
            where = (await patiently(made.sense)).position
            await anyio.sleep(0.1)
            assert (await patiently(made.sense)).position == pytest.approx(where, abs=0.01)
            assert hand(pool).servo
        await until(lambda: not hand(pool).servo and not hand(pool).periods.joints)
        assert all(joint.torque == 0.0 for joint in hand(pool).joints)


@pytest.mark.anyio
async def test_an_object_is_pressed_with_the_effort_limit() -> None:
    async with BusPool() as pool, connected(pool, device(kp=3.0)) as made:
        await made.activate()
        obstruct(hand(pool).joints[1], 0.6, 8.0)
        goal = (await patiently(made.sense)).position.copy()
        goal[1] = 1.4
        limit = np.full(16, 0.2)
        await made.move(Reference.at(goal, max_effort=limit))
        await until(lambda: made.control.position[1] > 0.6 and abs(made.control.velocity[1]) < 0.05)
        await anyio.sleep(0.2)
        state = await patiently(made.sense)
        assert state.effort[1] == pytest.approx(0.2, abs=0.01)
        assert state.position[1] == pytest.approx(0.6 + 0.2 / 8.0, abs=0.02)


@pytest.mark.anyio
async def test_faults_are_named_and_recovered() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=1)) as made:
        await made.activate()
        hand(pool).inject("over_temperature")
        with pytest.raises(DeviceFault, match="over-temperature"):
            await made.sense()
        with pytest.raises(DeviceFault, match="over-temperature"):
            await made.examine()
        with pytest.raises(DeviceFault, match="over-temperature"):
            await made.recover()
        hand(pool).clear()
        await made.recover()
        await made.activate()
        assert np.isfinite((await patiently(made.sense)).position).all()
        hand(pool).servo = False
        with pytest.raises(DeviceFault, match="motors off"):
            await made.sense()


def torques_when_switched_on(hand: AllegroEmulator) -> list[list[int]]:
    """Let a hand note the torques of each finger that it was sent last when it is switched on."""
    last, noted = [9] * 4, []
    answer = hand.on_frame

    def hear(frame: CanFrame, now: float) -> list[CanFrame]:
        command = codec.split(frame.id)[0]
        finger = command - Command.SET_TORQUE
        if 0 <= finger < 4:
            last[finger] = max(map(abs, codec.read_counts(frame.data)))
        if command == Command.SYSTEM_ON:
            noted.append(list(last))
        return answer(frame, now)

    hand.on_frame = hear  # type: ignore[method-assign]
    return noted


@pytest.mark.anyio
async def test_recovering_does_not_switch_on_with_the_last_torques() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=1)) as made:
        await made.activate()
        noted = torques_when_switched_on(hand(pool))
        await made.move(Reference.at(np.full(16, 1.0)))
        await until(lambda: max(map(abs, made.control.torque)) > 0.1)
        hand(pool).inject("communication")
        with pytest.raises(DeviceFault, match="communication"):
            await made.sense()
        hand(pool).clear()
        await made.recover()
        assert noted == [[0, 0, 0, 0]]


@pytest.mark.anyio
async def test_an_activation_that_fails_leaves_the_hand_without_torque(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def silent(*, patient: bool = False) -> HandInfo:
        await until(lambda: Command.SET_TORQUE in hand(pool).frames)
        raise BusTimeout("can0", "no answer")

    async with BusPool() as pool, connected(pool, device()) as made:
        monkeypatch.setattr(made.link, "info", silent)
        with pytest.raises(BusTimeout):
            await made.activate()
        sets = made.control.sets
        await until(lambda: made.control.sets > sets + 2)
        assert not any(made.control.torque)
        await until(lambda: not any(joint.torque for joint in hand(pool).joints))
        sent = hand(pool).frames[Command.SET_TORQUE]
        sets = made.control.sets
        await until(lambda: made.control.sets > sets + 2)
        assert hand(pool).frames[Command.SET_TORQUE] == sent


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("options", "late"),
    [({}, 0.09), ({"period": 50, "deadline": 0.3}, 0.29)],
    ids=["3 ms", "50 ms"],
)
async def test_a_hand_that_falls_silent_is_noticed(options: dict[str, Any], late: float) -> None:
    async with BusPool() as pool, connected(pool, device(**options)) as made:
        await made.activate()
        hand(pool).inject("silent")
        await anyio.sleep(late)
        await made.sense()
        await anyio.sleep(0.07)
        with pytest.raises(BusTimeout, match=r"no positions for more than 0\.(103|35) s"):
            await made.sense()


def keep_the_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let hands answer no request for their serial number."""
    told = AllegroEmulator._report

    def report(emulator: AllegroEmulator, command: int) -> list[CanFrame]:
        return [] if command == Command.SERIAL else told(emulator, command)

    monkeypatch.setattr(AllegroEmulator, "_report", report)


@pytest.mark.anyio
async def test_a_hand_that_does_not_tell_its_serial_number_is_driven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keep_the_serial_number(monkeypatch)
    async with BusPool() as pool, connected(pool, device()) as made:
        assert made.capabilities.identity["serial"] == "not reported"
        await made.activate()


@pytest.mark.anyio
async def test_a_finger_that_falls_silent_is_named_and_the_hand_goes_limp() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=10_000)) as made:
        await made.activate()
        await made.move(Reference.at(np.full(16, 1.0)))
        await until(lambda: max(abs(joint.torque) for joint in hand(pool).joints) > 0.1)
        hand(pool).inject("silent_finger")
        # Well before anybody asks for the state: the hand would keep its last torques.
        await anyio.sleep(0.03)
        assert not any(joint.torque for joint in hand(pool).joints)
        with pytest.raises(DeviceFault, match=r"limp: no positions of ring.*rtee recover"):
            await made.sense()


@pytest.mark.anyio
@pytest.mark.parametrize("stopped", [False, True])
async def test_a_hand_that_went_limp_stays_so_until_it_is_recovered_where_it_is(
    stopped: bool,
) -> None:
    async with BusPool() as pool, connected(pool, device(info_every=10_000)) as made:
        await made.activate()
        goal = Reference.at(np.full(16, 1.0))
        await made.move(goal)
        await until(lambda: max(abs(joint.torque) for joint in hand(pool).joints) > 0.1)
        hand(pool).inject("silent_finger")
        await anyio.sleep(0.15)
        for joint in hand(pool).joints:
            joint.angle -= 0.2
        if stopped:  # with positions that are too old to be held
            await made.stop()
        hand(pool).clear()
        sets = made.control.sets
        await made.move(goal)
        await until(lambda: made.control.sets > sets + 10)
        assert not any(joint.torque for joint in hand(pool).joints)
        with pytest.raises(DeviceFault, match="limp"):
            await made.sense()
        await made.recover()
        pushed = [joint.angle for joint in hand(pool).joints]
        await made.activate()
        await anyio.sleep(0.1)
        assert (await made.sense()).position == pytest.approx(pushed, abs=0.02)


@pytest.mark.anyio
async def test_a_stop_leaves_a_limp_hand_limp_though_its_finger_is_back() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=10_000)) as made:
        await made.activate()
        await made.move(Reference.at(np.full(16, 1.0)))
        hand(pool).inject("silent_finger")
        await anyio.sleep(0.15)
        hand(pool).clear()
        await anyio.sleep(0.05)
        await made.stop()
        for joint in hand(pool).joints:
            joint.angle -= 0.2
        await anyio.sleep(0.02)
        assert not any(joint.torque for joint in hand(pool).joints)


@pytest.mark.anyio
async def test_one_recovery_is_enough_after_a_power_cycle() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=1)) as made:
        await made.activate()
        hand(pool).power_cycle(monotonic.now())
        await anyio.sleep(0.3)
        with pytest.raises(DeviceFault, match="motors off"):
            await made.sense()
        await made.recover()
        await made.activate()
        assert np.isfinite((await made.sense()).position).all()


@pytest.mark.anyio
async def test_zero_torques_that_get_lost_are_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async with BusPool() as pool, connected(pool, device(info_every=10_000)) as made:
        await made.activate()
        await made.move(Reference.at(np.full(16, 1.0)))
        await until(lambda: max(abs(joint.torque) for joint in hand(pool).joints) > 0.1)
        send, lost = made.link.torques, []

        def torques(counts: Any) -> None:
            if not lost and not any(map(any, counts)):
                lost.append(counts)
                raise BusTimeout("can0", "the queue is full")
            send(counts)

        monkeypatch.setattr(made.link, "torques", torques)
        hand(pool).inject("silent_finger")
        await until(lambda: lost and not any(joint.torque for joint in hand(pool).joints))


@pytest.mark.anyio
async def test_a_stop_of_a_hand_without_positions_takes_its_last_torques_away() -> None:
    async with BusPool() as pool, connected(pool, device(info_every=10_000)) as made:
        await made.activate()
        await made.move(Reference.at(np.full(16, 1.0)))
        await until(lambda: max(abs(joint.torque) for joint in hand(pool).joints) > 0.1)
        hand(pool).periods = Periods(0)
        await anyio.sleep(0.15)
        assert any(joint.torque for joint in hand(pool).joints)
        await made.stop()
        await until(lambda: not any(joint.torque for joint in hand(pool).joints))


@pytest.mark.anyio
async def test_a_side_that_is_given_but_not_reported_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keep_the_serial_number(monkeypatch)
    spec = device(side="left", emulator={"version": 5})
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match="a left hand, found one that does not report"):
            async with connected(pool, spec):
                pass


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"emulator": {"hand": 1}, "deadline": 0.02}, NotConnected, "as number 0"),
        ({"version": 5, "emulator": {"version": 4}}, HandshakeError, "version 5, found version 4"),
        ({"side": "left"}, HandshakeError, "a left hand, found a right one"),
    ],
)
async def test_another_hand_is_refused(
    options: dict[str, Any], error: type[Exception], sentence: str
) -> None:
    async with BusPool() as pool:
        with pytest.raises(error, match=sentence):
            async with connected(pool, device(**options)):
                pass


@pytest.mark.anyio
async def test_some_joints_in_any_order() -> None:
    spec = device(2, joints={"j0": 7, "j1": 2})
    async with BusPool() as pool, connected(pool, spec) as made:
        hand(pool).joints[7].angle = 1.0
        await until(lambda: abs(made.control.position[7] - 1.0) < 0.01)
        assert (await patiently(made.sense)).position == pytest.approx([1.0, 0.4], abs=0.01)


@pytest.mark.parametrize(
    ("n", "options", "sentence"),
    [
        (3, {}, "16 actuators"),
        (2, {"joints": {"j0": 1, "j1": 1}}, "two have the same"),
        (2, {"joints": {"j0": 1}}, "missing: j1"),
    ],
)
def test_mistakes_are_told(n: int, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        AllegroDriver(device(n, **options), BusPool())


def test_a_client_that_knows_only_the_sheet_talks_to_the_emulator() -> None:
    """python-can and the sheet's numbers, as the vendor's programs do it."""
    emulated = AllegroEmulator(AllegroProperties(start=0.0))
    with (
        SimulatedCan([emulated], channel="allegro-raw"),
        can.Bus(interface="virtual", channel="allegro-raw") as bus,
    ):

        def wait(wanted: int) -> can.Message:
            end = monotonic.now() + 2.0
            while monotonic.now() < end:
                message = bus.recv(0.1)
                if message is not None and message.arbitration_id == wanted:
                    return message
            raise AssertionError(f"no frame {wanted:#x}")

        def send(number: int, data: bytes = b"", remote: bool = False) -> None:
            bus.send(
                can.Message(
                    arbitration_id=number, data=data, is_extended_id=False, is_remote_frame=remote
                )
            )

        send(0x104)
        send(0x200, remote=True)
        assert wait(0x200).data[1] == 4
        send(0x220, remote=True)
        assert bytes(wait(0x220).data) == b"SAH040AR"
        send(0x204, b"\x03\0\0\0\0\0")
        send(0x100)
        for _ in range(60):
            poses = [wait(0x80 + 4 * finger) for finger in range(4)]
            for finger in range(4):
                send(0x180 + 4 * finger, b"\x3c\x00" + bytes(6))
        assert int.from_bytes(poses[2].data[:2], "little", signed=True) > 500
        assert int.from_bytes(poses[2].data[2:4], "little", signed=True) == 0
