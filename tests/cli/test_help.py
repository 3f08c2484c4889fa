from __future__ import annotations

import sys
from typing import Any

import pytest
from typer.testing import CliRunner

from rtee.cli.main import COMMANDS, cli


def helped(command: Any, path: tuple[str, ...]) -> list[tuple[tuple[str, ...], list[str]]]:
    """Return a command's words and the help of its parameters, and those of the commands in it."""
    texts = [text for p in command.params if (text := getattr(p, "help", None))]
    found = [(path, texts)]
    for name, inner in getattr(command, "commands", {}).items():
        found += helped(inner, (*path, name))
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_shown_to_the_letter_units_included(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import typer

    monkeypatch.setattr(sys, "argv", ["rtee", name])
    monkeypatch.setenv("COLUMNS", "400")
    command = typer.main.get_command(cli).get_command(None, name)  # type: ignore[attr-defined]
    for path, texts in helped(command, (name,)):
        shown = CliRunner().invoke(cli, [*path, "--help"])
        assert shown.exit_code == 0
        for text in texts:
            assert text in shown.output, f"{path}: {text}"
