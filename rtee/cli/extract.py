"""`rtee extract`: find the primitive grasping actions of a hand."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtee import monotonic
from rtee.cli._common import (
    AngleOption,
    JsonOption,
    XacroArguments,
    actions_of,
    complete_hand,
    hand_folder,
    owned,
    to_json,
)
from rtee.cli._table import Column, Row, WideOption, on_terminal, prefix_to_drop, table_of
from rtee.cli.new import OutsideOption, RootOption, subtree_of
from rtee.errors import ConfigError, needing_extra
from rtee.hand.config_schema import Outside
from rtee.hand.files import check_writable, write_all
from rtee.hand.own_copy import own_place

if TYPE_CHECKING:
    from collections.abc import Callable

    from rtee.actions.library import ActionLibrary
    from rtee.actions.openings import Openings
    from rtee.actions.types import Primitive
    from rtee.exchange.readable import ReadableModel
    from rtee.extract.extraction import Extraction
    from rtee.extract.report import TrialSummary
    from rtee.hand.model import Hand as HandModel
    from rtee.hand.subtree import Subtree

_BAR_AFTER = 1.0
"""Time after which a progress bar appears [s]; for shorter work it would only flicker."""


class Rank(StrEnum):
    """The criterion by which the postures of a pinch are ranked."""

    DEPTH = "depth"
    OPPOSITION = "opposition"


def extract(
    hand: Annotated[str | None, typer.Argument(autocompletion=complete_hand)] = None,
    arguments: XacroArguments = None,
    *,
    urdf: Path | None = None,
    mjcf: Path | None = None,
    srdf: Path | None = None,
    angle: AngleOption = None,
    root: RootOption = None,
    outside: OutsideOption = Outside.ABSENT,
    package_dir: list[Path] | None = None,
    out: Path | None = None,
    save: bool = False,
    report: Path | None = None,
    wide: WideOption = False,
    as_json: JsonOption = False,
    jobs: int = 0,
    rank: Rank = Rank.DEPTH,
) -> None:
    """Find the primitive grasping actions of a hand.

    Arguments and options:
        hand ([HAND]): Name of a hand, or its folder.
        urdf: A URDF, or a xacro file, instead of a configured hand.
        mjcf: A model in MuJoCo's MJCF instead of a URDF.
        srdf: With --urdf or --mjcf: the model's SRDF; without it the fingers are found.
        package_dir: With --urdf or --mjcf: folder to look packages up in; may be repeated.
        out: Write the primitives to files in this folder.
        save: Write the primitives to the hand's own actions, and their openings.
        report: Write a page with a picture of every action (HTML).
        jobs (0..): Processes to use; 0 means one per processor.
        rank: Which posture of a pinch comes first.
    """
    from rtee.actions.openings import write_openings
    from rtee.exchange.reading import as_urdf_and_srdf
    from rtee.hand.load import load_hand

    # The matrices are small; threads for their products would only slow down the searches.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = arguments or []
    # With a file there is no hand to name: the first argument is already a NAME:=VALUE.
    if hand is not None and ":=" in hand:
        words = [hand, *words]
        hand = None
    if sum(given is not None for given in (hand, urdf, mjcf)) != 1:
        raise ConfigError("give a hand, --urdf or --mjcf, and only one of them")
    subtree = subtree_of(root, outside)
    folder = hand_folder(hand) if hand is not None else None
    # Refuse all mistakes before the search, which may take minutes.
    if save and folder is None:
        raise ConfigError("--save needs a configured hand; for a file, give --out")

    home = own_place(folder) if save and folder else None
    targets = [*([out] if out else []), *([home / "actions"] if home else [])]
    for target in targets:
        check_writable(target, folder=True)
    # A target was checked above and will exist before the report is written.
    if report is not None and report.parent not in targets:
        check_writable(report)
    # A URDF made from a xacro file or an MJCF exists only within this block.
    with ExitStack() as stack:
        with _uncollected():
            with needing_extra("the extraction", "extract"):
                from rtee.extract.extraction import extract as run
            if folder is not None:
                model = load_hand(folder)
            else:
                models = as_urdf_and_srdf(urdf, mjcf, srdf, words, package_dir or [], root, angle)
                model = _hand_in(*stack.enter_context(models), subtree)
            with progress_bar() as progress:
                extraction = run(model, jobs=jobs, rank=rank.value, progress=progress)
        page = {} if report is None else {report: _report(model, extraction, folder, jobs)}
    if home is not None and folder is not None:
        # Copied only now, so that a search that fails leaves no copy behind.
        owned(folder)
    _write(targets, page, model, extraction)
    stored = []
    if home is not None:
        # Read from the stored files, since the hand's other actions have openings, too.
        stored.append(write_openings(home, measured_openings(home)))
    if as_json:
        from rtee.actions.describe import describe

        print(to_json(describe(model, extraction.primitives, extraction.seconds), indent=2))
    else:
        _show(model, extraction)
    notes = [f"note: {note}" for note in (*model.notes, *extraction.notes)]
    written = [*targets, *stored, *([report] if report else [])]
    notes += [f"written to {target}" for target in written]
    for note in notes:
        # In a pipe, the output holds the table or the JSON and nothing else.
        print(note, file=sys.stdout if sys.stdout.isatty() and not as_json else sys.stderr)


def _write(
    targets: list[Path], files: dict[Path, str], hand: HandModel, extraction: Extraction
) -> None:
    """Write the primitives to each folder, and other files by path: everything or nothing."""
    if not (targets or files):
        return
    from rtee.actions.action_files import primitive_changes

    changes = [primitive_changes(target, hand, extraction.primitives) for target in targets]
    for change in changes:
        files |= change.files
    folders = [folder for change in changes for folder in change.folders]
    write_all(files, folders=folders, gone=[path for c in changes for path in c.gone])


def _report(hand: HandModel, extraction: Extraction, folder: Path | None, jobs: int) -> str:
    from rtee.actions.library import ActionLibrary
    from rtee.extract.report import make_report

    custom = ActionLibrary.load(hand, folder / "actions") if folder is not None else None
    tried, notes = _tried(folder, custom)
    extraction = replace(extraction, notes=(*extraction.notes, *notes))
    with progress_bar("taking pictures") as progress:
        return make_report(hand, extraction, custom, trials=tried, jobs=jobs, progress=progress)


def _tried(
    folder: Path | None, library: ActionLibrary | None
) -> tuple[list[TrialSummary], list[str]]:
    """Return the results of `rtee try --all` for the report, and notes about them."""
    from rtee.actions.fingerprints import Fingerprints
    from rtee.extract.report import TrialSummary
    from rtee.trials.store import FILE_NAME, read_results

    if folder is None or library is None:
        return [], []  # the trials of a model without a folder are stored nowhere
    results, notes = read_results(folder / FILE_NAME), []
    # Outdated results are still shown, with a note.
    old = len(results) - len(read_results(folder / FILE_NAME, Fingerprints.of(folder, library)))
    if old:
        which = "the trials" if old == len(results) else f"{old} of {len(results)} trials"
        notes.append(
            f"{which} in {FILE_NAME} are outdated, made with other files of this hand or by an"
            f" earlier method; `rtee try {folder.name} --all` repeats them"
        )
    tried = [
        TrialSummary(
            result.trial.what,
            result.trial.object,
            result.held,
            f"slip {result.slip * 1e3:.1f} mm" if result.held else result.reason,
        )
        for result in results.values()
    ]
    return tried, notes


def _hand_in(model: ReadableModel, srdf: Path | None, subtree: Subtree | None) -> HandModel:
    """Load a hand from its model as `rtee new` would make it, with what the URDF leaves out."""
    from rtee.hand.load import load_model
    from rtee.hand.scaffold import settle
    from rtee.hand.urdfread import read_urdf

    edits = [] if subtree is None else [subtree]
    known = read_urdf(model.urdf, edits)
    load = partial(
        load_model,
        model.urdf,
        srdf,
        package_dirs=model.package_dirs,
        passive=[joint for joint in model.passive or () if joint in known.joints],
    )
    settled = settle(
        load, edits, searched=srdf is None, motors_known=model.passive is not None, ask=None
    )
    hand = settled.hand
    excluded = (pair for pair in model.excluded if {*pair[:2]} <= known.links.keys())
    return replace(
        hand,
        notes=(*model.notes, *settled.notes),
        disabled_collisions=(*hand.disabled_collisions, *excluded),
    )


@contextmanager
def _uncollected() -> Iterator[None]:
    """Suspend garbage collection: imports and searches create hardly any cycles to collect."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def progress_bar(what: str = "searching pinches") -> Iterator[Callable[[int, int], None] | None]:
    """Yield a function ``show(done, total)`` for progress; ``None`` if stderr is not a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    begun = monotonic.now()
    bar: Any = None
    task: Any = None

    def show(done: int, total: int) -> None:
        nonlocal bar, task
        if bar is None and monotonic.now() - begun > _BAR_AFTER:
            from rich.console import Console
            from rich.progress import Progress

            bar = Progress(console=Console(stderr=True), transient=True)
            bar.start()
            task = bar.add_task(what, total=total)
        if bar is not None:
            bar.update(task, completed=done, total=total)

    try:
        yield show
    finally:
        if bar is not None:
            bar.stop()


def measured_openings(folder: Path) -> Openings:
    """Return the openings of the actions in a hand's folder, computed from its model.

    Raises `MissingExtra` without the extra ``extract``, and `ModelError` if a mesh is missing or
    cannot be read.
    """
    with needing_extra("making openings", "extract"):
        from rtee.extract.openings import make_openings

    # Load by path, since the name may match another folder first.
    library = actions_of(str(folder))
    with progress_bar("measuring openings") as progress:
        return make_openings(library.hand, library, progress)


def _show(hand: HandModel, extraction: Extraction) -> None:
    prefix = prefix_to_drop(hand.actuator_names)
    title = f"Primitive grasping actions of {hand.name}, found in {extraction.seconds:.2f} s"
    if prefix:
        title += f"\n(names of actuators begin with {prefix})"
    width = max(len(name.removeprefix(prefix)) for name in hand.actuator_names)
    columns = ("elements", Column("posture", whole=True), "evidence")
    rows = []
    for primitive in extraction.primitives:
        colliding = bool(primitive.evidence) and not primitive.evidence[0].clear
        rows.append(Row(_cells(hand, primitive, prefix, width), primitive.name, faint=colliding))
    table_of(columns, rows, title, "primitive").show()


def _cells(hand: HandModel, primitive: Primitive, prefix: str, width: int) -> tuple[str, str, str]:
    from rtee.actions.describe import abduction_sentence
    from rtee.cli.actions import primitive_remarks

    posture = primitive.posture
    elements = ", ".join(element.removeprefix(prefix) for element in primitive.elements)
    if on_terminal():
        lines = [
            f"{name.removeprefix(prefix):{width}} {posture.position[name]:7.4f}"
            for name in posture.involved
        ]
    else:
        lines = [f"{name}={posture.position[name]:.6g}" for name in posture.involved]
    evidence = abduction_sentence(hand, primitive, prefix)
    if primitive.evidence:
        evidence = primitive_remarks(primitive, prefix)
    return elements, "\n".join(lines), evidence
