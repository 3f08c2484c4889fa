"""The files that make a computer a robot PC: udev rule, limits, service."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

import rtee
from rtee.errors import ConfigError
from rtee.hand.files import make_folder, write_atomically

_PROGRAM: Final = "/opt/rtee/bin/rtee"
"""The program in the service's file, where the documentation installs it."""


def write_files(folder: Path) -> list[Path]:
    """Write the files for a robot PC; the service starts the `rtee` of this environment.

    Args:
        folder: Where to; made if it is not there.

    Returns:
        The files written.

    Raises:
        ConfigError: if this installation has none, or they cannot be written.
    """
    package = Path(rtee.__file__).parent
    # In a wheel they stand beside the code, in a checkout beside the package.
    places = (package / "_deploy", package.parent / "deploy")
    source = next((place for place in places if place.is_dir()), None)
    if source is None:
        raise ConfigError("this installation of rtee holds no files for a robot PC")
    make_folder(folder)
    program = str(Path(sys.executable).parent / "rtee")
    written = []
    for file in sorted(path for path in source.iterdir() if path.is_file()):
        text = file.read_text("utf-8").replace(_PROGRAM, program)
        write_atomically(folder / file.name, text)
        written.append(folder / file.name)
    return written
