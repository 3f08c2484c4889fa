"""`rtee log`: inspect, plot, export, replay and repair recordings."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import Commands, ConnectOption, JsonOption, RunningOption, to_json, with_hand
from rtee.cli._table import Column, table_of
from rtee.errors import ConfigError, LogError, UserError, foreign, needing_extra
from rtee.hand.catalog import find_hand
from rtee.hand.files import temporary_folder

if TYPE_CHECKING:
    from rtee.log.check import ReplayCheck
    from rtee.log.info import RecordingInfo
    from rtee.log.recording import Recording

app = Commands()


@app.callback()
def _recordings() -> None:
    """Inspect, plot, export, replay and repair recordings."""
    # By an exception, which removes temporary files.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


File = Annotated[
    Path, typer.Argument(metavar="FILE", help="A recording, or a folder: its newest recording.")
]
Series = Annotated[
    bool, typer.Option("--series", help="Use all parts of the recording that FILE belongs to.")
]


def _paths(path: Path, series: bool) -> list[Path]:
    from rtee.log.rotation import paths_of

    return paths_of(path, series=series)


@app.command()
def info(
    file: File,
    *,
    series: Series = False,
    deep: bool = False,
    as_json: JsonOption = False,
) -> None:
    """Show the contents of a recording.

    Arguments and options:
        deep: Read recordings above 64 MB whole, too, which finds damage inside them.
    """
    from rtee.log.info import info as summarise

    summary = summarise(_paths(file, series), deep=deep)
    if as_json:
        print(to_json(summary.as_dict(), indent=2))
    else:
        _show(summary)


def _show(summary: RecordingInfo) -> None:
    from rtee.log.info import iso

    for path, size in summary.files:
        _print_safely(f"{path}  {size / 1e6:.1f} MB")
    rate = f", {summary.rate:g} Hz" if summary.rate else ""
    _print_safely(f"hand {summary.hand or 'unknown'}{rate}, written by {summary.library}")
    print(
        f"{iso(summary.start) or 'no messages'}, {summary.duration:.1f} s, "
        f"{summary.size_per_minute / 1e6:.1f} MB a minute"
    )
    _show_topics(summary)
    if summary.attachments:
        names = ", ".join(name for name, _ in summary.attachments)
        _print_safely(f"attachments: {names}")
    if (last := summary.loop) is not None:
        print(
            f"loop: {last['ticks']} ticks, {last['missed']} missed, lateness p99 "
            f"{last['lateness_p99'] * 1e6:.0f} µs, max {last['lateness_max'] * 1e6:.0f} µs, "
            f"{last['dropped']} records dropped"
        )
    if summary.goals:
        _show_goals(summary)
    for event in summary.events:
        _print_safely(f"{event.t:.2f} s  {event.severity}  {event.kind}: {event.text}")
    for note in summary.notes:
        _print_safely(f"note: {note}")
    if not summary.checked:
        print("only the end was read; --deep also looks for damage in the rest")


@app.command()
def mark(
    text: str,
    *,
    hand: RunningOption = None,
    connect: ConnectOption = None,
) -> None:
    """Put a mark into the recording of a running hand.

    Example: rtee log mark "the cup slipped"

    Arguments and options:
        text: What happens, in one line.
    """
    with_hand(hand, connect, "mark", lambda remote: remote.record("mark", text))


def _print_safely(line: str) -> None:
    # A recording may come from anywhere: escape control characters for the terminal.
    print(foreign(line))


def _show_topics(summary: RecordingInfo) -> None:
    columns = (
        "topic",
        "type",
        Column("messages", right=True, whole=True),
        Column("rate [Hz]", right=True, whole=True),
    )
    topics = (
        (*map(foreign, (each.topic, each.type)), str(each.messages), f"{each.rate:.1f}")
        for each in summary.topics
    )
    table_of(columns, topics).show()


def _show_goals(summary: RecordingInfo) -> None:
    columns = (
        Column("at [s]", right=True, whole=True),
        "goal",
        Column("took [s]", right=True, whole=True),
        "outcome",
    )
    spans = (
        (f"{s.start:.2f}", foreign(s.name), f"{s.end - s.start:.2f}", s.outcome)
        for s in summary.goals
    )
    table_of(columns, spans).show()


@app.command()
def plot(
    file: File,
    *,
    series: Series = False,
    output: Path | None = None,
    by: str | None = None,
    actuator: list[str] | None = None,
    start: float | None = None,
    end: float | None = None,
    html: bool = True,
    png: bool = True,
) -> None:
    """Plot positions, references and efforts with the spans of the actions.

    Arguments and options:
        output (--out; PATH): Path of the files .html and .png; that of FILE unless given.
        by: A row for each 'actuator' or for each 'finger'.
        actuator: Only this actuator; may be given again.
        start (--from): Begin here [s].
        end (--to): End here [s].
        html (--html/--no-html): Make a page.
        png (--png/--no-png): Make a picture.
    """
    from rtee.log.figure import PlotSubject, figure, read_for
    from rtee.log.playback import fingers

    if by is not None and by not in list(PlotSubject):
        raise LogError(f"--by should be 'actuator' or 'finger', not '{by}'")
    pieces = _telling(read_for(_paths(file, series), start, end))
    recording = next(pieces)
    drawing = figure(
        chain((recording,), pieces),
        by=None if by is None else PlotSubject(by),
        actuators=actuator or (),
        start=start,
        end=end,
        fingers=fingers(recording),
    )
    base = output or recording.paths[0]
    if base.suffix in (".html", ".png", ".mcap"):
        base = base.with_suffix("")
    if html:
        from rtee.log.plots import write_html

        # `with_suffix` would cut off a part of a name with a dot.
        path = base.with_name(base.name + ".html")
        write_html(drawing, path)
        _print_safely(str(path))
    if png:
        from rtee.log.plots import write_png

        path = base.with_name(base.name + ".png")
        write_png(drawing, path)
        _print_safely(str(path))
        if recording.object_description is not None:
            _write_pictures(recording, base.with_name(base.name + "_object.png"))


def _write_pictures(recording: Recording, path: Path) -> None:
    """Write pictures of the simulated object in the hand, or note why it cannot."""
    try:
        with needing_extra("a picture of the object", "extract"):
            from rtee.trials.recorded_pictures import write_pictures
        write_pictures(recording, path)
    # The plots are already written, so a missing picture is not a failure.
    except ConfigError as error:
        _print_safely(f"note: {error}")
    else:
        _print_safely(str(path))


@app.command()
def export(
    file: File,
    output: Path,
    *,
    series: Series = False,
    kind: str | None = None,
    topic: list[str] | None = None,
) -> None:
    """Write a recording's topics as CSV, Parquet or NumPy files.

    Arguments and options:
        output (OUT): A folder, or a file that ends in .npz.
        kind (--format): csv, parquet or npz; by OUT unless given.
        topic: Only this topic; may be given again.
    """
    from rtee.log.export import Format, read_for
    from rtee.log.export import export as write

    if kind is None:
        if output.suffix in (".csv", ".parquet"):
            raise LogError(
                f"OUT should be a folder, not '{output}', as each topic becomes a file;"
                f" give --format {output.suffix[1:]}"
            )
        # Likely a file of some other kind is wanted; "run.2" or an existing "run.d" is a folder.
        if output.suffix[1:].isalpha() and output.suffix != ".npz" and not output.is_dir():
            raise LogError(
                f"OUT ends with '{output.suffix}', which is not csv, parquet or npz; give a "
                "file that ends with .npz, or a folder with --format csv or parquet"
            )
        kind = "npz" if output.suffix == ".npz" else "csv"
    if kind not in list(Format):
        raise LogError(f"--format should be csv, parquet or npz, not '{kind}'")
    pieces = _telling(read_for(_paths(file, series), topic or ()))
    for path in write(pieces, output, Format(kind), topic or ()):
        _print_safely(str(path))


@app.command()
def lerobot(
    files: list[Path],
    *,
    output: Path,
    fps: int = 30,
    episodes: str = "marks",
    task: str = "",
    action: list[str] | None = None,
    observe: list[str] | None = None,
    camera: list[str] | None = None,
) -> None:
    """Make a LeRobot dataset of recordings, to train on.

    Example: rtee log lerobot logs --out datasets/cups

    Arguments and options:
        files (RECORDING…): Recordings of one hand (the newest of a folder), and files with images
            of its cameras.
        output (--out; DATASET): A new folder.
        fps: Frames per second.
        episodes: marks: from a mark 'episode: TASK' to the next, or to 'episode: end'; 'episode:
            discard' throws one away. goals: each goal that succeeded.
        task: The task of all episodes, in words.
        action: Take the intensity of this action as the command, instead of the actuators'
            targets; may be given again.
        observe: Observe this: position joint effort opening force touch taxel; may be given again.
            By default, everything known except taxels.
        camera ([NAME=]TOPIC): Only this camera; may be given again.
    """
    from rtee.log.dataset.convert import Choice, EpisodeBoundary, write_dataset
    from rtee.messages.features import quantities

    if episodes not in list(EpisodeBoundary):
        raise LogError(f"--episodes should be marks or goals, not '{episodes}'")
    chosen = quantities(observe or ())
    actions, cameras = tuple(action or ()), tuple(camera or ())
    choice = Choice(fps, EpisodeBoundary(episodes), task, actions, chosen, cameras)
    made = write_dataset(files, output, choice)
    for note in made.notes:
        _print_safely(f"note: {note}")
    for name, names in made.names.items():
        _print_safely(f"{name}: {', '.join(names)}")
    count = f"{made.episodes} episode{'s' * (made.episodes != 1)}"
    _print_safely(f"{output}: {count}, {made.frames} frames, {made.frames / fps:.1f} s")


@app.command()
def replay(
    file: File,
    *,
    series: Series = False,
    checking: bool = False,
    speed: float = 1.0,
    repeat: bool = False,
    gui: bool = False,
    as_json: JsonOption = False,
) -> None:
    """Show a recording to the GUI and all clients, or check that it is reproduced exactly.

    Arguments and options:
        series: With --check: use all parts of the recording that FILE belongs to.
        checking (--check): Compute the references again and compare them bit for bit.
        speed (0.01..1000.0): Without --check: how fast time passes in it.
        repeat: Without --check: begin again at the end.
        gui: Without --check: open the hand in the browser.
        as_json (--json): With --check: print one JSON object.
    """
    paths = _paths(file, series)
    if checking:
        from rtee.log.check import TOPICS, check
        from rtee.log.reader import windows

        _show_check(check(_telling(windows(paths, only=TOPICS))), as_json)
        return
    raise typer.Exit(_run_recording(paths[0], speed=speed, repeat=repeat, gui=gui))


def _telling(pieces: Iterable[Recording]) -> Iterator[Recording]:
    """Yield pieces of a recording, and print their notes."""
    told: set[str] = set()
    for piece in pieces:
        # Two recordings count as the same by what could be read of them; the notes name the rest.
        for note in piece.notes:
            if note not in told:
                print(f"note: {foreign(note)}", file=sys.stderr)
        told.update(piece.notes)
        yield piece


def _run_recording(path: Path, *, speed: float, repeat: bool, gui: bool) -> int:
    """Run the hand of a recording on its recorded states until Ctrl-C.

    The hand is the configured one of that name if it has the same actuators, otherwise the one that
    the recording itself describes. A recording that was never closed is repaired in a copy first.
    """
    import anyio

    from rtee.log.brief import actuators_of
    from rtee.log.playback import write_hand
    from rtee.log.reader import read
    from rtee.log.recover import recover as repair
    from rtee.loop.shutdown_signals import beside_this_run
    from rtee.messages.topics import ROBOT_DESCRIPTION
    from rtee.running.run import RunOptions, run_hands

    # Read only enough to find the hand; the driver reads the rest.
    recording = read(path, only=[ROBOT_DESCRIPTION])
    with temporary_folder(path) as folder:
        if not recording.finished:
            path = repair(path, folder / path.name).path
        hand = recording.hand
        if not _configured(hand, actuators_of(recording.metadata)):
            hand = str(write_hand(recording, folder))
        options = RunOptions(
            driver="replay",
            driver_options={"file": str(path.absolute()), "speed": speed, "repeat": repeat},
            rate=recording.rate or None,
            record=False,  # it would be a recording of a recording
            companions=(beside_this_run("gui"),) if gui else (),
        )

        async def main() -> int:
            return await run_hands([hand], options, say=lambda line: print(line, flush=True))

        return anyio.run(main)


def _configured(name: str, actuators: list[str]) -> bool:
    """Return whether there is a configured hand of this name with these actuators."""
    from rtee.hand.load import load_hand

    try:
        # Look up by name only, so that a recording cannot point to a folder on this computer.
        find_hand(name)
        return sorted(load_hand(name).actuator_names) == sorted(actuators)
    except UserError:
        return False


def _show_check(comparison: ReplayCheck, as_json: bool) -> None:
    if as_json:
        print(to_json(asdict(comparison) | {"same": comparison.same}, indent=2))
    elif comparison.same:
        print(
            f"the same, bit for bit: {comparison.ticks} ticks, {comparison.goals} goals, "
            f"{comparison.values} numbers"
        )
    else:
        for sentence in comparison.damage:
            _print_safely(f"the recording is not as it was written: {sentence}")
        share = f"{comparison.different} of {comparison.values} numbers"
        print(f"{share} differ, by at most {comparison.largest:g}")
        if comparison.first is not None:
            first = comparison.first
            print(
                f"first at tick {first.tick} ({first.t:.3f} s), {first.quantity} of "
                f"'{first.actuator}': recorded {first.recorded!r}, computed {first.computed!r}"
            )
        if comparison.note:
            print(comparison.note)
        if not comparison.results:
            print("the goals did not end as recorded")
        if comparison.missing:
            print(f"{comparison.missing} ticks are not in the recording: missed, or dropped")
    if not comparison.same:
        # For scripts, a difference is a failure.
        raise typer.Exit(1)


@app.command()
def unpack(
    file: File,
    folder: Path,
) -> None:
    """Write the hand of a recording with its meshes: for RViz, or to run it.

    Arguments and options:
        folder (FOLDER): Where the hand's folder is made.
    """
    from rtee.hand.names import check_name
    from rtee.log.playback import write_hand
    from rtee.log.reader import read
    from rtee.messages.topics import ROBOT_DESCRIPTION

    recording = read(_paths(file, False), only=[ROBOT_DESCRIPTION])
    if recording.hand:
        # Checked before it becomes a path: the system refuses some names with an error of its own.
        home = folder / check_name(recording.hand, "hand", path=recording.paths[0])
        if home.exists():
            raise LogError("exists already; give another folder", path=home)
    _print_safely(str(write_hand(recording, folder)))


@app.command()
def recover(
    files: list[Path],
    *,
    output: Path | None = None,
    in_place: bool = False,
) -> None:
    """Repair recordings whose program was killed, or that are damaged, into new files.

    Arguments and options:
        files (FILE…): Recordings, or folders: their newest recordings.
        output (--out; PATH): The repaired file; NAME_recovered.mcap unless given.
        in_place: Without --out: replace the damaged file.
    """
    from rtee.log.recover import recover as repair

    paths = [path for file in files for path in _paths(file, False)]
    if output is not None and len(paths) > 1:
        raise LogError("--out needs exactly one file")
    for file in paths:
        recovery = repair(file, output, in_place=in_place)
        verb = (
            "recovered" if not recovery.untouched else "holds" if recovery.damage else "is whole,"
        )
        text = f"{recovery.path}: {verb} {recovery.messages} messages, {recovery.seconds:.1f} s"
        if recovery.damaged:
            chunks = "chunk" if recovery.damaged == 1 else "chunks"
            text += f"; {recovery.damaged} damaged {chunks} left out"
        if recovery.lost_bytes:
            text += f"; {recovery.lost_bytes} bytes at the end were unusable"
        for sentence in recovery.left_out:
            text += f"; {sentence}"
        if recovery.damage:
            text += f"; not to be repaired: {', '.join(recovery.damage)}"
        _print_safely(text)
