"""`rtee new-driver`: write the skeleton of a driver package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def new_driver(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Such as my_gripper.")],
    folder: Annotated[
        Path, typer.Option("--in", metavar="DIR", help="Where the package's folder is made.")
    ] = Path(),
) -> None:
    """Write a driver package: codec, driver, emulator, and tests that it passes."""
    from rtee.testing.scaffold import write_package

    for path in write_package(name, folder):
        print(path)
    print(f"now: cd {folder / name} && pip install -e '.[test]' && pytest")
