"""`rtee compare`: which hand holds which parts, and which hand, or which two, hold all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rtee import monotonic
from rtee.cli._common import JsonOption, complete_hand, to_json
from rtee.cli._sweep import (
    ClusterOption,
    JobsOption,
    followed,
    meshes_in,
    resolved,
    tell_of_limits,
    tell_of_meshes,
    workers_for,
)
from rtee.cli._table import table_of
from rtee.errors import needing_extra
from rtee.hand.files import write_atomically

if TYPE_CHECKING:
    from rtee.trials.comparison import Comparison

_EVERY: Final = 30.0
"""How often the page is written while it fills [s]."""


def compare(
    hands: Annotated[list[str], typer.Argument(autocompletion=complete_hand)],
    *,
    objects: list[str],
    mass: float = 0.1,
    variations: int = 20,
    wanted: float = 0.7,
    seed: int = 0,
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
    out: Path = Path("comparison"),
    pictures: bool = True,
    json_: JsonOption = False,
) -> None:
    """Try the best actions of each hand on each part; print which hands hold all parts.

    All results are kept: the same command continues where an interrupted one stopped.

    Exit status 1 when no hand, and no two, hold all parts.

    Example: rtee compare robotiq_2f_85 schunk_svh --objects parts

    Arguments and options:
        hands (HAND…): Names of hands, or folders.
        objects (FOLDER): A folder of meshes in metres, or one object as for rtee try; may be
            repeated.
        mass (0.001..100.0): Mass of each part [kg].
        variations (1..1000): Variations of an action on a part, at most.
        wanted (0.01..0.99; RATE): Share of the variations in which a part has to be held;
            variations end once the interval lies to one side of it.
        seed (0..): Seed of the variations.
        out (FOLDER): Where the page and the results are written.
        pictures (--pictures/--no-pictures): Make a picture of each best grasp.
    """
    with needing_extra("a comparison", "sim"):
        from rtee.drivers.mujoco.objects import MESHES
        from rtee.trials.answers import Answers
        from rtee.trials.bench import bench
        from rtee.trials.comparison import Comparison
        from rtee.trials.result import Trial
        from rtee.trials.sweep import Sweep
    from rtee.objects.shape import parse_object

    names = list(dict.fromkeys(resolved(hand) for hand in hands))
    parts = list(dict.fromkeys(meshes_in(objects, MESHES)))
    # Report every mistake before the first task.
    for name in names:
        bench(name)
    for part in parts:
        parse_object(part, MESHES)
    tell_of_meshes(parts)
    tell_of_limits(names)
    like = Trial("", mass=mass, variations=variations, seed=seed, wanted=wanted)
    found = Comparison(names, parts, like, pictures=pictures)
    known = Answers(out / "results")
    page = out / "index.html"

    def keep() -> None:
        known.write()
        write_atomically(page, found.page())

    if not page.exists():  # so that an unwritable place is reported at once
        keep()
    sweep = Sweep(workers_for(names, parts, jobs, cluster, len(found.cells)), known)
    found.begin(sweep)
    words = f"what was found is kept in {out}; the same command does the rest"
    write_at = monotonic.now() + _EVERY
    for hand, task, answer in followed(sweep, keep, lambda: words):
        found.take(sweep, hand, task, answer)
        if monotonic.now() >= write_at:
            keep()
            write_at = monotonic.now() + _EVERY
    if json_:
        print(to_json({**found.document(), "page": str(page)}, indent=2))
    else:
        _show(found)
        print(f"{found.sentence()}\nthe page: {page}")
    if found.covering()[1]:
        raise typer.Exit(1)


def _show(found: Comparison) -> None:
    from rtee.trials.comparison import name_of

    rows = []
    for part in found.objects:
        cells = [name_of(part)]
        for hand in found.hands:
            cell = found.cells[hand, part]
            if cell.best is None:
                cells.append(cell.missing)
                continue
            cells.append(
                f"{cell.best.trial.what}\n{cell.rated}\n"
                f"{cell.force:.1f} N, slip {cell.best.slip * 1e3:.1f} mm"
            )
        rows.append(cells)
    table_of(["part", *map(name_of, found.hands)], rows).show()
