"""Choice of the elements of a primitive among the existing combinations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import viser

Combination = tuple[str, ...]


def options_at(combinations: Sequence[Combination], chosen: Sequence[str]) -> tuple[str, ...]:
    """Return the elements that can follow the chosen ones, in the order of the combinations."""
    taken = set(chosen)
    fitting = (combination for combination in combinations if taken.issubset(combination))
    # A dictionary drops duplicates and, unlike a set, keeps the order.
    return tuple({e: None for combination in fitting for e in combination if e not in taken})


class ElementChoice:
    """One dropdown per element; each offers only elements that fit those before it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        combinations: Sequence[Combination],
        changed: Callable[[], None],
        noun: str,
    ) -> None:
        """Add the dropdowns to the current container.

        There is at least one combination, and all have the same length. ``changed`` is called when
        the choice has changed; the noun of an element is ``Finger`` or ``Actuator``.
        """
        self.combinations = tuple(combinations)
        self._changed = changed
        self._boxes: list[viser.GuiDropdownHandle[str]] = []
        count = len(self.combinations[0])
        chosen: list[str] = []
        for index in range(count):
            offered = options_at(self.combinations, chosen)
            label = noun if count == 1 else f"{noun} {index + 1}"
            box = gui.add_dropdown(
                label,
                offered,
                initial_value=offered[0],
                hint=f"{noun} the action is done with; only what exists together is offered",
                disabled=len(offered) == 1 and count == 1,
                order=index / 100.0,
            )
            box.on_update(lambda _, at=index: self._restrict(at))
            self._boxes.append(box)
            chosen.append(offered[0])

    @property
    def chosen(self) -> Combination:
        """The chosen combination, in the order of the action's file."""
        # As sets, since the dropdowns offer the elements of a combination in any order.
        values = {str(box.value) for box in self._boxes}
        for combination in self.combinations:
            if set(combination) == values:
                return combination
        return self.combinations[0]

    def _restrict(self, index: int) -> None:
        chosen = [str(box.value) for box in self._boxes[: index + 1]]
        for box in self._boxes[index + 1 :]:
            offered = options_at(self.combinations, chosen)
            wanted = str(box.value) if box.value in offered else offered[0]
            # Each assignment calls back, so assign only changes.
            if tuple(box.options) != offered:
                box.options = offered
            if box.value != wanted:
                box.value = wanted
            chosen.append(wanted)
        self._changed()
