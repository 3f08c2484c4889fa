"""Names from models, recordings and devices, with the syntax of everything they come into."""

from __future__ import annotations

import contextlib
import csv
import io
import json
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import anyio
import pytest
import viser
from anyio.abc import TaskGroup
from log.samples import settings
from loop.hands import Rig, Watcher, device
from remote.serving import Served
from ros2.conftest import free_endpoint, open_router
from ros2.facing import a_hand_in_ros

import rtee
from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import ConfigError, ModelError, UserError, foreign
from rtee.exchange.export import ExportFormat, export_hand
from rtee.exchange.reading import as_urdf
from rtee.extract.extraction import extract
from rtee.extract.kinematic import kinematic_primitives
from rtee.extract.report import make_report
from rtee.gui.app import App
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.hand.scaffold import make_hand
from rtee.hand.yamlfile import read_yaml
from rtee.log import Recorder, read
from rtee.log.brief import actuators_of
from rtee.log.export import Format, export, tables
from rtee.log.figure import figure
from rtee.log.plots import write_html
from rtee.loop.clock import ManualClock
from rtee.loop.handloop import HandLoop
from rtee.loop.settings import LoopSettings
from rtee.messages.cdr import Reader, Writer
from rtee.types import Event

FORBIDDEN = [
    "a\nremote: {listen: [tcp/0.0.0.0:7447]}",
    "a\r\nb",
    "a\tb",
    "a\x85b",
    "a\u2028b",
    "\u202egnp.exe",
    "a\u200bb",
    "a\u2066b",
    "\ufeffa",
]
"""Line breaks, control characters, writing directions, and what has no width."""

ALLOWED = [
    "a\"b'c",
    "<img src=x onerror=alert(1)>",
    "</script><script>alert(1)</script>",
    "a: {b: [c, *d]} # e",
    "- x --> y",
    "&lt;b&gt; &#10;",
    "{{ 7 * 7 }}{% raw %}",
    "../../etc/passwd",
    "%s{0}\\n\\u202e",
    "!!python/object:os.system",
    "Zeigefinger-Grundgelenk_öß",
    "$(reboot)`reboot`;|",
]
"""The syntax of YAML, XML, HTML, templates, formats, paths and shells; and a word of a language."""


def urdf_of(names: list[str]) -> str:
    """Return a hand with two fingers and a thumb whose joints and links have these names."""
    box = '<collision><geometry><box size="0.01 0.01 0.03"/></geometry></collision>'
    lines = [f'<robot name="foreign"><link name="palm">{box}</link>']
    for number, name in enumerate(names):
        joint, link = quoteattr(name, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}), f"link {name}"
        link = quoteattr(link, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})
        lines.append(
            f'<joint name={joint} type="revolute"><parent link="palm"/><child link={link}/>\n'
            f'<origin xyz="{0.04 * number} 0 0.03"/><axis xyz="0 1 0"/>'
            '<limit lower="0" upper="1.2" velocity="2" effort="1"/></joint>'
            f"<link name={link}>{box}</link>"
        )
    return "\n".join([*lines, "</robot>"])


def refused(error: UserError) -> str:
    """Return an error's text, which is one printable line."""
    assert str(error).isprintable()
    assert "is not printable" in str(error)
    return str(error)


# --- what is refused


@pytest.mark.parametrize("name", FORBIDDEN)
def test_characters_that_nobody_sees_are_refused_where_they_enter(
    name: str, tmp_path: Path
) -> None:
    """A line break in a joint's name became lines of hand.yaml."""
    (tmp_path / "x.urdf").write_text(urdf_of(["first", name]))
    with pytest.raises(ModelError) as error:
        make_hand("x", tmp_path / "x.urdf", into=tmp_path / "config")
    assert "x.urdf:4:" in refused(error.value)
    assert not (tmp_path / "config" / "x").exists()
    attribute = quoteattr(name, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})
    (tmp_path / "y.urdf").write_text(urdf_of(["first", "second"]))
    (tmp_path / "y.srdf").write_text(f'<robot name="y">\n<group name={attribute}/></robot>')
    with pytest.raises(ModelError) as error:
        load_model(tmp_path / "y.urdf", tmp_path / "y.srdf")
    assert ":2:" in refused(error.value)
    (tmp_path / "hand.yaml").write_text(f"name: y\nlimits:\n  {json.dumps(name)}: {{lower: 0}}\n")
    with pytest.raises(ConfigError) as found:
        read_yaml(tmp_path / "hand.yaml", "hand.yaml")
    assert ":3:" in refused(found.value)


@pytest.mark.parametrize("name", FORBIDDEN)
def test_in_mjcf_too(name: str, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    attribute = quoteattr(name, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})
    (tmp_path / "x.xml").write_text(
        '<mujoco>\n<worldbody><body name="palm"><geom size="0.01"/>\n'
        f'<body name="tip"><joint name={attribute} range="0 1"/><geom size="0.01"/></body>'
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(ModelError) as error, as_urdf(None, tmp_path / "x.xml", (), ()):
        pass
    assert ":3:" in refused(error.value)


@pytest.mark.parametrize("name", FORBIDDEN)
def test_what_a_xacro_makes_is_read_as_any_other(name: str, tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "x.urdf.xacro").write_text(urdf_of(["first", name]))
    try:
        with as_urdf(tmp_path / "x.urdf.xacro", None, (), ()) as model:
            names = load_model(model.urdf).actuator_names
    except ModelError as error:
        refused(error)
    else:  # xacro writes line breaks as they are, which XML reads as blanks
        assert all(each.isprintable() for each in names)


@pytest.mark.parametrize("name", FORBIDDEN)
def test_paths_in_errors_cannot_command_the_terminal(name: str) -> None:
    said = str(ConfigError("is wrong", path=Path("logs", name), line=2))
    assert said == f"{foreign(str(Path('logs', name)))}:2: is wrong"
    assert said.isprintable()


@pytest.mark.parametrize("name", FORBIDDEN)
def test_devices_and_messages_cannot_write_lines(name: str) -> None:
    identity = Capabilities(identity={name: name}).identity
    writer = Writer(b"\0\1\0\0")
    writer.length(1)
    writer.string(name)
    event = Event("said", "device", name, 0.0)
    from rtee.messages import EVENT

    said = EVENT.decode(EVENT.encode(event)).text
    for text in (*identity, *identity.values(), *Reader(writer.done()).strings(), said):
        assert text == foreign(name)
        assert text.isprintable()


# --- what is escaped


class Tags(HTMLParser):
    """Collects the tags of a page with their attributes' names, and handlers of events."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.handlers: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.handlers |= {name for name, _ in attrs if name.startswith("on")}


def harmless(page: str) -> None:
    """Check that a page has no element of a name."""
    found = Tags(page)
    assert "b" not in found.handlers
    assert not found.handlers & {"onerror"}
    for evil in ("<img src=x", "<script>alert(1)"):
        assert evil not in page
    assert 'src="x"' not in page


@pytest.fixture(autouse=True)
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep other hands of this computer out."""
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a hand with all names that are allowed."""
    place = tmp_path_factory.mktemp("foreign")
    (place / "x.urdf").write_text(urdf_of(ALLOWED))
    return make_hand("foreign", place / "x.urdf", into=place / "config").folder


def test_a_new_hand_has_the_configuration_of_any_other(folder: Path) -> None:
    data = read_yaml(folder / "hand.yaml", "hand.yaml").data
    assert set(data) <= {"name", "urdf", "srdf", "driver", "rest", "ignore"}
    hand = load_hand(folder)
    assert set(hand.actuator_names) == set(ALLOWED)
    for file in ("foreign.urdf", "foreign.srdf"):
        ElementTree.fromstring((folder / file).read_text())


@pytest.mark.heavy
def test_extraction_and_its_report(folder: Path) -> None:
    hand = load_hand(folder)
    extraction = extract(hand)
    harmless(make_report(hand, extraction, jobs=1, size=(64, 48)))
    ActionLibrary(hand, extraction.primitives).save(folder / "actions")
    # The stored actions are those of the names, and nothing else.
    library = ActionLibrary.load(hand, folder / "actions")
    involved = {name for a in library for w in getattr(a, "waypoints", ()) for name in w.involved}
    assert involved <= set(ALLOWED)
    assert involved


def test_exports_are_read_again(folder: Path, tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    export_hand(folder, tmp_path / "out")
    names = set(ALLOWED)
    for kind in ExportFormat:
        files = sorted((tmp_path / "out").glob(f"*.{ {'mjcf': 'xml'}.get(kind, kind) }"))
        for file in files:
            root = ElementTree.fromstring(file.read_text())
            joints = {each.attrib.get("name", "") for each in root.iter("joint")}
            assert joints <= names | {""} | {f"{n}" for n in names}, kind
            if file.suffix == ".xml":
                mujoco.MjModel.from_xml_path(str(file))


@pytest.mark.anyio
async def test_recordings_plots_and_tables(folder: Path, tmp_path: Path) -> None:
    hand = load_hand(folder)
    loop_settings, clock = LoopSettings(rate=100.0), ManualClock(100.0)
    one = device(hand, rate=100.0)
    driver = KinematicDriver(one.spec, BusPool())
    driver.now = clock.now
    library = ActionLibrary(hand, kinematic_primitives(hand))
    loop = HandLoop(hand, library, loop_settings, [(one, driver)], now=clock.now)
    recorder = Recorder(hand, settings(tmp_path), rate=100.0, loop=loop_settings)
    loop.add_observer(recorder)
    async with recorder, loop:
        await loop.ready()
        rig = Rig(loop, clock, Watcher())
        await rig.run(0.1)
        loop.jog({ALLOWED[1]: 0.5})
        loop.announce(Event("told", "device", ALLOWED[2], clock.now()))
        await rig.run(0.5)
    check_files(tmp_path)


def check_files(folder: Path) -> None:
    """Check what is made of the recording in a folder."""
    [file] = folder.glob("*.mcap")
    found = read(file)
    assert set(actuators_of(found.metadata)) == set(ALLOWED)
    states = tables(found, ["actuator_states"])["actuator_states"]
    assert {f"position.{name}" for name in ALLOWED} <= set(states)
    write_html(figure(found), folder / "plot.html")
    harmless((folder / "plot.html").read_text())
    (written,) = export(found, folder, Format.CSV, ["actuator_states"])
    with written.open(newline="") as table:
        assert next(csv.reader(table)) == list(states)
    assert written.parent == folder


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        yield server
        server.stop()


@pytest.mark.anyio
async def test_the_gui_and_ros2(folder: Path, server: viser.ViserServer) -> None:
    pytest.importorskip("xxhash")
    hand = load_hand(folder)
    library = ActionLibrary(hand, kinematic_primitives(hand))
    endpoint = free_endpoint()
    with open_router(endpoint):
        async with (
            a_hand_in_ros(hand, library, Ros2Settings(router=endpoint)) as (served, robot),
            anyio.create_task_group() as group,
        ):
            states = await robot.listen("/joint_states", "sensor_msgs/msg/JointState")
            assert set(states[0].name) == set(ALLOWED)
            await seen_in_the_gui(hand, served, server, group)


async def seen_in_the_gui(
    hand: Hand, served: Served, server: viser.ViserServer, group: TaskGroup
) -> None:
    app = App(server, hand.name, None)
    group.start_soon(app.run)
    while app._group is None:
        await anyio.lowlevel.checkpoint()
    page = app.open(server)
    while page.session is None:  # noqa: ASYNC110
        await anyio.sleep(0.02)
    async with rtee.connect(hand.name) as remote:
        served.loop.announce(Event("told", "device", ALLOWED[1], 0.0))
        assert set((await remote.state()).names) == set(ALLOWED)
    await anyio.sleep(1.0)  # the panels are filled
    for handle in server.gui._gui_input_handle_from_uuid.values():
        content = getattr(handle, "content", None)
        if isinstance(content, str):
            harmless(content)
    group.cancel_scope.cancel()
