"""`rtee grasp-plan`: rank the actions for an object, with intensity and pose of the object."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import typer

from rtee.cli._common import Hand, JsonOption, actions_of, hand_folder, to_json
from rtee.cli._sweep import meshes_in
from rtee.cli._table import Column, table_of
from rtee.cli.define import Replace
from rtee.errors import ConfigError, UserError, needing_extra
from rtee.objects.shape import parse_table

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.planning.objects import GraspObject
    from rtee.planning.result import Matrix, Ranking

_CHECKED = 3
"""Number of the best grasps that --check tries in dynamics: each takes seconds."""


def grasp_plan(
    hand: Hand,
    *,
    object_: list[str],
    mass: float = 0.1,
    friction: float = 0.5,
    weight_axis: str | None = None,
    table: str | None = None,
    scale: float = 1.0,
    top: int = 5,
    check: bool = False,
    save: str | None = None,
    replace: Replace = False,
    json_: JsonOption = False,
) -> None:
    """Rank a hand's actions for an object, or for each of several, and say why.

    Exit status 1 when no action can hold one of them, or the first choice can't carry it.

    Example: rtee grasp-plan schunk_svh --object cylinder:0.03x0.12 --check

    Arguments and options:
        object_ (SHAPE|MESH|FOLDER): box:WxDxH, cylinder:RxH, sphere:R, capsule:RxL [m], drill, a
            mesh file, or a folder of them; may be repeated.
        mass: Mass of the object [kg].
        friction: Coefficient of friction.
        weight_axis (X,Y,Z): Where the weight pulls, in the hand's base frame; along its reach
            unless given.
        table (gravity|X,Y,Z[,HEIGHT]): The object stands on a table, of which the hand keeps clear:
            across the weight, or with this upward normal in the object's frame (0,0,1: as it is
            modelled).
        scale: Brings a mesh to metres, such as 0.001.
        top (1..): How many grasps are shown.
        check: Try the best ones in simulation, and more until one holds (extra sim).
        save (NAME): Store the first choice as an action of the hand.
        replace: With --save: replace an action of the same name; it keeps its description.
    """
    with needing_extra("planning a grasp", "extract"):
        from rtee.hand.meshes import FORMATS
        from rtee.planning.objects import read_object
        from rtee.planning.plan import plan_grasps
    from rtee.actions.build import check_custom_name
    from rtee.planning.result import to_document

    # Mistakes in the options are found before the planning, which may take seconds.
    axis = None if weight_axis is None else _axis(weight_axis)
    stands = None if table is None else parse_table(table)
    if save is not None:
        check_custom_name(save)
    library = actions_of(hand)
    objects = meshes_in(object_, FORMATS)
    several = len(objects) > 1
    if several and save is not None:
        raise ConfigError("--save takes one object only")
    documents: list[dict[str, object]] = []
    held = True
    for text in objects:
        try:
            target = read_object(text, mass, scale)
            ranking = plan_grasps(
                library.hand, library, target, friction=friction, weight_axis=axis, table=stands
            )
            if check:
                ranking = _checked(hand, library, target, ranking)
        except UserError as error:
            documents.append({"hand": library.hand.name, "object": text, "error": str(error)})
            if json_ and not several:
                print(to_json(documents[0], indent=2))
            if not several:
                raise
            held = False
            if not json_:
                print(f"{text}: {error}")
            continue
        # All plans were ranked: `--top` only shortens what is printed.
        document = to_document(ranking)
        documents.append({**document, "plans": document["plans"][:top]})
        if not json_:
            if several:
                print(f"{text}:")
            _show(ranking, top)
        # A grasp that lost the object in dynamics, or can't carry it, is not stored.
        first = ranking.plans[0] if ranking.plans else None
        held &= first is not None and (first.check.held if first.check else first.carries)
    if json_:
        print(to_json(documents if several else documents[0], indent=2))
    if not held:
        raise typer.Exit(1)
    if save is not None:
        _save(library, save, ranking, replace, json_)


def _axis(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        raise ConfigError(
            f"the weight axis must be three numbers X,Y,Z, not all of them 0, not '{text}'"
        )
    return values


def _checked(name: str, library: ActionLibrary, target: GraspObject, ranking: Ranking) -> Ranking:
    """Return the ranking with the best grasps tried in dynamics."""
    from rtee.hand.load import load_configured
    from rtee.loop.settings import loop_settings

    with needing_extra("trying grasps in simulation", "sim"):
        from rtee.trials.bench import RATE, TrialBench
        from rtee.trials.planned import checked
    folder = hand_folder(name)
    settings = loop_settings(load_configured(folder)[1], rate=RATE)
    ready = TrialBench(library.hand, library, settings, folder)
    return checked(ready, target, ranking, _CHECKED)


def _show(ranking: Ranking, top: int) -> None:
    numbers = ("score", "intensity", "pre-shape", "effort", "force", "load", "quality")
    rows = [
        (
            plan.label,
            f"{plan.score:.2f}",
            f"{plan.intensity:.0%}",
            f"{plan.preshape:.0%}",
            f"{plan.effort:.0%}",
            "" if plan.force is None else f"{plan.force:.3g} N",
            f"{plan.load:.1f}",
            f"{plan.quality:.3f}",
            "" if plan.check is None else "held" if plan.check.held else "lost",
        )
        for plan in ranking.plans[:top]
    ]
    for note in ranking.notes:
        print(f"note: {note}")
    if not rows:
        print(f"no action of {ranking.hand} can hold {ranking.object}:")
        for name, why in ranking.rejected:
            print(f"  {name}: {why}")
        return
    columns: tuple[str | Column, ...] = (
        "action",
        *(Column(name, right=True) for name in numbers),
        "dynamics",
    )
    table_of(columns, rows).show()
    first = ranking.plans[0]
    print(f"\n{first.label}: " + "; ".join(first.reasons))
    print(f"the object in the hand's base frame: {_words(first.pose)}")
    if first.flange_pose is not None and first.pre_flange_pose is not None:
        at, before = _words(first.flange_pose), _words(first.pre_flange_pose)
        print(f"the flange '{ranking.flange}' in the object's frame: {at}; it comes from {before}")
    if first.overhang:
        print(
            f"it must overhang the table's edge by {first.overhang * 1e3:.0f} mm; the edge "
            f"runs along y of: {_words(first.table or first.pose)}, in the object's frame"
        )
    if not (first.check or first.carries):
        print(f"{ranking.object} weighs {ranking.mass:g} kg, too much for its best grasp")
    elif first.force is not None:
        asked = f"--width {first.width * 1e3:.3g}mm --force {first.force:.3g}N"
        words = " ".join((asked, "--action", first.action, *first.elements))
        print(f"to do it: rtee grasp {words}")
    elif first.action:
        words = " ".join((first.action, *first.elements))
        effort = f" --effort {first.effort:.0%}" if first.effort < 1.0 else ""
        print(f"to do it: rtee do {words} --intensity {first.intensity:g}{effort}")
    else:
        print("composed for this object; --save NAME stores it as an action of the hand")


def _words(pose: Matrix) -> str:
    """Return a pose in words: position [mm], roll, pitch and yaw [°]."""
    import numpy as np

    from rtee.hand.frames import angles

    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = pose
    turn = np.array([[a, b, c], [d, e, f], [g, h, i]])
    roll, pitch, yaw = (math.degrees(angle) for angle in angles(turn))
    return (
        f"x {x * 1e3:z.0f} mm, y {y * 1e3:z.0f} mm, z {z * 1e3:z.0f} mm; "
        f"roll {roll:z.0f}°, pitch {pitch:z.0f}°, yaw {yaw:z.0f}°"
    )


def _save(library: ActionLibrary, name: str, ranking: Ranking, replace: bool, quiet: bool) -> None:
    import contextlib
    import sys

    from rtee.cli.define import store
    from rtee.planning.composition import action_of

    plan = ranking.plans[0]
    action = action_of(library, name, plan, f"Planned for {ranking.object}: {plan.label}.")
    # With --json, stdout holds one object and nothing else.
    with contextlib.redirect_stdout(sys.stderr) if quiet else contextlib.nullcontext():
        store(library, action, replace)
