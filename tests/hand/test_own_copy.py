"""Nothing is written where rtee is installed: the hand is copied first, and the copy is found."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from patient import be_patient

from rtee.actions.build import generic
from rtee.actions.library import ActionLibrary
from rtee.actions.openings import Openings, write_openings
from rtee.errors import ConfigError, UserError
from rtee.hand import own_copy
from rtee.hand.catalog import find_hand
from rtee.hand.load import load_configured, load_hand

GRIPPER = "robotiq_2f_85"
PR_CAPBSET_DROP = 24
CAP_DAC_OVERRIDE = 1


# --- an installed rtee ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(repository: Path) -> Iterator[Path]:
    """A folder as pip would make it of the wheel, write-protected."""
    folder = Path(tempfile.mkdtemp(prefix="rtee-site-"))
    folder.chmod(0o755)
    shutil.copytree(repository / "rtee", folder / "rtee")
    shutil.copytree(repository / "config", folder / "rtee/_config")
    be_patient(folder / "rtee/_config" / GRIPPER / "hand.yaml")
    for place in (folder, *folder.rglob("*")):
        mode = 0o555 if place.is_dir() else 0o444
        place.chmod(mode)
    yield folder
    for place in (folder, *folder.rglob("*")):
        if place.is_dir():
            place.chmod(0o755)
    shutil.rmtree(folder)


@pytest.fixture
def work() -> Iterator[Path]:
    """An empty folder that everybody may write to and come to."""
    folder = Path(tempfile.mkdtemp(prefix="rtee-work-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


def environment(site: Path, work: Path) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RTEE", "XDG"))}
    return kept | {
        "PYTHONPATH": str(site),
        "PYTHONDONTWRITEBYTECODE": "1",
        "HOME": str(work / "home"),
        "TMPDIR": str(work),
        "RTEE_RUNTIME_DIR": str(work / "run"),
    }


def like_anybody() -> None:
    """Take from root the right to write to what is write-protected; others don't have it."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)


def run(
    site: Path, work: Path, *words: str, root: bool = False, program: str = ""
) -> subprocess.CompletedProcess[str]:
    command = ["-c", program] if program else ["-m", "rtee", *words]
    done = subprocess.run(
        [sys.executable, *command],
        cwd=work,
        env=environment(site, work),
        text=True,
        capture_output=True,
        preexec_fn=None if root else like_anybody,
    )
    assert done.returncode == 0, (done.stdout, done.stderr)
    return done


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in sorted(folder.rglob("*"))
    }


def hand_given(site: Path, work: Path) -> None:
    done = run(site, work, "hands", "--json")
    folders = {hand["name"]: hand["folder"] for hand in json.loads(done.stdout)["hands"]}
    assert folders[GRIPPER] == f"config/{GRIPPER}"


COMMANDS: dict[str, tuple[str, str]] = {
    "compose": (f"compose hook grasp*0.5 --hand {GRIPPER}", "actions/composed/hook.yaml"),
    "time": (
        f"time twice grasp*0.5:after=0.1,alias=a grasp:alias=b --hand {GRIPPER}",
        "actions/timed/twice.yaml",
    ),
    "generic": (f"generic half finger_joint=0.4 --hand {GRIPPER}", "actions/generic/half.yaml"),
    "extract": (f"extract {GRIPPER} --save --jobs 1", "actions/primitives/PinchTight.yaml"),
    "try": (
        f"try {GRIPPER} --all --again --object sphere:0.02 --variations 0 --jobs 1",
        "trials.yaml",
    ),
    "calibrate": (f"calibrate {GRIPPER} --emulated --yes", "calibration/gripper.json"),
}


@pytest.mark.samples("compose")
@pytest.mark.parametrize("command", COMMANDS)
def test_an_installed_hand_is_copied_to_be_changed(site: Path, work: Path, command: str) -> None:
    if command == "try":
        pytest.importorskip("mujoco")
    before = snapshot(site)
    words, made = COMMANDS[command]
    done = run(site, work, *words.split())
    line = f"hand '{GRIPPER}' came with rtee; it is copied to config/{GRIPPER}, which is used from"
    assert (done.stdout + done.stderr).count(line) == 1
    assert snapshot(site) == before
    assert (work / "config" / GRIPPER / made).is_file()
    for name in ("hand.yaml", f"{GRIPPER}.urdf"):
        shipped = site / "rtee/_config" / GRIPPER / name
        assert (work / "config" / GRIPPER / name).read_bytes() == shipped.read_bytes()
    hand_given(site, work)


def test_root_who_could_write_there_does_not(site: Path, work: Path) -> None:
    before = snapshot(site)
    run(site, work, *COMMANDS["compose"][0].split(), root=True)
    assert snapshot(site) == before
    again = run(site, work, *COMMANDS["generic"][0].split(), root=True)
    assert "copied" not in again.stdout + again.stderr
    assert (work / "config" / GRIPPER / "actions/composed/hook.yaml").is_file()
    assert (work / "config" / GRIPPER / "actions/generic/half.yaml").is_file()


STORE = """
import rtee
with rtee.connect_blocking() as hand:
    hand.add_generic("half", {"finger_joint": 0.4}, store=True)
    hand.rename_action("hook", "crook")
    print(sorted({action.name for action in hand.actions()}))
"""


@pytest.mark.heavy
def test_a_running_hand_follows_its_copy(site: Path, work: Path) -> None:
    before = snapshot(site)
    running = subprocess.Popen(
        [sys.executable, "-m", "rtee", "run", GRIPPER, "--driver", "kinematic", "--no-log"],
        cwd=work,
        env=environment(site, work),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=like_anybody,
    )
    try:
        run(site, work, "open", "--wait", "40")
        run(site, work, *COMMANDS["compose"][0].split())
        assert "hook: reached" in run(site, work, "do", "hook").stdout
        known = run(site, work, program=STORE).stdout
        assert "'crook', 'half'" in known
        assert "hook" not in known
    finally:
        running.terminate()
        running.communicate(timeout=20)
    assert snapshot(site) == before
    actions = work / "config" / GRIPPER / "actions"
    assert (actions / "generic/half.yaml").is_file()
    assert (actions / "composed/crook.yaml").is_file()
    assert not (actions / "composed/hook.yaml").exists()


# --- the rule ---------------------------------------------------------------------------------


@pytest.fixture
def shipped(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A gripper that counts as one that came with rtee, seen from an empty folder."""
    folder = tmp_path / "site/_config" / GRIPPER
    shutil.copytree(repository / "config" / GRIPPER, folder)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(own_copy, "SHIPPED", folder.parent)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.delenv("RTEE_CONFIG_PATH", raising=False)
    return folder


def test_a_hand_of_ones_own_is_changed_where_it_is(shipped: Path) -> None:
    mine = Path("config") / GRIPPER
    own_copy.copy_hand(shipped, mine)
    assert own_copy.is_own(mine)
    assert own_copy.own(mine) == mine
    assert own_copy.own_place(mine) == mine


def test_reading_copies_nothing(shipped: Path) -> None:
    library = ActionLibrary.load(load_hand(shipped), shipped / "actions")
    library.save()  # nothing differs
    assert library.folder == shipped / "actions"
    assert not list(Path().iterdir())


def test_what_is_refused_copies_nothing(shipped: Path) -> None:
    hand = load_hand(shipped)
    library = ActionLibrary.load(hand, shipped / "actions")
    with pytest.raises(UserError):
        library.add(generic(hand, "Grasp", {"finger_joint": 0.4}), store=True)
    assert not list(Path().iterdir())


def test_the_copy_goes_where_hands_are_looked_up_first(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTEE_CONFIG_PATH", str(tmp_path / "mine"))
    assert own_copy.own(shipped) == tmp_path / "mine" / GRIPPER
    assert find_hand(GRIPPER) == tmp_path / "mine" / GRIPPER
    assert not (tmp_path / "work/config").exists()


def test_where_nothing_can_be_written_the_users_folder_takes_it(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    allowed = os.access
    here = Path.cwd()

    def access(path: Path, mode: int) -> bool:  # root may write everywhere
        return Path(path).resolve() != here and allowed(path, mode)

    monkeypatch.setattr(os, "access", access)
    assert own_copy.own(shipped) == tmp_path / "settings/rtee/hands" / GRIPPER
    assert find_hand(GRIPPER) == tmp_path / "settings/rtee/hands" / GRIPPER


def test_a_copy_that_would_be_hidden_is_refused(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixed = tmp_path / "fixed"
    shutil.copytree(shipped, fixed / GRIPPER)
    monkeypatch.setenv("RTEE_CONFIG_PATH", str(fixed))
    monkeypatch.setattr(own_copy, "SHIPPED", fixed)
    monkeypatch.setattr(own_copy, "_can_be_made", lambda place: place != fixed)
    with pytest.raises(ConfigError, match=r"would be shadowed by .*RTEE_CONFIG_PATH"):
        own_copy.own(fixed / GRIPPER)
    assert not Path("config").exists()


def test_a_copy_that_is_there_is_not_overwritten(shipped: Path) -> None:
    own_copy.own(shipped)
    with pytest.raises(ConfigError, match=f"your own is config/{GRIPPER}"):
        own_copy.own(shipped)
    assert own_copy.copied_since(shipped) == Path("config") / GRIPPER


def test_a_running_hand_takes_actions_and_openings_from_the_copy(shipped: Path) -> None:
    """The openings stayed those of the hand that came with rtee."""
    library = ActionLibrary.load(load_hand(shipped), shipped / "actions")
    assert library.openings.tables
    copy = own_copy.own(shipped)
    write_openings(copy, Openings(library.hand))
    assert library.reload()
    assert library.folder == copy / "actions"
    assert not library.openings.tables


def test_the_copy_belongs_to_the_user(shipped: Path) -> None:
    for path in shipped.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    copy = own_copy.own(shipped)
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (copy, *copy.rglob("*"))]
    assert all(mode & stat.S_IWUSR for mode in modes)


# --- a hand of another name -------------------------------------------------------------------


def test_a_copy_of_another_name_is_a_hand_of_that_name(shipped: Path) -> None:
    own_copy.copy_hand(shipped, Path("config/my_gripper"))
    hand, config = load_configured("my_gripper")
    assert (hand.name, config.title) == ("my_gripper", load_configured(shipped)[1].title)
    library = ActionLibrary.load(hand, Path("config/my_gripper/actions"))
    assert library.find("Grasp")
    assert not Path("config/my_gripper/trials.yaml").exists()
    assert Path("config/hand.schema.json").is_file()
    with pytest.raises(ConfigError, match="already exists"):
        own_copy.copy_hand(shipped, Path("config/my_gripper"))


def test_a_copy_that_is_no_hand_leaves_nothing(shipped: Path, tmp_path: Path) -> None:
    (tmp_path / "away").mkdir()
    urdf = shipped / f"{GRIPPER}.urdf"
    urdf.rename(tmp_path / "away" / urdf.name)
    file = shipped / "hand.yaml"
    text = file.read_text().replace(f"urdf: {urdf.name}", f"urdf: ../../../away/{urdf.name}")
    file.write_text(text)
    assert load_hand(shipped).name == GRIPPER
    with pytest.raises(UserError):
        own_copy.own(shipped)
    assert not list(Path().iterdir())


def new(*words: str) -> tuple[int, str]:
    from typer.testing import CliRunner

    from rtee.cli._common import app_of
    from rtee.cli.new import new

    try:
        done = CliRunner().invoke(app_of(new), words, catch_exceptions=False)
    except UserError as error:
        return error.exit_status, str(error)
    return done.exit_code, done.output


def test_a_disk_that_is_full_is_told_once(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "from", None, "to")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(
        ConfigError, match=r"created: no space left on device: '[^']+' and [0-9]+ more$"
    ):
        own_copy.copy_hand(shipped, tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_new_from_a_hand(shipped: Path) -> None:
    status, said = new("my_gripper", "--from", str(shipped))
    assert (status, said.splitlines()[-1]) == (0, "Next: rtee actions my_gripper")
    assert load_hand("my_gripper").actuator_names == load_hand(shipped).actuator_names


def test_new_ends_with_what_makes_the_actions(shipped: Path) -> None:
    status, said = new("mine", "--urdf", str(shipped / f"{GRIPPER}.urdf"))
    assert (status, said.splitlines()[-1]) == (0, "Next: rtee extract mine --save")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("mine", "give one of --urdf FILE, --mjcf FILE and --from HAND"),
        (
            f"mine --from {GRIPPER} --urdf g.urdf",
            "give one of --urdf FILE, --mjcf FILE and --from HAND",
        ),
        (f"mine --from {GRIPPER} --srdf g.srdf", "--srdf needs --urdf or --mjcf"),
        ("mine --from nix", "unknown hand 'nix'"),
        (f"a/b --from {GRIPPER}", "'a/b'"),
    ],
)
def test_new_from_refuses_what_makes_no_sense(shipped: Path, words: str, said: str) -> None:
    status, text = new(*words.split())
    assert status == 2
    assert said in text
    assert not list(Path().iterdir())
