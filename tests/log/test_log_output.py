"""Info, tables, export, plots, playback, and the command line around them."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from rtee_process import PYTHON, RTEE
from typer.testing import CliRunner

import rtee
from log.samples import (
    BEGIN,
    COMMAND,
    RATE,
    SRDF,
    STATISTICS,
    STATUS,
    Log,
    recorded,
    settings,
    tick,
)
from rtee.cli.log import app
from rtee.errors import LogError, MissingExtra, UserError
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log import Recording, read, reader, to_pandas
from rtee.log.dataclass_json import to_json
from rtee.log.export import TABLES, Format, Spool, export, tables
from rtee.log.export import read_for as export_pieces
from rtee.log.figure import MOST_POINTS, PlotSubject, bands_of, figure, labels_of, thinned
from rtee.log.figure import read_for as plot_pieces
from rtee.log.file_index import ChunkPlace, index_file
from rtee.log.info import info
from rtee.log.layout import REPLAY, Replayable
from rtee.log.mcapfile import McapFile
from rtee.log.playback import fingers, write_hand
from rtee.log.plots import write_html, write_png
from rtee.log.recover import recover
from rtee.log.rotation import paths_of
from rtee.loop.settings import LoopSettings
from rtee.messages import topics
from rtee.types import Event, Goal, Named


@pytest.fixture(scope="module")
def recording(story: Path) -> Recording:
    return read(story)


# --- info ----------------------------------------------------------------------------------------


def test_info_counts_what_is_there(story: Path) -> None:
    found = info([story])
    counts = {each.topic: each.messages for each in found.topics}
    assert counts["/claw/joint_states"] == 200
    assert counts["/claw/goals"] == 2
    assert found.size == story.stat().st_size
    assert found.loop is not None
    assert found.loop["ticks"] == 100
    assert [name for name, _ in found.attachments] == ["claw.urdf", "hand.yaml"]
    document = json.loads(json.dumps(found.as_dict()))
    assert document == json.loads(json.dumps(info([story], deep=True).as_dict()))
    assert document["hand"] == "claw"
    assert document["start"] == "2023-11-14T22:13:20.000+00:00"
    assert [goal["outcome"] for goal in document["goals"]] == ["reached", "held"]
    assert document["events"][0]["text"] == "look here"


def test_a_summary_waits_for_no_numpy(story: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from rtee.log.info import info;"
        " info([Path(sys.argv[1])]); sys.exit('numpy' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(story)], check=True)


def test_info_of_a_cut_off_file_says_so(story: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(story.read_bytes()[:-300])
    assert any("not closed" in note for note in info([path]).notes)


@pytest.mark.parametrize("options", [(), ("--deep",)])
@pytest.mark.parametrize("number", [0, 2])  # the first has nothing that a summary tells
def test_info_says_what_a_damaged_chunk_held_and_what_to_do(
    story: Path, tmp_path: Path, number: int, options: tuple[str, ...]
) -> None:
    path = tmp_path / "damaged.mcap"
    place = with_damage(story, path, number)
    status, out = run("info", path, *options)
    # As of all commands that go on with the rest; only `replay --check` fails.
    assert status == 0
    (told,) = [line for line in out.splitlines() if line.startswith("note: ")]
    what, lost, remedy = told.rsplit("; ", 2)
    assert what.startswith("note: damaged.mcap: a chunk ")
    begin, end = ((at - info([story]).start) / 1e9 for at in (place.start, place.end))
    count = sum(map(place.count, place.indexes))
    span = f"from {begin:.2f} s to {end:.2f} s of the file"
    assert lost == f"{count} messages recorded {span} are lost"
    assert remedy == f"`rtee log recover {path}` writes a file of the rest"
    found = json.loads(run("info", path, "--json", *options)[1])
    assert found["damage"] == found["notes"] == [told.removeprefix("note: ")]
    # The digest at the end still has those of the damaged chunk.
    assert [goal["outcome"] for goal in found["goals"]] == ["reached", "held"]
    rest = info([recover(path, tmp_path / "rest.mcap").path])
    assert rest.damage == ()
    left, all_there = (sum(t.messages for t in each.topics) for each in (rest, info([story])))
    assert left == all_there - count


@pytest.mark.parametrize("command", ["plot", "export"])
def test_what_is_made_of_a_damaged_recording_says_what_is_missing(
    story: Path, tmp_path: Path, command: str
) -> None:
    path = tmp_path / "damaged.mcap"
    with_damage(story, path, 2)
    options = ("--no-png", "--out") if command == "plot" else ()
    status, out = run(command, path, *options, tmp_path / "made")
    assert status == 0
    (note,) = [line for line in out.splitlines() if line.startswith("note: ")]
    assert "are lost" in note


def test_info_says_what_a_damaged_chunk_of_a_cut_off_file_held(story: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    with_damage(story, path, 0)
    path.write_bytes(path.read_bytes()[:-300])
    damage, unclosed = info([path]).notes
    assert "a chunk cannot be decompressed" in damage
    assert f"`rtee log recover {path}` writes a file of the rest" in damage
    assert "the file was not closed" in unclosed


def test_info_of_a_large_recording_says_that_only_its_end_was_read(
    story: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "damaged.mcap"
    with_damage(story, path, 2)
    monkeypatch.setattr("rtee.log.info._READ_WHOLE", path.stat().st_size - 1)
    _, out = run("info", path)
    assert "only the end was read; --deep also looks for damage in the rest" in out
    assert "are lost" not in out
    assert json.loads(run("info", path, "--json")[1])["checked"] is False
    _, out = run("info", path, "--deep")
    assert "only the end" not in out
    assert "are lost" in out


def test_many_damaged_chunks_are_told_in_few_words(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 450)
    log.writer.close()
    (path,) = recorded(tmp_path)
    chunks = len(index_file(path).chunks)
    for number in range(1, chunks):
        with_damage(path, path, number)
    *first, others = read(path).damage
    assert len(first) == 5
    assert others == f"further damaged chunks, which are lost: {chunks - 6}"
    (told,) = info([path]).damage
    assert told.count(" are lost; ") == 5
    assert others in told


def with_damage(recording: Path, path: Path, number: int) -> ChunkPlace:
    """Write a recording with some bytes in the middle of a chunk overwritten; return its place."""
    place = index_file(recording).chunks[number]
    data = bytearray(recording.read_bytes())
    middle = place.record.offset + place.record.length // 2
    data[middle : middle + 20] = b"\xa5" * 20
    path.write_bytes(data)
    return place


def test_pieces_give_the_same_tables_and_the_same_plot(
    recording: Recording, story: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_WINDOW", 300_000_000)
    pieces = export_pieces([story])
    whole, parts = tmp_path / "whole.npz", tmp_path / "parts.npz"
    export(read(story, only=TABLES), whole, Format.NPZ)
    export(pieces, parts, Format.NPZ)
    with np.load(whole) as first, np.load(parts) as second:
        assert first.files == second.files
        listed = {each.topic.rsplit("/", 1)[1] for each in info([story]).topics}
        assert {name.partition("/")[0] for name in first.files} == listed
        for name in first.files:
            np.testing.assert_array_equal(first[name], second[name], name)
    drawn, pieced = figure(recording), figure(plot_pieces([story], None, None))
    assert (drawn.bands, drawn.marks, drawn.labels) == (pieced.bands, pieced.marks, pieced.labels)
    for row, other in zip(drawn.rows, pieced.rows, strict=True):
        for line, same in zip(
            row.positions + row.efforts, other.positions + other.efforts, strict=True
        ):
            assert line.name == same.name
            assert line.values.tobytes() == same.values.tobytes()


def test_a_column_has_one_type_whatever_its_pieces_have(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "table")
    spool.add({"t": np.zeros(2), "a": np.array(["", ""]), "n": np.array([1, 2]), "s": np.ones(2)})
    late = {"a": np.array([0.5]), "n": np.array([2**63], dtype=np.uint64), "s": np.array(["text"])}
    spool.add({"t": np.ones(1), **late, "new": np.array([3.0])})
    (table,) = spool.tables(2)
    spool.close()
    assert table["n"].tolist() == [1, 2, 2**63]
    assert table["s"].tolist() == ["1.0", "1.0", "text"]
    np.testing.assert_array_equal(table["a"], [np.nan, np.nan, 0.5])
    np.testing.assert_array_equal(table["new"], [np.nan, np.nan, 3.0])


# --- tables and export ---------------------------------------------------------------------------


MISSING = {"touch", "plans", "grip", "stream_samples", "object", "touch_sensors", "tf_static"} | {
    *topics.FOR_VIEWERS
}
"""What the hand of these tests has not, and the recording of another one below has; and what is
read only when it is asked for."""


def test_every_topic_is_a_table(recording: Recording) -> None:
    found = tables(recording)
    assert set(found) == set(TABLES) - MISSING
    for table in found.values():
        assert len({len(column) for column in table.values()}) == 1
        assert (table["wall_ns"] - recording.start == np.rint(table["t"] * 1e9)).all()
    states_table = found["actuator_states"]
    assert states_table["position.second"][30] == tick(30).position[1]
    assert states_table["tick"].tolist() == list(range(200))
    assert found["results"]["outcome"].tolist() == ["reached", "held"]
    assert np.isnan(found["goals"]["timeout"][0])
    assert found["goals"]["effort"].tolist() == ["first=1.5", ""]
    with pytest.raises(LogError, match="did you mean 'results'"):
        tables(recording, ["result"])


def test_csv_holds_every_number_exactly(recording: Recording, tmp_path: Path) -> None:
    written = export(recording, tmp_path / "out", Format.CSV)
    assert sorted(path.name for path in written) == sorted(
        f"{name}.csv" for name in TABLES if name not in MISSING
    )
    with (tmp_path / "out" / "actuator_states.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 200
    assert float(rows[30]["position.first"]) == tick(30).position[0]
    assert rows[30]["effort.second"] == "nan"
    assert rows[30]["fresh.first"] == "True"
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []


def test_parquet_holds_every_number_exactly(recording: Recording, tmp_path: Path) -> None:
    (path,) = export(recording, tmp_path, Format.PARQUET, ["reference"])
    table = pyarrow.parquet.read_table(path)
    assert table["position.first"].to_pylist() == recording.reference.position[:, 0].tolist()


def test_a_recording_becomes_a_table_of_pandas(recording: Recording) -> None:
    pytest.importorskip("pandas")
    table = to_pandas(recording)
    states = recording.actuator_states
    assert list(table.index) == list(states.t)
    assert list(table[f"position.{states.names[0]}"]) == list(states.position[:, 0])
    assert list(to_pandas(recording, "results")["outcome"])
    with pytest.raises(LogError, match="unknown topic 'result'; did you mean 'results'"):
        to_pandas(recording, "result")
    with pytest.raises(LogError, match=r"what rtee\.log\.read returns, not of 'run\.mcap'"):
        to_pandas("run.mcap")  # type: ignore[arg-type]
    assert len(repr(recording)) <= 240


def test_npz_needs_no_pickle(recording: Recording, tmp_path: Path) -> None:
    (path,) = export(recording, tmp_path / "all.npz", Format.NPZ)
    with np.load(path, allow_pickle=False) as found:
        assert found["joint_states/t"].tolist() == recording.joint_states.t.tolist()
        assert found["events/text"].tolist() == ["look here"]


def test_what_cannot_be_exported_is_said(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nothing to export"):
        export(replace(recording, goals=()), tmp_path / "new" / "out", Format.CSV, ["goals"])
    assert list(tmp_path.iterdir()) == [], "no folder is left"
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LogError, match="cannot be written"):
        export(recording, tmp_path / "file" / "x.npz", Format.NPZ)


# --- plots ---------------------------------------------------------------------------------------


def test_a_plot_shows_states_references_efforts_spans_and_marks(recording: Recording) -> None:
    drawing = figure(recording)
    assert [row.title for row in drawing.rows] == ["first", "second"]
    measured, reference = drawing.rows[0].positions
    assert (measured.dashed, reference.dashed) == (False, True)
    assert reference.values[7] == tick(7).reference_position[0]
    assert drawing.rows[0].efforts[0].values[7] == tick(7).effort[0]
    assert drawing.effort_label.startswith("effort")
    assert [band.text for band in drawing.bands] == [
        "Trig one",
        "drill (held)",
        "close",
        "pull (held)",
    ]
    assert [label.text for label in drawing.labels][-1] == "look here"
    assert len(drawing.marks) == 1


def test_labels_do_not_overlap(recording: Recording) -> None:
    span = recording.spans[0]
    many = [replace(span, start=i / 50, end=i / 50 + 0.02) for i in range(90)]
    object.__setattr__(crowded := replace(recording), "spans", many)
    labels = figure(crowded).labels
    assert 3 <= len(labels) < 90
    places = [(label.t, label.lane) for label in labels]
    assert len(places) == len(set(places))


def test_the_longest_span_has_its_name(recording: Recording) -> None:
    span = recording.spans[0]
    many = [replace(span, name="short", start=i / 50, end=i / 50 + 0.02) for i in range(90)]
    long = replace(span, name="long", start=0.9, end=1.7)
    bands = bands_of([*many, long], 0.0, 2.0)
    names = {label.text for label in labels_of(bands, [], 0.0, 2.0)}
    assert "long" in names


def test_currents_stand_in_for_efforts(recording: Recording) -> None:
    actuators = replace(
        recording.actuator_states, effort=np.full_like(recording.actuator_states.effort, np.nan)
    )
    only_current = replace(recording, actuator_states=actuators)
    assert figure(only_current).effort_label == "current [A]"
    nothing = replace(actuators, current=actuators.effort)
    assert figure(replace(recording, actuator_states=nothing)).rows[0].efforts == ()


def test_a_part_and_some_actuators(recording: Recording) -> None:
    drawing = figure(recording, actuators=["second"], start=0.3, end=0.5)
    assert [row.title for row in drawing.rows] == ["second"]
    assert drawing.rows[0].positions[0].t[0] >= 0.3
    assert [band.span.name for band in drawing.bands] == ["Trig one"]
    with pytest.raises(LogError, match="no states in that time"):
        figure(recording, start=100.0)
    with pytest.raises(LogError, match="'third' is not in the recording"):
        figure(recording, actuators=["third"])


def test_rows_by_finger(recording: Recording) -> None:
    by_finger = figure(
        recording, by=PlotSubject.FINGER, fingers={"one": ("first",), "two": ("first", "second")}
    )
    assert [row.title for row in by_finger.rows] == ["two", "several fingers"]


def test_the_largest_numbers_are_exported(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path / "logs"))
    log.run(0, 2)
    log.writer.item(replace(COMMAND, tick=2**64 - 1), log.time.now)
    log.writer.item(replace(STATUS, exchanges=2**63), log.time.now)
    log.writer.close()
    made = tables(read(tmp_path / "logs"))
    assert made["commands"]["tick"].tolist() == [2**64 - 1]
    assert made["device_status"]["exchanges"].tolist() == [2**63]
    assert made["device_status"]["errors"].dtype == np.int64


def test_thinning_keeps_every_peak() -> None:
    t = np.arange(100_000.0)
    values = np.sin(t / 500)
    values[44_444] = 9.0
    values[55_555] = -9.0
    values[70_000:71_000] = np.nan
    few_t, few = thinned(t, values)
    assert len(few) <= MOST_POINTS
    assert np.nanmax(few) == 9.0
    assert np.nanmin(few) == -9.0
    assert few_t[0] == 0
    assert few_t[-1] == t[-1]
    assert (np.diff(few_t) > 0).all()


@pytest.mark.parametrize("count", [MOST_POINTS + 1, 2 * MOST_POINTS, 123_457, 199_999])
def test_a_peak_at_the_end_is_not_thinned_out(count: int) -> None:
    t, values = np.arange(count) / 1000.0, np.zeros(count)
    for place in (2, 3, 20):
        values[-place] = 9.0 / place
    few_t, few = thinned(t, values)
    assert few.max() == 4.5
    assert len(few) <= MOST_POINTS
    assert few_t[-1] == t[-1]


def test_pictures_and_pages_stand_alone(recording: Recording, tmp_path: Path) -> None:
    drawing = figure(recording)
    write_png(drawing, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    hostile = replace(drawing, title="<script>alert(1)</script>")
    write_html(hostile, tmp_path / "plot.html")
    page = (tmp_path / "plot.html").read_text()
    assert "drill (held)" in page
    assert "<script>alert(1)" not in page
    assert not re.findall(r'<(?:script|link)[^>]+(?:src|href)="http', page)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plot.html", "plot.png"]


# --- playback ------------------------------------------------------------------------------------


def test_the_hand_of_a_recording_can_be_run(recording: Recording, tmp_path: Path) -> None:
    hostile = {"actions/generic/../../../evil.yaml": b"", "/actions/x/y.yaml": b"", "z.srdf": b""}
    actions = {"actions/generic/fist.yaml": b"name: fist\n"}
    attached = {"claw.srdf": SRDF.encode(), **recording.attachments, **actions, **hostile}
    home = write_hand(replace(recording, attachments=attached), tmp_path / "hands")
    hand = load_hand(home)
    assert hand.name == "claw"
    assert hand.actuator_names == ("first", "second")
    assert hand.finger_names == ("one", "two")
    files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {
        "hands/claw/hand.urdf",
        "hands/claw/hand.srdf",
        "hands/claw/hand.yaml",
        "hands/claw/actions/generic/fist.yaml",
    }
    with pytest.raises(LogError, match="no URDF"):
        write_hand(replace(recording, urdf=""), tmp_path)


def test_fingers_are_those_of_the_recorded_actuators(recording: Recording, claw: Hand) -> None:
    assert fingers(recording) == {}
    text = to_json(Replayable(LoopSettings(), claw.actuators)).encode()
    found = fingers(replace(recording, attachments={REPLAY: text}))
    assert set(found) <= {"one", "two"}
    assert {name for names in found.values() for name in names} <= {"first", "second"}


# --- the command line ----------------------------------------------------------------------------


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def test_log_info(story: Path) -> None:
    status, out = run("info", story)
    assert status == 0
    assert "hand claw, 100 Hz" in out
    assert "/claw/joint_states" in out
    assert "held" in out
    assert "mark: look here" in out
    status, out = run("info", story, "--json")
    assert json.loads(out)["hand"] == "claw"


def test_a_hand_s_name_that_no_file_can_have_is_one_sentence(claw: Hand, tmp_path: Path) -> None:
    log = Log(replace(claw, name="x" * 5000), settings(tmp_path / "logs"), start=False)
    path = tmp_path / "named.mcap"
    contents = log.writer.sink._contents
    file = McapFile(path, contents.preamble(0))
    file.write(contents.description(1))
    file.close()
    result = CliRunner().invoke(app, ["unpack", str(path), str(tmp_path / "out")])
    assert isinstance(result.exception, UserError)
    assert "is longer than 100 characters" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_names_of_files_do_not_command_the_terminal(story: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    stamp = "29991231T235959999Z_000"
    theirs = shutil.copy(story, folder / f"x\x1b]0;evil\x07_{stamp}.mcap")
    with pytest.raises(LogError, match="there is no recording in this folder"):
        paths_of(folder)
    # As `rtee log info *` finds it, too.
    for words in (["info"], ["plot", "--no-png"], ["recover", "--out", f"{folder}/new\x07.mcap"]):
        result = CliRunner().invoke(app, [words[0], str(theirs), *words[1:]])
        assert result.exit_code == 0, result.output
        assert "\\x07" in result.output
        assert not {"\x1b", "\x07"}.intersection(result.output)


def test_texts_of_a_recording_do_not_command_the_terminal(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path / "logs"))
    log.run(0, 2)
    log.writer.item(Goal(Named("Trig\x1b[8m")), log.time.now)
    log.writer.item(Event("mark", "user", "\x1b[2Jgone\nnote: all is well", 0.0), log.time.now)
    log.writer.close()
    _, out = run("info", tmp_path / "logs")
    assert r"mark: \x1b[2Jgone\nnote: all is well" in out
    assert r"Trig\x1b[8m" in out
    assert "\x1b" not in out


def test_json_of_a_recording_has_no_number_that_json_does_not_know(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path / "logs"))
    log.run(0, 2)
    log.writer.item(replace(STATISTICS, lateness_p99=np.nan, lateness_max=np.inf), log.time.now)
    log.writer.close()

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    _, out = run("info", tmp_path / "logs", "--json")
    loop = json.loads(out, parse_constant=refuse)["loop"]
    assert (loop["lateness_p99"], loop["lateness_max"]) == (None, None)


def test_log_plot_and_export(story: Path, tmp_path: Path) -> None:
    _, out = run("plot", story, "--out", tmp_path / "p.html", "--no-png", "--by", "actuator")
    assert out.split() == [str(tmp_path / "p.html")]
    _, out = run("plot", story, "--out", tmp_path / "p.1", "--no-html", "--from", 0.5)
    assert out.split() == [str(tmp_path / "p.1.png")]
    _, out = run("export", story, tmp_path / "o.npz")
    assert out.split() == [str(tmp_path / "o.npz")]
    _, out = run("export", story, tmp_path / "o", "--topic", "goals", "--topic", "events")
    assert len(out.split()) == 2


@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "missing.mcap"),
        ("plot", "missing.mcap"),
        ("export", "missing.mcap", "out"),
        ("replay", "missing.mcap", "--check"),
        ("replay", "missing.mcap"),
        ("recover", "missing.mcap"),
    ],
)
def test_a_missing_file_is_one_sentence(arguments: tuple[str, ...]) -> None:
    with pytest.raises(LogError, match=r"^missing\.mcap: cannot be read: no such file") as caught:
        run(*arguments)
    assert caught.value.exit_status == 2


def test_what_is_not_installed_is_said(
    story: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pyarrow", "pyarrow.parquet", "plotly", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, name, None)
    out = tmp_path / "out"
    with pytest.raises(MissingExtra, match=r'pip install .*\[plot\]"'):
        run("export", story, out, "--format", "parquet")
    for more in ((), ("--no-html",)):
        with pytest.raises(MissingExtra, match=r'pip install .*\[plot\]"'):
            run("plot", story, "--out", out, *more)
    assert not list(tmp_path.glob("out*"))


def test_wrong_options_are_said(story: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="--by should be"):
        run("plot", story, "--by", "joint")
    with pytest.raises(LogError, match="--format should be"):
        run("export", story, tmp_path, "--format", "xls")
    with pytest.raises(LogError, match=r"OUT should be a folder, .*; give --format parquet"):
        run("export", story, tmp_path / "story.parquet")
    with pytest.raises(LogError, match=r"OUT ends with '\.json', which is not csv, parquet or npz"):
        run("export", story, tmp_path / "story.json")
    assert not (tmp_path / "story.json").exists()
    with pytest.raises(LogError, match="exactly one file"):
        run("recover", story, story, "--out", tmp_path / "x")
    with pytest.raises(LogError, match="no settings of the loop"):
        run("replay", story, "--check")


def test_log_recover(story: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(story.read_bytes()[:-400])
    status, out = run("recover", path, story)
    assert status == 0
    whole = tmp_path / "cut_recovered.mcap"
    assert out.startswith(f"{whole}: recovered")
    assert f"{story}: is whole" in out
    assert path.stat().st_size == story.stat().st_size - 400  # it is left as it was
    assert read(whole).finished
    newest = tmp_path / "claw_20260101T000000000Z_000.mcap"
    newest.write_bytes(story.read_bytes()[:-400])
    _, out = run("recover", tmp_path, "--in-place")
    assert out.startswith(f"{newest}: recovered")
    status, out = run("recover", newest, "--in-place", "--out", tmp_path / "x")
    assert status == 2
    assert "exclude each other" in out


def test_a_recording_under_way_is_no_damaged_one(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    log.run(0, 300)
    (path,) = recorded(tmp_path)
    assert info([path]).notes == (f"{path.name}: the file is still being written",)
    log.writer.close()
    assert info([path]).notes == ()


def test_what_cannot_be_read_of_a_file_is_said(story: Path, tmp_path: Path) -> None:
    data = story.read_bytes()
    cut, damaged = tmp_path / "cut.mcap", tmp_path / "damaged.mcap"
    cut.write_bytes(data[:-400])
    head = (
        index_file(story).chunks[-1].record.offset - 9
    )  # its opcode and the length of its content
    damaged.write_bytes(
        data[:head] + bytes(0xFF ^ byte for byte in data[head:][:9]) + data[head + 9 :]
    )
    for path, said in (
        (cut, "the file was not closed"),
        (damaged, f" bytes from byte {head} on are damaged"),
    ):
        _, out = run("info", path, "--deep")
        checked = CliRunner().invoke(app, ["replay", str(path), "--check"])
        for told in (out, checked.stderr):
            assert f"note: {path.name}: " in told
            assert said in told


def test_an_export_that_is_ended_leaves_nothing(story: Path, tmp_path: Path) -> None:
    program = (
        "import os, signal, rtee.log.export as export\n"
        "export.tables = lambda *_: os.kill(os.getpid(), signal.SIGTERM)\n"
        "from rtee.cli import main; main()"
    )
    command = [*PYTHON, "-c", program, "log", "export", str(story), str(tmp_path)]
    assert subprocess.run(command, check=False).returncode == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []


def test_info_of_a_series(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, max_file_size=40_000))
    log.run(0, 400)
    log.writer.close()
    paths = recorded(tmp_path)
    _, one = run("info", paths[1], "--json")
    _, all_parts = run("info", paths[1], "--series", "--json")
    assert json.loads(one)["duration"] < 3.0
    assert len(json.loads(all_parts)["files"]) == len(paths)
    assert json.loads(all_parts)["duration"] == pytest.approx(399 / RATE)
    assert read(paths).actuator_states.time[0] == BEGIN


def test_log_replay_shows_recorded_states_to_clients(claw: Hand, tmp_path: Path) -> None:
    name = f"claw-{os.getpid()}"
    log = Log(replace(claw, name=name), settings(tmp_path))
    log.run(0, 300)
    log.writer.close()
    (path,) = recorded(tmp_path)
    path.write_bytes(path.read_bytes()[:-400])  # as if its program had been killed
    told = {tuple(tick(number).position.tolist()) for number in range(300)}
    command = [*RTEE, "log", "replay"]
    child = subprocess.Popen(
        [*command, str(path), "--speed", "2", "--repeat", "--gui"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=tmp_path,
    )
    assert child.stdout is not None
    with child, child.stdout:
        line = child.stdout.readline()
        assert line.startswith(f"{name}: 2 actuators, 4 joints"), line + child.stdout.read()
        with rtee.connect_blocking(name) as hand:
            seen = [tuple(state.position.tolist()) for state in islice(hand.states(50.0), 20)]
            description = hand.robot_description()
        assert any("http://127.0.0.1:" in line for line in child.stdout), "no GUI came up"
        child.send_signal(signal.SIGINT)
        rest = child.stdout.read()
    assert child.returncode == 0, rest
    assert len(set(seen)) > 5
    assert set(seen) <= told
    assert description == claw.urdf.text
