"""Wrong input: one sentence that says what and where, exit status 2, and nothing is written."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hand.models import GRIPPER, SRDF, YAML, line_of
from rtee_process import PYTHON, RTEE

from rtee.cli.main import main

COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")

BOX = '<box size="0.1 0.1 0.02"/>'
LEFT = '<joint name="left" type="revolute">'
LIMIT = '<limit lower="0" upper="0.8" velocity="2" effort="5"/>\n  </joint>\n  <joint name="right"'
CHAIN = '<chain base_link="palm" tip_link="left_jaw"/>'

LOOP = GRIPPER.replace(LIMIT, f'<mimic joint="right"/>{LIMIT}').replace(
    '<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0"/><mimic joint="left"/>'
)
ENTITIES = """<?xml version="1.0"?>
<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>
<robot name="&b;"/>
"""

HAND = YAML.replace("rest: {left: 0.1}", "rest: {right: 0.1}")

Change = tuple[str, str]


def mimic(attributes: str) -> Change:
    return LIMIT, f"<mimic {attributes}/>{LIMIT}"


# File, what is changed in it, what is said, and what stands in the line that is named.
FILES: dict[str, tuple[str, Change | str, str, str | None]] = {
    "not XML": ("gripper.urdf", "no XML", "URDF is not XML", None),
    "cut off": ("gripper.urdf", ("</robot>", ""), "URDF is not XML", None),
    "entities": ("gripper.urdf", ENTITIES, "document type", "<!DOCTYPE"),
    "entities in the SRDF": ("gripper.srdf", ENTITIES, "document type", "<!DOCTYPE"),
    "no such link in a chain": (
        "gripper.srdf",
        (CHAIN, '<chain base_link="palm" tip_link="jaw"/>'),
        "unknown link 'jaw'",
        'tip_link="jaw"',
    ),
    "tip not below its base": (
        "gripper.srdf",
        (CHAIN, '<chain base_link="right_jaw" tip_link="left_jaw"/>'),
        "is not below its base",
        '"right_jaw" tip_link="left_jaw"',
    ),
    "empty limits": (
        "gripper.urdf",
        (LIMIT, LIMIT.replace('upper="0.8"', 'upper="0"')),
        "empty limits",
        LEFT,
    ),
    "reversed limits": (
        "gripper.urdf",
        (LIMIT, LIMIT.replace('upper="0.8"', 'upper="-1"')),
        "lower limit 0 above its upper limit -1",
        'upper="-1"',
    ),
    "mimic of a missing joint": (
        "gripper.urdf",
        mimic('joint="gone"'),
        "'gone'",
        'joint="gone"',
    ),
    "mimic loop": ("gripper.urdf", LOOP, "loop", None),
    "missing mesh": (
        "gripper.urdf",
        (BOX, '<mesh filename="gone.stl"/>'),
        "mesh 'gone.stl' does not exist",
        "gone.stl",
    ),
    "mesh of an unknown package": (
        "gripper.urdf",
        (BOX, '<mesh filename="package://gone/a.stl"/>'),
        "mesh 'package://gone/a.stl' does not exist",
        "gone/a.stl",
    ),
    "unreadable mesh": (
        "gripper.urdf",
        (BOX, '<mesh filename="gripper.stl"/>'),
        "gripper.stl",
        "gripper.stl",
    ),
    "duplicate link": (
        "gripper.urdf",
        ('name="left_jaw"', 'name="palm"'),
        "link 'palm' is defined twice",
        None,
    ),
    "duplicate joint": (
        "gripper.urdf",
        (LEFT, LEFT.replace("left", "right")),
        "joint 'right' is defined twice",
        None,
    ),
    "duplicate finger": (
        "gripper.srdf",
        ('<group name="left_finger">', '<group name="right_finger">'),
        "group 'right_finger' is defined twice",
        None,
    ),
    "nlFunPos outside the grammar": (
        "gripper.urdf",
        mimic('joint="right" nlFunPos="__import__(x)"'),
        "nlFunPos",
        "__import__",
    ),
    "nlFunPos without a value": (
        "gripper.urdf",
        mimic('joint="right" nlFunPos="1/(x-0.4)"'),
        "nlFunPos",
        "1/(x-0.4)",
    ),
    "finger named like a path": (
        "gripper.srdf",
        SRDF.replace("left_finger", "../left"),
        "'../left'",
        CHAIN,
    ),
    "tab": ("hand.yaml", ("rest: {right: 0.1}", "rest:\n\tright: 0.1"), "a tab", "\tright"),
    "unknown key": ("hand.yaml", ("title:", "tilte:"), "unknown key", "tilte:"),
    "NaN": ("hand.yaml", ("{right: 0.1}", "{right: .nan}"), "not a finite number", ".nan"),
    "unknown actuator": ("hand.yaml", ("{right: 0.1}", "{thumb: 0}"), "unknown actuator", "thumb"),
    "name with a slash": ("hand.yaml", ("name: gripper", "name: a/b"), "'a/b'", "a/b"),
    "name with dots": ("hand.yaml", ("name: gripper", "name: ../b"), "'../b'", "../b"),
    "missing URDF": ("hand.yaml", ("urdf: gripper.urdf", "urdf: no.urdf"), "no.urdf", "no.urdf"),
}

Run = Callable[..., str]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which there is a gripper."""
    folder = tmp_path / "config" / "gripper"
    folder.mkdir(parents=True)
    for name, text in (("gripper.urdf", GRIPPER), ("gripper.srdf", SRDF), ("hand.yaml", HAND)):
        (folder / name).write_text(text)
    (folder / "gripper.stl").write_text("solid but not really\n")
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.fixture
def refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Run a command that is to be refused; return what it says."""

    def run(*arguments: object) -> str:
        before = snapshot(tmp_path)
        monkeypatch.setattr(sys, "argv", ["rtee", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        said = capsys.readouterr()
        assert left.value.code == 2, said
        assert said.out == ""
        assert said.err.startswith("rtee: ")
        assert said.err.count("\n") == 1
        assert snapshot(tmp_path) == before
        return said.err

    return run


def snapshot(folder: Path) -> dict[str, bytes | None]:
    return {str(p): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.mark.parametrize("case", FILES)
def test_files(case: str, home: Path, refused: Run) -> None:
    name, change, message, place = FILES[case]
    path = home / name
    text = path.read_text()
    if isinstance(change, tuple):
        assert text.count(change[0]) == 1
        text = text.replace(*change)
    else:
        text = change
    path.write_text(text)
    urdf, srdf = home / "gripper.urdf", home / "gripper.srdf"
    commands: list[list[object]] = [["extract", "gripper", "--save", "--report", "page.html"]]
    if name != "hand.yaml":
        of_files = ["--urdf", urdf, "--srdf", srdf]
        commands += [["extract", *of_files, "--out", "out"], ["new", "other", *of_files]]
    for command in commands:
        said = refused(*command)
        assert message in said
        where = f"{path}:{line_of(text, place)}: " if place else str(path)
        assert where in said or where.replace(str(home), "config/gripper") in said


@pytest.mark.parametrize("option", ["--urdf", "--srdf"])
def test_a_file_that_is_missing(option: str, home: Path, refused: Run) -> None:
    files = {"--urdf": home / "gripper.urdf", "--srdf": home / "gripper.srdf", option: "none.xml"}
    words = [word for pair in files.items() for word in pair]
    for command in (["extract", *words, "--out", "out"], ["new", "other", *words]):
        assert f"none.xml: {option[2:].upper()} does not exist" in refused(*command)


@pytest.mark.parametrize("name", ["../gripper", "a/b", "..", ".hidden", "a b", "x" * 200])
def test_names_that_would_be_paths(name: str, home: Path, refused: Run) -> None:
    assert "hand name" in refused("new", name, "--urdf", home / "gripper.urdf")
    assert "name" in refused("generic", name, "left=0.2", "--hand", "gripper")


@pytest.mark.parametrize("name", ["other.urdf", "other.xml", "other.yaml", "other."])
def test_a_hand_that_no_command_could_name(name: str, home: Path, refused: Run) -> None:
    for source in (("--urdf", str(home / "gripper.urdf")), ("--from", "gripper")):
        assert f"hand name '{name}' would be taken for a file" in refused("new", name, *source)


@pytest.mark.parametrize(
    "command",
    ["compose fist", "extract --nope", "nope", "do", "log nope", "hands one", "import no"],
)
def test_words_of_a_command(command: str, refused: Run) -> None:
    assert "; see 'rtee" in refused(*command.split())


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("runn", "no such command 'runn' (did you mean 'run'?); see 'rtee --help'"),
        ("Run", "no such command 'Run' (did you mean 'run'?); see 'rtee --help'"),
        ("log infoo", "no such command 'infoo' (did you mean 'info'?); see 'rtee log --help'"),
        ("xyzzy", "no such command 'xyzzy'; see 'rtee --help'"),
    ],
)
def test_a_command_that_is_misspelt(command: str, message: str, refused: Run) -> None:
    assert refused(*command.split()) == f"rtee: {message}\n"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("run gripper --duration nan", "'--duration': should be a finite number"),
        ("run gripper --duration inf", "'--duration': should be a finite number"),
        ("run gripper --driver mujoco --gravity -101", "'--gravity': -101.0 is not in the range"),
        ("run gripper --rate nan", "'--rate': should be a finite number"),
        ("try gripper Trig --object sphere:0.03 --mass nan", "'--mass': should be a finite"),
        ("log replay none --speed nan", "'--speed': should be a finite number"),
        ("run gripper --driver=", "--driver is empty"),
        ("gui --host 999.999.999.999", "--host 999.999.999.999 is not an IP address"),
        ("gui --port abc", "'abc' is not a whole number; see"),
        ("gui --host=", "--host is empty"),
        ("gui --host nowhere.invalid", "cannot find an address for this name"),
        ("gui --host 192.0.2.1 --behind-proxy https://hand", "cannot listen there"),
        ("gui --host 0.0.0.0", "encrypt it with --tls-cert and --tls-key"),
        ("gui --behind-proxy http://hand", "is not an origin"),
        ("gui --behind-proxy https://hand/page", "is not an origin"),
        ("gui --tls-cert none.pem", "--tls-cert and --tls-key go together"),
        ("gui --tls-cert none.pem --tls-key none.pem", "none.pem: cannot be read"),
        ("gui --tls-cert {urdf} --tls-key {urdf}", "both must be PEM files"),
        ("gui --endpoint foo", "'foo' is not an endpoint"),
    ],
)
def test_options_that_cannot_be(command: str, message: str, home: Path, refused: Run) -> None:
    words = command.format(urdf=home / "gripper.urdf").split()
    assert message in refused(*words)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("typo=1",), "--option typo: device 'gripper': unknown option 'typo'; valid: "),
        (
            ("baudrate=x",),
            "--option baudrate: device 'gripper': option 'baudrate': input should be",
        ),
        (("open_count=50", "closed_count=50"), "--option closed_count: device 'gripper': "),
    ],
)
def test_an_option_of_the_command_line_is_not_looked_for_in_the_file(
    words: tuple[str, ...], told: str, repository: Path, refused: Run
) -> None:
    hand = str(repository / "config" / "robotiq_2f_85")
    given = [word for each in words for word in ("--option", each)]
    assert refused("run", hand, "--driver", "devices", *given).startswith(f"rtee: {told}")


def test_a_line_that_is_no_line(home: Path, repository: Path) -> None:
    hand = str(repository / "config" / "robotiq_2f_85")
    command = ("run", hand, "--no-log", "--driver", "devices", "--option", "port=http://x")
    done = subprocess.run([*RTEE, *command], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith("rtee: 'http://x' is not the address of a")


def test_too_few_files(home: Path) -> None:
    command = shlex.join((*COMMAND, "run", "gripper", "--no-log", "--duration", "1"))
    shell = ("/bin/bash", "-c", f"ulimit -n 12 && {command}")
    done = subprocess.run(shell, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("rtee: only 12 files may be open at once")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("text", "status"), [("can't start new thread", 2), ("a bug", 1)])
def test_no_memory_for_a_thread(text: str, status: int) -> None:
    """Under a limit of memory, Python reports it by a RuntimeError, wherever a thread starts."""
    code = (
        "import importlib\n"
        "main = importlib.import_module('rtee.cli.main')\n"
        f"def fail(**_): raise RuntimeError({text!r})\n"
        "main.cli = fail\n"
        "main.main()\n"
    )
    done = subprocess.run([*PYTHON, "-c", code], capture_output=True, text=True)
    assert done.returncode == status
    assert ("there is not enough memory; 'ulimit -v'" in done.stderr) is (status == 2)
    assert ("Traceback" in done.stderr) is (status == 1)


def test_a_number_that_never_ends(home: Path, refused: Run) -> None:
    file = home / "hand.yaml"
    for digits in ("0x" + "f" * 5000, "9" * 4000, "9" * 5000):
        file.write_text(f"{YAML}rate: {digits}\n")
        said = refused("actions", "gripper")
        assert "is not a number of at most 64 bits" in said
        assert len(said) < 300


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("compose fist trig:left_finger*-1", "scale"),
        ("compose fist trig:left_finger*nan", "scale"),
        ("compose fist trig:thumb", "thumb"),
        ("compose fist fist", "fist"),
        ("compose fist", "PART"),
        ("time wave trig:left_finger:before=-1", "before"),
        ("time wave trig:left_finger:befor=1", "befor"),
        ("time wave trig:left_finger trig:left_finger", "alias"),
        ("generic point left=9", "left"),
        ("generic point left=nan", "left"),
        ("generic point thumb=1", "thumb"),
        ("generic point left", "left"),
        ("generic Trig left=0.2", "Trig"),
        ("import nowhere", "nowhere"),
    ],
)
def test_actions(
    command: str,
    message: str,
    home: Path,
    refused: Run,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["rtee", "extract", "gripper", "--save"])
    with pytest.raises(SystemExit):
        main()
    assert (home / "actions" / "primitives" / "Trig.yaml").is_file()
    capsys.readouterr()
    assert message in refused(*command.split(), "--hand", "gripper")


@pytest.mark.parametrize("as_json", [[], ["--json"]])
def test_a_finger_without_geometry_is_a_warning(
    as_json: list[str],
    home: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    jaw = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.01 0.02 0.06"/>'
    jaw += "</geometry></collision>"
    (home / "gripper.urdf").write_text(GRIPPER.replace(jaw, "", 1))
    monkeypatch.setattr(sys, "argv", ["rtee", "extract", "gripper", *as_json])
    with pytest.raises(SystemExit) as left:
        main()
    said = capsys.readouterr()
    assert not left.value.code
    if as_json:
        found = json.loads(said.out)
        assert found["fingers"]["left_finger"] == {"tip": None, "actuators": ["left"]}
        said = said._replace(out=str(found["primitives"]))
    assert "Trig" in said.out
    assert "left_finger" not in said.out
    assert "Pinch" not in said.out
    assert "note: " in said.err
    assert "left_finger" in said.err


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_output_that_cannot_be_made(place: str, home: Path, refused: Run) -> None:
    Path("file").write_text("in the way")
    said = refused("extract", "gripper", "--out", place)
    assert f"{place}: cannot be written: " in said
    assert "cannot be" in refused("new", "other", "--urdf", home / "gripper.urdf", "--into", place)


@pytest.mark.parametrize("page", ["none/page.html", "config"])
def test_a_report_that_cannot_be_made(page: str, home: Path, refused: Run) -> None:
    assert f"{page}: cannot be written: " in refused("extract", "gripper", "--report", page)


@pytest.mark.heavy
def test_a_full_disk(home: Path, refused: Run, largest_file: Callable[[int | None], None]) -> None:
    out = home / "actions"
    out.mkdir()
    largest_file(300)  # one kind would fit, another would not
    assert "cannot be written: file too large" in refused("extract", "gripper", "--save")
    assert "cannot be" in refused("new", "other", "--urdf", home / "gripper.urdf")
    refused("extract", "gripper", "--out", "deep/out")
    urdf = home / "gripper.urdf"
    assert "cannot be" in refused("new", "other", "--urdf", urdf, "--into", "deep/hands")
    largest_file(20_000)  # the primitives would fit, the page would not
    both = ("--out", "out", "--save", "--report", "page.html")
    assert "page.html: cannot be written: file too large" in refused("extract", "gripper", *both)


def test_a_disk_that_is_full_while_actions_are_imported(
    home: Path, refused: Run, largest_file: Callable[[int | None], None]
) -> None:
    theirs = Path("theirs")
    theirs.mkdir()
    body = "  Type: 1\n  JointsInvolvedCount: {left: 1}\n  JointPos: {left: [0.2]}\n"
    (theirs / "a.yaml").write_text(f"a:\n{body}")
    (theirs / "b.yaml").write_text(f"{'b' * 90}:\n{body}")
    for where in ([], ["--out", "deep/out"]):
        largest_file(100)
        said = refused("import", "theirs", "--hand", "gripper", *where)
        largest_file(None)
        assert "cannot be written: file too large" in said


def test_a_folder_that_is_read_only(home: Path, tmp_path: Path) -> None:
    """A mount that is read-only binds even root."""
    folder = tmp_path / "sealed"
    folder.mkdir()
    script = (
        f"mount --bind '{folder}' '{folder}' && mount -o remount,ro,bind '{folder}' && "
        f"exec '{sys.executable}' -c 'from rtee.cli import main; main()' "
        f"extract gripper --out '{folder}/out'"
    )
    unshare = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]
    try:
        probe = subprocess.run([*unshare, "mount", "--bind", "/", "/"], capture_output=True)
    except FileNotFoundError:
        pytest.skip("there is no unshare here")
    if probe.returncode != 0:
        pytest.skip("nothing can be mounted here")
    done = subprocess.run([*unshare, "sh", "-c", script], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "cannot be written: read-only file system" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not any(folder.iterdir())


def test_a_reader_that_leaves_is_no_mistake() -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    try:
        done = subprocess.run(
            [sys.executable, "-u", "-m", "rtee", "--help"], stdout=theirs, stderr=subprocess.PIPE
        )
    finally:
        os.close(theirs)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("closed", "command", "status"), [(">&-", "--help", 0), ("2>&-", "nosuch", 2)]
)
def test_a_stream_that_is_closed_is_no_mistake(closed: str, command: str, status: int) -> None:
    done = subprocess.run(
        ["sh", "-c", f"exec {shlex.quote(sys.executable)} -m rtee {command} {closed}"],
        capture_output=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (status, b"", b"")


@pytest.mark.parametrize("unbuffered", [(), ("-u",)], ids=["at the end", "at once"])
def test_a_disk_that_is_full_of_our_output(unbuffered: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, *unbuffered, "-m", "rtee", "--version"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2
    assert done.stderr == "rtee: the output cannot be written: no space left on device\n"
