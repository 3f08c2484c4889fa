"""Shared parts of commands with sweeps: workers, progress, results of an aborted sweep."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rtee import monotonic
from rtee.child import processors
from rtee.errors import ConfigError, WorkerLost, needing_extra

if TYPE_CHECKING:
    from rtee.trials.sweep import Sweep, Workers
    from rtee.trials.work import Answer, Task

_EVERY: Final = 60.0
"""Interval of progress messages without a terminal [s]."""

JobsOption = Annotated[
    int, typer.Option("--jobs", "-j", min=0, help="Processes; 0: one per processor.")
]

ClusterOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="A sweep on the Dask cluster with this scheduler."),
]


def resolved(hand: str) -> str:
    """Return a hand's name, or the absolute path of its folder for other processes."""
    return str(Path(hand).resolve()) if os.sep in hand else hand  # a bare name is looked up


def tell_of_meshes(objects: Iterable[str]) -> None:
    """Print the assumptions about meshes on stderr."""
    from rtee.objects.shape import is_shape

    meshes = [text for text in dict.fromkeys(objects) if not is_shape(text)]
    if not meshes:
        return
    with needing_extra("a trial", "sim"):
        from rtee.drivers.mujoco.objects import MESHES
        from rtee.objects.shape import parse_object
        from rtee.planning.objects import read_object
    for text in meshes:
        # Checked against the simulation's formats; the planner reads more.
        parse_object(text, MESHES)
        for note in read_object(text).notes:
            print(f"note: {text}: {note}", file=sys.stderr)


def tell_of_limits(hands: Iterable[str]) -> None:
    """Print on stderr which effort limits of hands the simulation assumes."""
    with needing_extra("a trial", "sim"):
        from rtee.drivers.mujoco.servos import effort_note
        from rtee.trials.bench import bench
    for name in hands:
        hand = bench(name).hand
        for note in effort_note(hand):
            print(f"note: {hand.name}: {note}", file=sys.stderr)


def workers_for(
    hands: Iterable[str], objects: Iterable[str], jobs: int, cluster: str | None, count: int
) -> Workers:
    """Return the workers of a cluster, or processes, no more than tasks at once."""
    from rtee.hand.load import hand_folder
    from rtee.trials.cluster import Cluster
    from rtee.trials.sweep import Local

    if cluster:
        folders = {hand: hand_folder(hand)[0] for hand in hands}
        return Cluster(
            cluster, folders, objects, lambda text: print(f"rtee: {text}", file=sys.stderr)
        )
    return Local(min(jobs or processors(), count))


def _tell(text: str) -> None:
    print(f"rtee: {text}", file=sys.stderr, flush=True)


def meshes_in(objects: Iterable[str], formats: Iterable[str]) -> list[str]:
    """Return objects as given, and instead of a folder the meshes in it, sorted by name.

    Other files in it are named on stderr.

    Raises:
        ConfigError: if a folder has none, or there is no such folder.
    """
    from rtee.objects.shape import SHAPES, is_shape

    found: list[str] = []
    for text in objects:
        # An empty text would be this folder.
        if not text or not Path(text).is_dir():
            if not (Path(text).suffix or is_shape(text)):
                raise ConfigError(
                    f"'{text}' is not an object, nor a folder of meshes; write {SHAPES}, or the "
                    f"path of a mesh ({', '.join(formats)}) or of a folder"
                )
            found.append(text)
            continue
        files = sorted(Path(text).iterdir())
        meshes = [p for p in files if p.suffix.lower() in set(formats)]
        known = ", ".join(formats)
        if not meshes:
            raise ConfigError(f"there is no mesh ({known}) in this folder", path=Path(text))
        if others := ", ".join(p.name for p in files if p not in meshes):
            print(
                f"note: {text}: no meshes that are read here ({known}): {others}", file=sys.stderr
            )
        found += map(str, meshes)
    return found


def followed(
    sweep: Sweep, keep: Callable[[], None], words: Callable[[], str]
) -> Iterator[tuple[str, Task, Answer]]:
    """Run a sweep with its progress; after an early end, print which results are kept.

    Args:
        sweep: The sweep.
        keep: Writes the results so far.
        words: A phrase that says what is kept where.
    """
    # Closing ends the processes at once when this is interrupted.
    with _kept(keep, words), closing(sweep.run()) as coming:
        yield from _with_progress(coming, sweep)


@contextmanager
def _kept(keep: Callable[[], None], words: Callable[[], str]) -> Iterator[None]:
    def once(*_: object) -> None:
        # Some programs signal the process and then its group; ignore the second signal.
        for each in before:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    # A service or a time limit ends a long sweep by SIGTERM.
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    for each in before:
        signal.signal(each, once)
    try:
        yield
    except KeyboardInterrupt:
        keep()  # first, since the sentence says that they are kept
        print(f"rtee: interrupted; {words()}", file=sys.stderr)
        raise
    except WorkerLost as error:
        keep()
        raise WorkerLost(f"{error}; {words()}") from error
    finally:
        keep()
        for each, handler in before.items():
            signal.signal(each, handler)


def _with_progress(
    coming: Iterable[tuple[str, Task, Answer]], sweep: Sweep
) -> Iterator[tuple[str, Task, Answer]]:
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        columns = "trying", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            shown = bar.add_task("trying", total=sweep.left)
            for each in coming:
                bar.update(shown, completed=sweep.ended, total=sweep.ended + sweep.left)
                yield each
        return
    began = told = monotonic.now()
    for each in coming:
        now = monotonic.now()
        if now - told >= _EVERY:
            told = now
            left = (now - began) / sweep.ended * sweep.left / 60.0
            done = f"{sweep.ended} of {sweep.ended + sweep.left}"
            _tell(f"{done} done, about {max(left, 1.0):.0f} min left")
        yield each
