"""Find the folders of hands, and detect changes of their files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError, suggestion
from rtee.hand.names import check_name

VARIABLE: Final = "RTEE_CONFIG_PATH"
FILE_NAME: Final = "hand.yaml"


def config_dirs(extra: Sequence[Path | str] = ()) -> list[Path]:
    """Return the folders that contain hands, in the order of precedence.

    They are ``extra``, the user's folders (see `own_dirs`), the hands that came with rtee, and
    last the working directory. Raises `ConfigError` if ``extra`` is not a list of paths.
    """
    if isinstance(extra, str | Path) or not isinstance(extra, Iterable):
        raise ConfigError(f"the folders of hands must be a list of paths, not {extra!r:.100}")
    package = Path(__file__).resolve().parents[1]
    candidates = [*(Path(folder) for folder in extra), *own_dirs(), package / "_config"]
    # Only in a checkout: beside an installed package, `config` would be that of another program.
    if (package.parent / "pyproject.toml").is_file():
        candidates.append(package.parent / "config")
    candidates.append(Path())
    found: dict[Path, Path] = {}
    for folder in candidates:
        if os.path.isdir(folder):  # Path.is_dir would raise an error in a folder without access
            # Resolved, since the same folder may occur twice, for example by a link.
            found.setdefault(folder.resolve(), folder)
    return list(found.values())


def own_dirs() -> list[Path]:
    """Return the folders for hands of the user, existing or not, in the order of precedence.

    They are those in ``RTEE_CONFIG_PATH``, ``./config``, and ``rtee/hands`` in the user's
    configuration directory (``XDG_CONFIG_HOME``, otherwise ``~/.config``).
    """
    found = [
        Path(os.path.expanduser(p)) for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p
    ]
    found.append(Path("config"))
    # Without a home directory, `~` is not expanded, and the XDG specification requires that a
    # relative path is ignored; either would be a folder in the working directory.
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config"))
    return [*found, settings / "rtee" / "hands"] if settings.is_absolute() else found


def hands(extra: Sequence[Path | str] = ()) -> dict[str, Path]:
    """Return the folders of all hands by name, sorted by name."""
    found: dict[str, Path] = {}
    for folder in config_dirs(extra):
        for file in folder.glob(f"*/{FILE_NAME}"):
            # The first one is kept, since the folders are in the order of precedence.
            found.setdefault(file.parent.name, file.parent)
    return dict(sorted(found.items()))


def hand_names(extra: Sequence[Path | str] = ()) -> list[str]:
    """Return the names of all hands, sorted."""
    return list(hands(extra))


def find_hand(name: str, extra: Sequence[Path | str] = ()) -> Path:
    """Return the folder of a hand.

    Raises:
        ConfigError: if there is no hand of that name, or the name is not allowed.
    """
    check_name(name, "hand")
    for folder in config_dirs(extra):
        file = folder / name / FILE_NAME
        # Path.is_file would raise an error in a folder without access.
        if os.path.isfile(file):
            return folder / name
        if os.path.lexists(file):
            raise ConfigError("is not a file", path=file)
    raise ConfigError(
        f"unknown hand '{name}'; {suggestion(name, hand_names(extra))} ('rtee hands' lists them, "
        f"'rtee new' makes one)"
    )


def fingerprint(folder: Path) -> str:
    """Return a hash of the hand's model, configuration and actions, as 16 hexadecimal digits.

    It does not depend on meshes.
    """
    return _digest(folder, [*_model(folder), *(folder / "actions").rglob("*.yaml")])


def model_fingerprint(folder: Path) -> str:
    """Return the fingerprint of the model and the configuration, without actions."""
    return _digest(folder, _model(folder))


def _model(folder: Path) -> list[Path]:
    return [*folder.rglob("*.urdf"), *folder.rglob("*.srdf"), *folder.glob("hand.yaml")]


def _digest(folder: Path, files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        # With the path, so that moving a file is a change, too.
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
