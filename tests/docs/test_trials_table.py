"""The pages say what the stored trials do."""

from __future__ import annotations

from dataclasses import replace


def test_the_tables_are_current() -> None:
    from trials_table import pages

    for page, text in pages().items():
        assert page.read_text() == text, f"{page.name}: run: python docs/trials_table.py"


def test_a_table_says_what_was_held_and_what_was_not() -> None:
    from trials_table import Stored, _own

    from rtee.trials.result import Trial, TrialResult

    trial = Trial("Grasp", (), "drill", variations=20)
    some = TrialResult(trial, True, survived=17)
    more = replace(some, trial=replace(trial, action="Trig"), survived=19)
    large = TrialResult(replace(trial, object="sphere:0.05"), False, "too wide", fits=False)
    lost = TrialResult(replace(trial, object="sphere:0.04"), False, "it fell")
    once = TrialResult(replace(trial, object="sphere:0.03", variations=0), True)
    text = _own(Stored("a", (some, more, large, lost, once), 2, outdated=True))
    assert "| `drill` | Trig | 19 | 76 to 99 % | 1 of 2 tried |" in text
    assert "| `sphere:0.05` |  | unfit |  |  |" in text
    assert "| `sphere:0.04` |  | lost |  | 0 of 1 tried |" in text
    assert "| `sphere:0.01` |  | not tried |  |  |" in text
    assert "| `sphere:0.03` |  | held once |  |  |" in text
    assert "4 of 24 pairs" in text
    assert "1 of 1 were held" in text
    assert "**Outdated**" in text
