"""Find the hands, their folders, and whether their files have changed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError, suggestion
from rtee.hand.names import check_name

VARIABLE: Final = "RTEE_CONFIG_PATH"
FILE_NAME: Final = "hand.yaml"


def config_dirs(extra: Sequence[Path | str] = ()) -> list[Path]:
    """Return the folders that hold hands, those that take precedence first.

    They are ``extra``, the user's (see `own_dirs`), the ones that came with rtee, and last the
    working directory, in which nothing replaces a hand known elsewhere.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = [*(Path(folder) for folder in extra), *own_dirs(), package / "_config"]
    if (package.parent / "pyproject.toml").is_file():
        candidates.append(package.parent / "config")
    candidates.append(Path())
    found: dict[Path, Path] = {}
    for folder in candidates:
        if os.path.isdir(folder):  # unlike Path.is_dir, also beside folders that may not be read
            # Resolved: the same folder may be named twice, as by a link.
            found.setdefault(folder.resolve(), folder)
    return list(found.values())


def own_dirs() -> list[Path]:
    """Return the folders for hands of the user, whether they exist or not, by precedence.

    They are those in ``RTEE_CONFIG_PATH``, ``./config``, and ``rtee/hands`` in the user's folder of
    settings (``XDG_CONFIG_HOME``, else ``~/.config``).
    """
    found = [Path(p) for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    found.append(Path("config"))
    # `~` stays where no home is known, and a relative XDG_CONFIG_HOME is to be ignored; either
    # would be a folder in the working directory.
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config"))
    return [*found, settings / "rtee" / "hands"] if settings.is_absolute() else found


def hands(extra: Sequence[Path | str] = ()) -> dict[str, Path]:
    """Return the folders of all hands by name, sorted by name."""
    found: dict[str, Path] = {}
    for name, folder in _all(config_dirs(extra)):
        # The first one counts: folders come in the order of precedence.
        found.setdefault(name, folder)
    return dict(sorted(found.items()))


def hand_names(extra: Sequence[Path | str] = ()) -> list[str]:
    """Return the names of all hands, sorted."""
    return list(hands(extra))


def find_hand(name: str, extra: Sequence[Path | str] = ()) -> Path:
    """Return the folder of a hand.

    Raises:
        ConfigError: There is no hand of that name, or the name is not allowed.
    """
    check_name(name, "hand")
    for folder in config_dirs(extra):
        # As in `config_dirs`: Path.is_file ends with an error where a folder may not be entered.
        if os.path.isfile(folder / name / FILE_NAME):
            return folder / name
    raise ConfigError(
        f"unknown hand '{name}'; {suggestion(name, hand_names(extra))} ('rtee hands' lists them, "
        f"'rtee new' makes one)"
    )


def _all(folders: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    for folder in folders:
        for file in sorted(folder.glob(f"*/{FILE_NAME}")):
            yield file.parent.name, file.parent


def fingerprint(folder: Path) -> str:
    """Return a word of 16 characters that changes with the hand's model, configuration or actions.

    Meshes are not looked at.

    Args:
        folder: The hand's folder.
    """
    return _digest(folder, [*_model(folder), *(folder / "actions").rglob("*.yaml")])


def model_fingerprint(folder: Path) -> str:
    """Return the same of the model, the configuration and the primitives, without other actions.

    Args:
        folder: The hand's folder.
    """
    return _digest(folder, [*_model(folder), *(folder / "actions/primitives").rglob("*.yaml")])


def _model(folder: Path) -> list[Path]:
    return [*folder.rglob("*.urdf"), *folder.rglob("*.srdf"), *folder.glob("hand.yaml")]


def _digest(folder: Path, files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        # With the names, so that moving a file is a change, too.
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
