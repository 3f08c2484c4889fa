"""Write the skeleton of a driver package that passes the contract suite."""

from __future__ import annotations

import keyword
import sys
from importlib.resources import files
from pathlib import Path

from rtee.drivers.registry import driver_names
from rtee.errors import ConfigError
from rtee.hand.files import make_folder, write_atomically

_FILES = {
    "pyproject.toml": "pyproject.toml",
    "README.md": "README.md",
    "__init__.py": "{name}/__init__.py",
    "codec.py": "{name}/codec.py",
    "driver.py": "{name}/driver.py",
    "emulator.py": "{name}/emulator.py",
    "test_contract.py": "tests/test_contract.py",
    "test_codec.py": "tests/test_codec.py",
}


def write_package(name: str, parent: Path) -> list[Path]:
    """Write the skeleton of a driver package.

    Args:
        name: Name of the package and of the driver, in lower case: ``my_gripper``.
        parent: Folder in which the package's folder is made.

    Returns:
        The files written.

    Raises:
        ConfigError: if the name cannot be one, is taken, or the folder is not empty.
    """
    if not (name.isidentifier() and name.isascii() and name == name.lower()):
        raise ConfigError(
            f"'{name}' cannot be a driver's name: give letters in lower case, digits and _, and "
            "no digit first"
        )
    if keyword.iskeyword(name) or name in {"rtee", *sys.stdlib_module_names, *driver_names()}:
        raise ConfigError(f"the name '{name}' is taken")
    folder = parent / name
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(f"{folder} is not empty; choose another name or folder")
    title = "".join(part.capitalize() for part in name.split("_") if part)
    written = []
    for source, target in _FILES.items():
        template = files("rtee.testing") / "template" / f"{source}.tmpl"
        text = template.read_text("utf-8").replace("@name@", name).replace("@Class@", title)
        path = folder / target.format(name=name)
        make_folder(path.parent)
        write_atomically(path, text)
        written.append(path)
    return written
