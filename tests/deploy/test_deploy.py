"""`rtee deploy` writes into a system what a hand needs, and takes exactly that away again."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rtee_process import RTEE

from rtee.deploy.check import check_service
from rtee.deploy.files import check_visible, drop_in, hand_files, system_files
from rtee.deploy.install import MANIFEST, FileState, Installation
from rtee.deploy.needs import Needs
from rtee.drivers.diagnosis.checks import Verdict
from rtee.errors import ConfigError
from rtee.running.prepare import RunOptions, prepare

URDF = """<robot name="{name}">
  <link name="palm"/>
  <link name="jaw"><collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
  <joint name="drive" type="revolute">
    <parent link="palm"/><child link="jaw"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="10"/>
  </joint>
</robot>
"""
DEVICE = "devices:\n  gripper:\n    driver: {driver}\n    options: {options}\n"
INSECURE = "security: {insecure: true}"
UNIT = "/etc/systemd/system/rtee@.service"
DROP_IN = "/etc/systemd/system/rtee@jaw.service.d/10-hand.conf"
PROGRAM = "/opt/rtee/bin/rtee"


def write_hand(
    folder: Path,
    name: str = "jaw",
    *,
    driver: str = "robotiq_2f",
    options: str = "{port: /dev/ttyUSB0}",
    more: str = "",
) -> Path:
    hand = folder / "hands" / name
    hand.mkdir(parents=True, exist_ok=True)
    (hand / f"{name}.urdf").write_text(URDF.format(name=name))
    device = DEVICE.format(driver=driver, options=options)
    (hand / "hand.yaml").write_text(f"name: {name}\nurdf: {name}.urdf\n{device}{more}")
    return hand


def needs_of(hand: Path, **serials: str) -> Needs:
    return Needs.of(prepare(str(hand), RunOptions(driver="devices")), serials)


def install(
    root: Path, hand: Path, *, realtime: bool = False, **serials: str
) -> dict[str, FileState]:
    needs = needs_of(hand, **serials)
    installation = Installation(root)
    files = system_files(needs, PROGRAM, realtime=realtime)
    return installation.install(needs.hand, files | hand_files(needs, installation.root))


def tree(root: Path) -> dict[str, tuple[int, bytes]]:
    """Return all files of a system with their permissions and contents."""
    return {
        str(path.relative_to(root)): (
            path.lstat().st_mode,
            os.readlink(path).encode()
            if path.is_symlink()
            else path.read_bytes()
            if path.is_file()
            else b"",
        )
        for path in root.rglob("*")
    }


@pytest.fixture
def root(tmp_path: Path) -> Path:
    system = tmp_path / "system"
    (system / "etc" / "udev" / "rules.d").mkdir(parents=True)
    (system / "etc" / "udev" / "rules.d" / "10-other.rules").write_text("# another's\n")
    (system / "etc" / "passwd").write_text("root:x:0:0:root:/root:/bin/bash\n")
    (system / "etc" / "group").write_text("root:x:0:\ndialout:x:20:\n")
    return system


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    return write_hand(tmp_path)


def test_uninstall_takes_away_exactly_what_install_wrote(root: Path, hand: Path) -> None:
    before = tree(root)
    states = install(root, hand, realtime=True)
    assert set(states.values()) == {FileState.NEW}
    written = tree(root)
    assert f"ExecStart={PROGRAM} run" in (root / UNIT[1:]).read_text()
    link = root / "etc/systemd/system/multi-user.target.wants/rtee@jaw.service"
    assert os.readlink(link) == UNIT
    assert written["etc/rtee/hands/jaw/hand.yaml"][1] == (hand / "hand.yaml").read_bytes()
    modes = {mode & 0o777 for name, (mode, _) in written.items() if name not in before}
    assert modes <= {0o644, 0o755, 0o777}, "others may read and not write"
    removed = Installation(root).uninstall("jaw")
    assert set(removed.values()) == {FileState.REMOVED}
    assert tree(root) == before


def test_installing_again_changes_nothing(root: Path, hand: Path) -> None:
    install(root, hand)
    before = {path: path.lstat().st_mtime_ns for path in root.rglob("*") if path.is_file()}
    del before[root / MANIFEST[1:]]
    assert set(install(root, hand).values()) == {FileState.SAME}
    assert {path: path.lstat().st_mtime_ns for path in before} == before


def test_a_hand_that_was_changed_is_brought_up_to_date(root: Path, tmp_path: Path) -> None:
    can = {"driver": "cia402", "options": "{channel: can1, bitrate: 500000}"}
    hand = write_hand(tmp_path, **can)
    rule = "/etc/udev/rules.d/90-rtee-jaw.rules"
    install(root, hand)
    assert "ip link set can1 up type can bitrate 500000" in (root / rule[1:]).read_text()
    write_hand(tmp_path)
    states = install(root, hand)
    assert states["/etc/rtee/hands/jaw/hand.yaml"] is FileState.CHANGED
    assert states[rule] is FileState.REMOVED
    assert not (root / rule[1:]).exists()


def test_on_a_full_disk_nothing_is_installed_and_later_everything(
    root: Path, hand: Path, largest_file: Callable[[int | None], None]
) -> None:
    settings = hand / "hand.yaml"
    small = settings.read_text()
    before = tree(root)
    for installed in (False, True):
        settings.write_text(f"{small}# {'x' * 20_000}\n")
        largest_file(10_000)
        with pytest.raises(ConfigError, match=r"hand\.yaml: cannot be written: file too large"):
            install(root, hand)
        largest_file(None)
        assert tree(root) == before
        if not installed:
            settings.write_text(small)
            install(root, hand)
            before = tree(root)
    # What was not written does not count as changed by hand.
    assert install(root, hand)["/etc/rtee/hands/jaw/hand.yaml"] is FileState.CHANGED


class Killed(BaseException):
    """The end of the process: nothing that happens afterwards is part of the installation."""


def killed_install(root: Path, hand: Path, renames: int, patch: pytest.MonkeyPatch) -> bool:
    """Install a hand, but end after some renamed files; return whether it ended so."""
    replace_, left = os.replace, renames

    def counting(old: str, new: Path) -> None:
        nonlocal left
        if left == 0:
            raise Killed
        left -= 1
        replace_(old, new)

    with patch.context() as patched:
        patched.setattr(os, "replace", counting)
        try:
            install(root, hand, realtime=True)
        except Killed:
            return True
    return False


@pytest.mark.parametrize("then", ["the same", "another", "edited", "removed", "other hand"])
def test_a_killed_installation_is_finished_by_the_next(
    root: Path, hand: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, then: str
) -> None:
    path = "/etc/rtee/hands/jaw/hand.yaml"
    copy, settings, first = root / path[1:], hand / "hand.yaml", (hand / "hand.yaml").read_text()
    before, renames, killed = tree(root), 0, True
    while killed:
        settings.write_text(first)
        install(root, hand)
        write_hand(tmp_path, options="{port: /dev/ttyUSB1}", more=f"title: Jaw {renames}\n")
        killed = killed_install(root, hand, renames, monkeypatch)
        assert copy.read_text() in (first, settings.read_text())
        if then == "another":
            settings.write_text(f"{first}title: Other\n")
        if then == "edited":
            copy.write_text("# mine\n")
        if then == "other hand":
            other = tmp_path / "other"
            other.mkdir(exist_ok=True)
            install(root, write_hand(other, name="claw"))
            Installation(root).uninstall("claw")
        if then != "removed":
            states = install(root, hand, realtime=True)
            kept = [each for each, state in states.items() if state is FileState.KEPT]
            assert kept == ([path] if then == "edited" else [])
            assert then == "edited" or copy.read_text() == settings.read_text()
            assert set(install(root, hand, realtime=True).values()) <= {
                FileState.SAME,
                FileState.KEPT,
            }
        assert (FileState.KEPT in Installation(root).uninstall("jaw").values()) is (
            then == "edited"
        )
        if then == "edited":
            shutil.rmtree(root / "etc/rtee")
        assert tree(root) == before
        renames += 1
    assert renames > 3, "the list, and files that changed"


def test_what_was_installed_before_belongs_to_whoever_puts_it_back(root: Path, hand: Path) -> None:
    copy = root / "etc/rtee/hands/jaw/hand.yaml"
    for title in ("old", "new"):
        write_hand(hand.parents[1], more=f"title: {title}\n")
        install(root, hand)
        if title == "old":
            old = copy.read_text()
    copy.write_text(old)
    write_hand(hand.parents[1], more="title: newest\n")
    assert install(root, hand)["/etc/rtee/hands/jaw/hand.yaml"] is FileState.KEPT


def test_hands_share_files_until_the_last_one_goes(root: Path, tmp_path: Path) -> None:
    before = tree(root)
    for name in ("left", "right"):
        install(root, write_hand(tmp_path, name), gripper=f"FT{name}")
    assert UNIT not in Installation(root).uninstall("left")
    assert (root / UNIT[1:]).exists()
    assert not (root / "etc/udev/rules.d/90-rtee-left.rules").exists()
    assert "FTright" in (root / "etc/udev/rules.d/90-rtee-right.rules").read_text()
    assert UNIT in Installation(root).uninstall("right")
    assert tree(root) == before


def test_what_was_changed_by_hand_stays(root: Path, hand: Path) -> None:
    install(root, hand)
    copy = root / "etc/rtee/hands/jaw/hand.yaml"
    copy.write_text("# mine\n")
    (hand / "hand.yaml").write_text((hand / "hand.yaml").read_text() + "title: Jaw\n")
    assert install(root, hand)["/etc/rtee/hands/jaw/hand.yaml"] is FileState.KEPT
    assert Installation(root).uninstall("jaw")["/etc/rtee/hands/jaw/hand.yaml"] is FileState.KEPT
    assert copy.read_text() == "# mine\n"
    assert not (root / UNIT[1:]).exists()


@pytest.mark.parametrize(
    "path", [UNIT, "/etc/systemd/system/multi-user.target.wants/rtee@jaw.service"]
)
def test_the_files_of_others_are_not_touched(root: Path, hand: Path, path: str) -> None:
    place = root / path[1:]
    place.parent.mkdir(parents=True)
    place.write_text("# somebody's\n")
    before = tree(root)
    with pytest.raises(ConfigError, match="exists already and is not from `rtee deploy`"):
        install(root, hand)
    assert tree(root) == before


@pytest.mark.parametrize("folder", ["etc/udev/rules.d", "etc/systemd", "etc/rtee"])
def test_links_out_of_an_image_are_refused(
    root: Path, hand: Path, tmp_path: Path, folder: str
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    shutil.rmtree(root / folder, ignore_errors=True)
    (root / folder).symlink_to(outside)
    with pytest.raises(ConfigError, match="is a link that leads out of the system"):
        install(root, hand)
    assert list(outside.iterdir()) == []


def test_a_damaged_manifest_removes_nothing(root: Path, hand: Path) -> None:
    install(root, hand)
    manifest = root / MANIFEST[1:]
    manifest.write_bytes(manifest.read_bytes()[:-20])
    before = tree(root)
    with pytest.raises(ConfigError, match=r"cannot be used: .*; nothing was changed"):
        Installation(root).uninstall("jaw")
    assert tree(root) == before


def test_links_among_the_files_of_a_hand_are_not_followed(
    root: Path, hand: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (hand / "notes.txt").symlink_to(secret)
    (hand / ".hidden").write_text("")
    install(root, hand)
    assert sorted(path.name for path in (root / "etc/rtee/hands/jaw").iterdir()) == [
        "hand.yaml",
        "jaw.urdf",
    ]


@pytest.mark.parametrize("what", ["a file", "a folder"])
def test_what_becomes_a_link_meanwhile_is_not_followed(
    root: Path, hand: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Between the check and the reading, a file that only root may read took its place."""
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "notes.txt").write_text("secret")
    (hand / "more").mkdir()
    (hand / "more" / "notes.txt").write_text("mine")
    opened = os.open

    def swap(path: Any, flags: int, *args: Any, **more: Any) -> int:
        target = {"a file": "notes.txt", "a folder": "more"}[what]
        if Path(str(path)).name == target and not (hand / "kept").exists():
            place = hand / "more" if what == "a folder" else hand / "more" / "notes.txt"
            place.rename(hand / "kept")
            place.symlink_to(secret if what == "a folder" else secret / "notes.txt")
        return opened(path, flags, *args, **more)

    monkeypatch.setattr(os, "open", swap)
    install(root, hand)
    monkeypatch.undo()
    assert (hand / "kept").exists()
    copied = root / "etc/rtee/hands/jaw"
    assert "secret" not in [p.read_text() for p in copied.rglob("*") if p.is_file()]


@pytest.mark.skipif(os.getuid() != 0, reason="only root makes files of other users")
def test_files_of_others_are_not_copied(root: Path, hand: Path) -> None:
    """A hard link leads to a file as a symbolic one does."""
    (hand / "notes.txt").write_text("secret")
    os.chown(hand / "notes.txt", 12345, -1)
    with pytest.raises(ConfigError, match="must have the same owner as its folder"):
        install(root, hand)
    assert not (root / "etc/rtee/hands/jaw").exists()


@pytest.mark.parametrize(
    ("options", "serials", "reason"),
    [
        (r'{port: "/dev/ttyUSB0\", RUN+=\"/bin/sh"}', {}, "port of 'gripper' must be an absolute"),
        (r'{port: "/dev/a\nDeviceAllow=/dev/sda"}', {}, "port of 'gripper' must be an absolute"),
        ("{port: /dev/../etc/passwd}", {}, "port of 'gripper' must be an absolute"),
        ("{port: /dev/ttyUSB0}", {"gripper": 'X", RUN+="/bin/sh'}, "serial number of 'gripper'"),
        ("{port: /dev/ttyUSB0}", {"griper": "X"}, "not a device with a serial port; .*: gripper"),
        ('{port: "socket://[fe80::1:4001"}', {}, r"'socket://\[fe80::1:4001' is not an address"),
    ],
)
def test_no_value_gets_out_of_its_place_in_a_file(
    tmp_path: Path, options: str, serials: dict[str, str], reason: str
) -> None:
    hand = write_hand(tmp_path, options=options)
    with pytest.raises(ConfigError, match=reason):
        needs_of(hand, **serials)


def text_for(hand: Path, path: str) -> str:
    return system_files(needs_of(hand), PROGRAM, realtime=True)[path].decode()


def test_a_port_with_a_name_of_its_own_gets_it(tmp_path: Path) -> None:
    hand = write_hand(tmp_path, options="{port: /dev/gripper_left}")
    files = system_files(needs_of(hand, gripper="FT4ABC"), PROGRAM, realtime=False)
    rule = files["/etc/udev/rules.d/90-rtee-jaw.rules"].decode()
    assert 'ENV{ID_SERIAL_SHORT}=="FT4ABC", SYMLINK+="gripper_left"' in rule


@pytest.mark.parametrize(
    ("options", "more", "lines"),
    [
        ("{port: /dev/ttyUSB0}", "", []),
        ("{port: /dev/ttyTHS1}", "", ["DeviceAllow=char-ttyTHS rw"]),
        ("{port: 'socket://192.168.1.7:7000'}", "", ["IPAddressAllow=192.168.1.7"]),
        ("{port: 'socket://localhost:7000'}", "", []),
        ("{port: 'socket://gateway:7000'}", "", ["IPAddressAllow=any"]),
        ("{}", "remote: {listen: ['tcp/127.0.0.1:7447']}\n", []),
        ("{}", f"remote: {{listen: ['tcp/0.0.0.0:7447'], {INSECURE}}}\n", ["IPAddressAllow=any"]),
        (
            "{}",
            "remote: {listen: ['tls/192.168.1.10:7447']}\n",
            ["IPAddressAllow=any", "Environment=RTEE_SECURE_DIR=/var/lib/rtee/secure"],
        ),
        (
            "{}",
            "remote: {listen: ['tls/0.0.0.0:7447'], security: {folder: /etc/keys/jaw}}\n",
            ["IPAddressAllow=any"],
        ),
        (
            "{}",
            "remote: {listen: ['tls/127.0.0.1:7447']}\n",
            ["Environment=RTEE_SECURE_DIR=/var/lib/rtee/secure"],
        ),
        ("{}", "log: {directory: /data/logs}\n", ["ReadWritePaths=-/data/logs"]),
    ],
)
def test_the_unit_is_opened_as_far_as_the_hand_needs(
    tmp_path: Path, options: str, more: str, lines: list[str]
) -> None:
    hand = write_hand(tmp_path, options=options, more=more)
    [text] = drop_in(needs_of(hand)).values() or [b"\n\n"]
    assert text.decode().splitlines()[2:] == lines


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ("{listen: ['tcp/0.0.0.0:7447']}", "could move the hand"),
        (
            "{listen: ['tls/0.0.0.0:7447'], security: {folder: /home/ann/keys}}",
            "cannot see /home/ann/keys",
        ),
        (
            "{listen: ['tls/0.0.0.0:7447'], security: {folder: keys}}",
            "folder must be an absolute path",
        ),
    ],
)
def test_a_network_with_which_the_service_could_not_run_is_refused(
    tmp_path: Path, more: str, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        needs_of(write_hand(tmp_path, more=f"remote: {more}\n"))


def test_a_driver_of_others_is_not_imported(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "foreign.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    options = "{port: /dev/ttyTHS1}"
    hand = write_hand(tmp_path, driver="foreign:Gripper", options=options)
    needs = needs_of(hand)
    assert [port.path for port in needs.ports] == ["/dev/ttyTHS1"]
    done = rtee("install", hand, "--root", root, "--program", PROGRAM, path=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "the drivers of gripper are not part of rtee" in done.stdout
    assert "DeviceAllow=char-ttyTHS rw" in text_for(hand, DROP_IN)
    assert not (tmp_path / "ran").exists()


def test_ethercat_gets_raw_frames(tmp_path: Path) -> None:
    hand = write_hand(tmp_path, driver="heri_ethercat", options="{interface: eth1}")
    pytest.importorskip("pysoem")
    [text] = drop_in(needs_of(hand)).values()
    assert b"RestrictAddressFamilies=AF_PACKET\nCapabilityBoundingSet=CAP_NET_RAW\n" in text


def test_the_kernel_leaves_cpus_to_the_loop(tmp_path: Path) -> None:
    hand = write_hand(tmp_path, more="realtime: {cpus: [2, 3]}\n")
    text = text_for(hand, "/etc/default/grub.d/rtee.cfg")
    assert "isolcpus=2,3 nohz_full=2,3 rcu_nocbs=2,3" in text


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_systemd_understands_what_is_added_to_the_unit(tmp_path: Path) -> None:
    pytest.importorskip("pysoem")
    more = "remote: {listen: ['tls/0.0.0.0:7447']}\nlog: {directory: /data/logs}\n"
    hand = write_hand(tmp_path, driver="heri_ethercat", options="{interface: eth1}", more=more)
    files = system_files(needs_of(hand), "/bin/true", realtime=False)
    units = tmp_path / "units"
    for path, content in files.items():
        if path.startswith("/etc/systemd/system/"):
            place = units / Path(path).relative_to("/etc/systemd/system")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
    done = subprocess.run(
        ["systemd-analyze", "verify", "rtee@jaw.service"],
        env=os.environ | {"SYSTEMD_UNIT_PATH": f"{units}:"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert "AF_PACKET" in (units / "rtee@jaw.service.d/10-hand.conf").read_text()


# --- the doctor ----------------------------------------------------------------------------------


def verdicts(root: Path, hand: Path) -> dict[str, tuple[Verdict, str]]:
    found = check_service(needs_of(hand), root)
    return {check.subject: (check.verdict, check.remedy) for check in found}


def test_the_doctor_looks_at_every_part(root: Path, tmp_path: Path) -> None:
    hand = write_hand(tmp_path, more="realtime: {cpus: [1]}\nlog: {max_total_size: 1e18}\n")
    assert verdicts(root, hand) == {"service": (Verdict.OK, "")}
    install(root, hand)
    again = "sudo rtee deploy install jaw"
    found = verdicts(root, hand)
    assert found["service"] == (Verdict.OK, "")
    assert found["service's user"] == (Verdict.WRONG, again)
    assert f"{again} --serial gripper=NUMBER" in found["name of /dev/ttyUSB0"][1]
    assert found["recordings"] == (
        Verdict.WARNING,
        "set log: {max_total_size: BYTES} in hand.yaml",
    )
    assert found["CPUs of the loop"][0] is Verdict.WARNING
    isolated = root / "sys/devices/system/cpu/isolated"
    isolated.parent.mkdir(parents=True)
    isolated.write_text("0-1\n")
    assert verdicts(root, hand)["CPUs of the loop"][0] is Verdict.OK
    (hand / "hand.yaml").write_text((hand / "hand.yaml").read_text() + "title: Jaw\n")
    assert verdicts(root, hand)["service"] == (Verdict.WARNING, again)
    (root / "etc/security/limits.d/rtee.conf").write_text("# mine\n")
    assert again in verdicts(root, hand)["service"][1]
    (root / UNIT[1:]).unlink()
    assert verdicts(root, hand)["service"] == (Verdict.WRONG, again)
    (root / MANIFEST[1:]).write_text("{")
    assert verdicts(root, hand)["service"][0] is Verdict.WRONG


def test_the_doctor_tells_of_a_killed_installation(
    root: Path, hand: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(root, hand)
    write_hand(hand.parents[1], more="title: Jaw\n")
    assert killed_install(root, hand, 1, monkeypatch)
    (told,) = [c for c in check_service(needs_of(hand), root) if c.subject == "service"]
    assert (told.verdict, told.text) == (Verdict.WRONG, "its installation was interrupted")
    install(root, hand)
    assert verdicts(root, hand)["service"] == (Verdict.OK, "")


@pytest.mark.skipif(os.geteuid() != 0, reason="files are given to others by root")
def test_the_doctor_looks_for_the_certificates(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="needs the extra secure")
    from rtee.remote.authority import make_authority

    hand = write_hand(tmp_path, more="remote: {listen: ['tls/0.0.0.0:7447']}\n")
    install(root, hand)
    what = "service's certificates"
    verdict, remedy = verdicts(root, hand)[what]
    assert verdict is Verdict.WRONG
    assert "sudo -u rtee env RTEE_SECURE_DIR=/var/lib/rtee/secure " in remedy
    folder = root / "var/lib/rtee/secure/jaw"
    make_authority(folder, "jaw")
    assert verdicts(root, hand)[what] == (Verdict.WRONG, f"sudo chown -R rtee: {folder}")
    with (root / "etc/passwd").open("a") as file:
        file.write("rtee:x:4711:4711::/var/lib/rtee:/usr/sbin/nologin\n")
    os.chown(folder / "hand.key", 4711, 4711)
    assert verdicts(root, hand)[what] == (Verdict.OK, "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become somebody else")
def test_the_doctor_says_that_certificates_are_not_to_be_looked_at() -> None:
    pytest.importorskip("cryptography", reason="needs the extra secure")
    from rtee.cli.secure import checks
    from rtee.remote.authority import make_authority

    # Folders of pytest are root's alone.
    with tempfile.TemporaryDirectory(prefix="rtee-", dir="/tmp") as place:
        folder = Path(place)
        hand = write_hand(folder, more="remote: {listen: ['tls/0.0.0.0:7447']}\n")
        folder.chmod(0o755)
        secure = folder / "secure" / "jaw"
        make_authority(secure, "jaw")
        secure.parent.chmod(0o700)
        service = replace(needs_of(hand), certificates=secure)
        (own,) = checks(str(hand), service)
        assert (own.verdict, own.text[:5]) == (Verdict.OK, "until")
        os.seteuid(pwd.getpwnam("nobody").pw_uid)
        try:
            (hidden,) = checks(str(hand), service)
        finally:
            os.seteuid(0)
        assert hidden.verdict is Verdict.WARNING
        assert hidden.text == f"in {secure}, which is not yours to read"
        assert hidden.remedy == f"sudo rtee doctor {hand}"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become somebody else")
@pytest.mark.parametrize("closed", ["var/lib/rtee", "var/lib/rtee/logs"])
def test_the_doctor_says_that_recordings_are_not_to_be_looked_at(closed: str) -> None:
    # Folders of pytest are root's alone.
    with tempfile.TemporaryDirectory(prefix="rtee-", dir="/tmp") as place:
        folder = Path(place)
        # Of 1 byte: the disk's own room is not what is tested.
        needs = replace(needs_of(write_hand(folder)), log_size=1.0)
        install(folder, needs.folder)
        (folder / "var/lib/rtee/logs").mkdir(parents=True)
        folder.chmod(0o755)
        (folder / closed).chmod(0o700)
        os.seteuid(pwd.getpwnam("nobody").pw_uid)
        try:
            found = {check.subject: check for check in check_service(needs, folder)}
        finally:
            os.seteuid(0)
        assert found["recordings"].verdict is Verdict.WARNING
        assert "cannot be read: permission denied" in found["recordings"].text
        assert found["recordings"].remedy == "sudo rtee doctor jaw"
        # Whoever may look is told.
        seen = {check.subject: check.verdict for check in check_service(needs, folder)}
        assert seen["recordings"] is Verdict.OK


def test_the_certificates_of_a_service_are_made_by_its_user(tmp_path: Path) -> None:
    from rtee.cli.secure import checks

    hand = write_hand(tmp_path, more="remote: {listen: ['tls/0.0.0.0:7447']}\n")
    (missing,) = checks(str(hand), needs_of(hand))
    assert missing.verdict is Verdict.WRONG
    assert "/var/lib/rtee/secure/jaw" in missing.text
    assert missing.remedy.startswith("sudo -u rtee env RTEE_SECURE_DIR=/var/lib/rtee/secure ")
    assert missing.remedy.endswith(" secure init jaw")


# --- the command ---------------------------------------------------------------------------------


def rtee(*words: str | Path, path: str = "") -> subprocess.CompletedProcess[str]:
    repository = str(Path(__file__).parents[2])
    return subprocess.run(
        [*RTEE, "deploy", *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (repository, path)))},
        capture_output=True,
        text=True,
    )


def test_plan_and_dry_run_print_and_write_nothing(root: Path, hand: Path) -> None:
    before = tree(root)
    planned = rtee("plan", hand, "--root", root, "--program", PROGRAM, "--serial", "gripper=FT4ABC")
    assert planned.returncode == 0, planned.stderr
    assert "Type=notify" in planned.stdout
    assert 'SYMLINK+="rtee/jaw-gripper"' in planned.stdout
    assert "- in hand.yaml, at 'gripper': port: /dev/rtee/jaw-gripper" in planned.stdout
    dry = rtee("install", hand, "--root", root, "--program", PROGRAM, "--dry-run")
    assert f"new: {root / UNIT[1:]}" in dry.stdout
    assert tree(root) == before


@pytest.mark.heavy
@pytest.mark.skipif(os.geteuid() != 0, reason="accounts are made by root")
@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="no systemd-sysusers here")
def test_the_command_makes_the_user_and_takes_it_away(root: Path, hand: Path) -> None:
    accounts = [root / "etc/passwd", root / "etc/group"]
    before = [path.read_text() for path in accounts]
    done = rtee("install", hand, "--root", root, "--program", PROGRAM)
    assert done.returncode == 0, done.stderr
    assert "rtee:x:" in accounts[0].read_text()
    assert "dialout:x:20:rtee" in accounts[1].read_text()
    assert rtee("install", hand, "--root", root, "--program", PROGRAM).stdout.count("new: ") == 0
    done = rtee("uninstall", "jaw", "--root", root)
    assert (done.returncode, "!" in done.stdout) == (0, False), done.stdout
    assert [path.read_text() for path in accounts] == before
    again = rtee("uninstall", "jaw", "--root", root)
    assert again.returncode == 2
    assert "was not installed by `rtee deploy`; installed are: none" in again.stderr


@pytest.mark.samples("/etc/passwd", "../jaw")
@pytest.mark.parametrize("name", ["../jaw", "/etc/passwd", "", "jaw\n"])
def test_a_name_is_no_path(root: Path, hand: Path, name: str) -> None:
    install(root, hand)
    before = tree(root)
    assert rtee("uninstall", name, "--root", root).returncode == 2
    assert tree(root) == before


@pytest.mark.parametrize(
    ("program", "hidden", "setting"),
    [
        ("/home/ann/venv/bin/rtee", "/home/ann/venv/bin/rtee", "ProtectHome"),
        ("/tmp/venv/bin/rtee", "/tmp/venv/bin/rtee", "PrivateTmp"),
        ("link", "/root/venv/rtee", "ProtectHome"),
    ],
)
def test_a_program_that_the_sandbox_hides_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, hidden: str, setting: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("/root/venv/rtee")
    with pytest.raises(ConfigError, match=f"would not see {hidden}: its unit has {setting}"):
        check_visible(program, live=True)
    check_visible("/opt/rtee/bin/rtee", live=False)
