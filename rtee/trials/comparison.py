"""Compare hands for parts: the planner proposes actions for each, and trials judge them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rtee.render.page import load_template
from rtee.trials.result import Trial, TrialResult
from rtee.trials.sweep import Sweep
from rtee.trials.variation import interval, interval_text
from rtee.trials.work import Answer, Picture, Planned, Planning, Portrait, Task, object_of

_MOST: Final = 3
"""Number of actions tried on an object by each hand: the planner's first choices."""

_ONCE, _VARIED, _PICTURED = 10, 20, 30
"""Ranks of the tasks after planning: every cell gets a first answer before any gets its rate."""


@dataclass
class Cell:
    """Knowledge about a hand with an object.

    Attributes:
        hand: The hand, as tasks call it.
        object: The object, as on the command line.
        best: The result with the best rate so far.
        why: Why the object is not held, or not always.
        picture: The best grasp as a PNG file in base64.
        done: Whether no further action is tried.
        actions: Names and elements of the actions that are still to be tried.
    """

    hand: str
    object: str
    best: TrialResult | None = None
    why: str = ""
    picture: str = ""
    done: bool = False
    actions: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Share of the variations in which the object is held, 0 to 1."""
        return self.best.survived / self.best.tries if self.best and self.best.tries else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the rate."""
        return interval(self.best.survived, self.best.tries) if self.best else (0.0, 0.0)

    @property
    def rated(self) -> str:
        """The rate of the best result in words; empty if nothing was held."""
        if self.best is None:
            return ""
        if not self.best.tries:
            return "held once, not varied"
        survived, tries = self.best.survived, self.best.tries
        return f"{survived} of {tries} ({interval_text(survived, tries)})"

    @property
    def missing(self) -> str:
        """Reason why the object is not held, or not yet; empty if it is."""
        if self.why or self.best:
            return self.why
        return "no action of the planner" if self.done else "not tried yet"

    @property
    def force(self) -> float:
        """The largest force on a finger after the grasp [N]."""
        return max((force for _, force in self.best.forces), default=0.0) if self.best else 0.0


class Comparison:
    """A comparison of hands by objects: its tasks go to a sweep, whose answers come back to it.

    Attributes:
        hands: The hands, as tasks call them.
        objects: The objects, as on the command line.
        cells: The cells, by hand and object.
    """

    def __init__(
        self, hands: Sequence[str], objects: Sequence[str], like: Trial, *, pictures: bool
    ) -> None:
        """Start without answers.

        Args:
            hands: The hands, by name or folder.
            objects: The objects, as on the command line.
            like: A trial with the mass, the variations and the rate that are wanted.
            pictures: Make a picture of each cell's best grasp.
        """
        self.hands, self.objects = tuple(hands), tuple(objects)
        self.cells = {(h, o): Cell(h, o) for o in objects for h in hands}
        self._like, self._pictures = like, pictures

    def begin(self, sweep: Sweep) -> None:
        """Ask the planner about every cell."""
        for cell in self.cells.values():
            sweep.add(cell.hand, Planning(cell.object, self._like.mass))

    def take(self, sweep: Sweep, hand: str, task: Task, answer: Answer) -> None:
        """Record an answer, and submit the tasks that follow from it."""
        cell = self.cells[hand, object_of(task)]
        match answer:
            case Picture():
                cell.picture = answer.png
            case Planned():
                plans = answer.ranking.plans if answer.ranking else ()
                cell.actions = [(p.action, p.elements) for p in plans if p.action][:_MOST]
                rejected = answer.ranking.rejected[:1] if answer.ranking else ()
                cell.why = answer.refused or "; ".join(why for _, why in rejected)
                self._next(sweep, cell)
            case TrialResult(trial=trial) if answer.held and not trial.variations:
                varied = Trial(
                    trial.action,
                    trial.elements,
                    trial.object,
                    mass=trial.mass,
                    variations=self._like.variations,
                    seed=self._like.seed,
                    wanted=self._like.wanted,
                )
                sweep.add(hand, varied, _VARIED)
                # A first answer, until the variations are done.
                if cell.best is None:
                    cell.best = answer
            case TrialResult():
                rate = answer.survived / answer.tries if answer.tries else 0.0
                if answer.held and (not cell.best or not cell.best.tries or rate > cell.rate):
                    cell.best = answer
                if not answer.held:
                    cell.why = f"{answer.trial.what}: {answer.reason}"
                if self.holds(cell):
                    self._end(sweep, cell)
                else:
                    self._next(sweep, cell)

    def _next(self, sweep: Sweep, cell: Cell) -> None:
        """Try the next action once, without variation."""
        if not cell.actions:
            self._end(sweep, cell)
            return
        action, elements = cell.actions.pop(0)
        sweep.add(cell.hand, Trial(action, elements, cell.object, mass=self._like.mass), _ONCE)

    def _end(self, sweep: Sweep, cell: Cell) -> None:
        cell.done = True
        best = cell.best
        if best is None:
            return
        if self.holds(cell):
            cell.why = ""
        elif best.tries:  # without tries, keep the reason given
            cell.why = f"held in {best.survived} of {best.tries} variations"
        if self._pictures:
            trial = best.trial
            once = Trial(trial.action, trial.elements, trial.object, mass=trial.mass)
            sweep.add(cell.hand, Portrait(once, best.places), _PICTURED)

    def holds(self, cell: Cell) -> bool:
        """Return whether an object is held at the rate that is wanted."""
        return bool(cell.best and cell.best.tries and cell.rate >= (self._like.wanted or 0.0))

    def covering(self) -> tuple[list[tuple[str, ...]], tuple[str, ...]]:
        """Return the hands that hold all objects together, and which objects nobody holds.

        These are the hands that hold all objects alone; otherwise the pairs that do; otherwise the
        pair, or the only hand, that holds most, with the objects that it does not hold.
        """
        held = {
            hand: {o for o in self.objects if self.holds(self.cells[hand, o])}
            for hand in self.hands
        }
        groups = [*itertools.combinations(self.hands, 1), *itertools.combinations(self.hands, 2)]
        for size in (1, 2):
            whole = [
                group
                for group in groups
                if len(group) == size
                and set[str]().union(*(held[h] for h in group)) == set(self.objects)
            ]
            if whole:
                return whole, ()
        # Of groups that hold the same, the smaller one.
        best = max(groups, key=lambda g: (len(set[str]().union(*(held[h] for h in g))), -len(g)))
        together = set[str]().union(*(held[h] for h in best))
        return [best], tuple(o for o in self.objects if o not in together)

    def sentence(self) -> str:
        """Describe which hands are known to hold all objects."""
        said = self._sentence()
        return said if all(cell.done for cell in self.cells.values()) else f"so far: {said}"

    def _sentence(self) -> str:
        groups, missing = self.covering()
        what = " or ".join(" and ".join(name_of(hand) for hand in group) for group in groups)
        if not missing:
            all_ = "it" if len(self.objects) == 1 else f"all {len(self.objects)} objects"
            return f"{what}: {'hold' if len(groups[0]) > 1 else 'holds'} {all_}"
        if len(missing) == len(self.objects):
            return "no hand holds any of the objects"
        rest = ", ".join(name_of(each) for each in missing)
        return f"{what}: most of the objects, but not {rest}"

    def document(self) -> dict[str, Any]:
        """Return it as plain data, ready for JSON."""
        groups, missing = self.covering()
        return {
            "hands": [name_of(hand) for hand in self.hands],
            "objects": list(self.objects),
            "wanted": self._like.wanted,
            "hold_all": [[name_of(hand) for hand in group] for group in groups]
            if not missing
            else [],
            "hold_most": [name_of(hand) for hand in groups[0]],
            "missing": list(missing),
            "cells": [self._plain(cell) for cell in self.cells.values()],
        }

    def _plain(self, cell: Cell) -> dict[str, Any]:
        low, high = cell.interval
        best = cell.best
        return {
            "hand": name_of(cell.hand),
            "object": cell.object,
            "holds": self.holds(cell),
            "action": best.trial.what if best else "",
            "survived": best.survived if best else 0,
            "variations": best.tries if best else 0,
            "interval": [round(low, 3), round(high, 3)],
            "force": cell.force,
            "slip": best.slip if best else 0.0,
            "why": cell.why,
        }

    def page(self) -> str:
        """Return the comparison as a self-contained HTML page.

        Raises:
            MissingExtra: if Jinja is missing.
        """
        template = load_template(
            Path(__file__).with_name("comparison.html.jinja"), "a page of a comparison"
        )
        return template.render(table=self, name=name_of, wanted=self._like.wanted or 0.0)


def name_of(text: str) -> str:
    """Return the short name of a hand or an object: that of its folder or file."""
    return Path(text).name if "/" in text else text
