"""Reader of MJCF files of unknown origin, which are checked before MuJoCo parses them.

MuJoCo's parser opens any file that a model names, and allocates any size that it gives. So each
file is first read as plain XML without entities; its numbers and sizes are limited, and its paths
must not lead out of the model's folder.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import mujoco

from rtee.errors import ModelError
from rtee.hand.files import MAX_SIZE, read_bytes, reason
from rtee.hand.meshes import why_no_mesh
from rtee.hand.vocabulary import unread_of_mjcf
from rtee.hand.xmlfile import Element, read_xml

MOST_FILES: Final = 200
"""Most files that a model may include; those of hands have one to three."""

MOST_BODIES: Final = 300
"""Most bodies of a model; hands have up to 50, and arms with hands 100. The memory that the import
takes grows with the square."""

MOST_ELEMENTS: Final = 5000
"""Most elements of a model; hands have up to a thousand."""

MOST_OF_A_KIND: Final = 1000
"""Most elements of one kind: MuJoCo compares the names of each with those of all others."""

MOST_NESTED: Final = 40
"""Most bodies inside one another; an arm with a hand has a chain of 15. The time for closed
linkages grows with a power of it."""

_GREATEST: Final = 1e10
"""Smallest number that is refused: MuJoCo's own limit for positions and forces."""

_FIRST: Final = 100_000
"""Most words checked per attribute; only inline meshes have more, which MuJoCo checks."""

_WORDS: Final = ("name", "model", "file")
"""Attributes that are names, even if they look like numbers."""

_MESHES: Final = (".stl", ".obj", ".msh")
"""Formats of meshes that MuJoCo reads."""

_REFUSED: Final = {
    "attach": "attaches other models; write it as one file with MuJoCo's compile first",
    "model": "attaches other models; write it as one file with MuJoCo's compile first",
    "replicate": "makes many bodies of one, which rtee does not read",
    "composite": "is a flexible body, which no hand model of rtee has",
    "flexcomp": "is a flexible body, which no hand model of rtee has",
    "flex": "is a flexible body, which no hand model of rtee has",
    "plugin": "needs a plugin of MuJoCo, which rtee does not load",
}
"""Refused elements and the reasons; some of them could make MuJoCo allocate without limit."""

_PLACE: Final = re.compile(
    r"\s*Element (?:name )?'[^']*',(?: id \d+,)? line (\d+)\s*$|\s*Line number=(\d+)\s*$"
)

_UNSEEN: Final = (
    "textures",
    "skins",
    "hfields",
    "sensors",
    "keys",
    "cameras",
    "lights",
    "numerics",
    "texts",
    "tuples",
)
"""Elements irrelevant to the motion and contacts of a hand; some of them name further files."""


@dataclass(frozen=True, slots=True)
class ParsedModel:
    """A model that MuJoCo has parsed.

    Attributes:
        path: The main file.
        spec: The model, without elements for pictures and measurements.
        alone: Whether it includes no other file, so that lines are those of the main file.
        says_angle: Whether it gives the unit of angles.
        notes: Sentences about omitted elements.
    """

    path: Path
    spec: mujoco.MjSpec
    alone: bool
    says_angle: bool
    notes: tuple[str, ...]


def read_mjcf(path: Path | str, folders: Sequence[Path | str] = ()) -> ParsedModel:
    """Read an MJCF file; its includes and meshes may be in further folders, too.

    Raises:
        ModelError: if a file is missing, is not MJCF, leads out of these folders, is too large, or
            has a refused element; the message names file and line if they are known.
    """
    file = Path(path)
    allowed = [_real(folder) for folder in (file.absolute().parent, *folders)]
    parts = _parts(file, allowed)
    elements = [element for part in parts for element in _all(part)]
    if len(elements) > MOST_ELEMENTS:
        raise ModelError(
            f"has {len(elements)} elements; a hand has at most {MOST_ELEMENTS}", path=file
        )
    for element in elements:
        if element.tag in _REFUSED:
            raise element.error(f"<{element.tag}> {_REFUSED[element.tag]}")
        if element.tag == "mesh" and "builtin" in element.attributes:
            raise element.error("a mesh that MuJoCo generates cannot be read; give it as a file")
        _check_numbers(element)
    bodies = sum(element.tag == "body" for element in elements)
    if bodies > MOST_BODIES:
        raise ModelError(f"has {bodies} bodies; a hand has at most {MOST_BODIES}", path=file)
    kind, number = Counter(element.tag for element in elements).most_common(1)[0]
    if number > MOST_OF_A_KIND:
        raise ModelError(
            f"has {number} elements <{kind}>; a hand has at most {MOST_OF_A_KIND}", path=file
        )
    for part in parts:
        _check_depth(part)
    missing = _check_meshes(elements, file, allowed)
    with mujoco_says(file, lines=len(parts) == 1) as notes:
        spec = mujoco.MjSpec.from_file(str(file))
    notes += [*_reduce(spec, missing, file), *unread_of_mjcf(elements)]
    says_angle = any(e.tag == "compiler" and "angle" in e.attributes for e in elements)
    return ParsedModel(file, spec, len(parts) == 1, says_angle, tuple(notes))


def _check_depth(root: Element) -> None:
    """Refuse bodies that are nested deeper than those of any hand."""
    pending = [(root, 0)]
    while pending:
        element, depth = pending.pop()
        depth += element.tag == "body"
        if depth > MOST_NESTED:
            raise element.error(
                f"bodies are nested more than {MOST_NESTED} deep, too deep for a hand"
            )
        pending += [(child, depth) for child in element.children]


def _check_numbers(element: Element) -> None:
    """Refuse numbers that are not finite or too large for a computation."""
    for attribute, text in element.attributes.items():
        for word in () if attribute in _WORDS else text.split()[:_FIRST]:
            try:
                value = float(word)
            except ValueError:
                break  # a word: the attribute is not a list of numbers
            if not abs(value) < _GREATEST:
                raise element.error(
                    f'{attribute}="{text[:80]}" has a number that is not finite or beyond '
                    f"{_GREATEST:g}"
                )


@contextmanager
def mujoco_says(path: Path, *, lines: bool) -> Iterator[list[str]]:
    """Turn MuJoCo's errors into sentences and its warnings into notes.

    Args:
        path: The model's main file.
        lines: Whether the lines in its messages are those of the main file.

    Yields:
        The notes, complete after the context.
    """
    notes: list[str] = []
    try:
        with listening(notes):
            yield notes
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        if isinstance(error, ModelError):
            raise
        raise _mujoco_error(error, path, lines=lines) from None


@contextmanager
def listening(notes: list[str]) -> Iterator[None]:
    """Add MuJoCo's warnings to notes."""
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    # By default, MuJoCo prints warnings and writes them to a file in the working directory.
    mujoco.set_mju_user_warning(heard.append)
    try:
        with warnings.catch_warnings(record=True) as caught:  # Python's own warnings
            warnings.simplefilter("always")
            yield
        heard += [str(each.message) for each in caught]
        notes += [f"MuJoCo warns: {' '.join(text.split())}" for text in dict.fromkeys(heard)]
    finally:
        mujoco.set_mju_user_warning(before)


def _mujoco_error(error: Exception, path: Path, *, lines: bool) -> ModelError:
    text = str(error).strip()
    place = _PLACE.search(text)
    line = int(place[1] or place[2]) if place else 0
    text = _PLACE.sub("", text)
    text = re.sub(r"^(XML )?Error:\s*", "", " ".join(text.split()))
    return ModelError(
        f"MuJoCo refuses it: {text[:1].lower()}{text[1:300]}",
        path=path,
        line=line if lines and line > 0 else None,
    )


def _real(folder: Path | str) -> Path:
    try:
        return Path(folder).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ModelError(f"folder cannot be read: {reason(error)}", path=folder) from None


def _all(root: Element) -> Iterator[Element]:
    pending = [root]
    while pending:
        element = pending.pop()
        yield element
        pending.extend(element.children)


def _parts(file: Path, allowed: Sequence[Path]) -> list[Element]:
    """Return the root elements of a model's file and of its includes."""
    root = read_xml(file, "MJCF")[0]
    if root.tag != "mujoco":
        what = "a URDF (give it with --urdf)" if root.tag == "robot" else f"<{root.tag[:40]}>"
        raise root.error(f"is {what}, not MJCF, whose root element is <mujoco>")
    # By real path, since files may include each other.
    parts, size = {_real(file): root}, 0
    pending = [root]
    while pending:
        for element in _all(pending.pop()):
            if element.tag != "include":
                continue
            name = element.required("file")
            # MuJoCo only looks beside the main file; the including file's folder is cheap to try.
            places = dict.fromkeys((file.parent / name, element.path.parent / name))
            files = [place for place in places if _inside(place, allowed, element, name).is_file()]
            if not files:
                raise element.error(f"the included file '{name[:200]}' does not exist")
            for place in files:
                if _real(place) in parts:
                    continue
                size += place.stat().st_size
                if size > MAX_SIZE or len(parts) > MOST_FILES:
                    raise element.error(
                        f"includes more than {MOST_FILES} files or {MAX_SIZE // 1_000_000} MB"
                    )
                part = read_xml(place, "MJCF")[0]
                parts[_real(place)] = part
                pending.append(part)
    return list(parts.values())


def _inside(place: Path, allowed: Sequence[Path], element: Element, name: str) -> Path:
    """Return a file's real path; raise `ModelError` if it is outside the allowed folders."""
    real = _real(place)
    if not any(real.is_relative_to(folder) for folder in allowed):
        raise element.error(
            f"'{name[:200]}' is outside of the model's folder; put the file there, or give its "
            f"folder with --package-dir {real.parent}"
        )
    return real


def _check_meshes(
    elements: Sequence[Element], file: Path, allowed: Sequence[Path]
) -> dict[str, str]:
    """Check every file that a model names; return the reason for each unusable mesh."""
    compilers = [element.attributes for element in elements if element.tag == "compiler"]
    missing: dict[str, str] = {}
    for element in elements:
        for attribute, name in element.attributes.items():
            if not attribute.startswith("file") or element.tag == "include":
                continue
            own = "texturedir" if element.tag == "texture" else "meshdir"
            folders = [c[key] for c in compilers for key in (own, "assetdir") if key in c]
            places = [file.parent / folder / name for folder in ("", *folders)]
            files = [p for p in places if _inside(p, allowed, element, name).is_file()]
            if element.tag != "mesh":  # textures and the like are never opened
                continue
            if not files:
                searched = ", ".join(dict.fromkeys(str(place.parent) for place in places))
                missing[name] = (
                    f"mesh '{name[:200]}' (line {element.line}) does not exist; looked in "
                    f"{searched}" + ("" if folders else "; <compiler> has no meshdir")
                )
            elif files[-1].suffix.lower() not in _MESHES:
                missing[name] = f"mesh '{name[:200]}' is in none of MuJoCo's formats: stl, obj, msh"
            else:
                data = read_bytes(files[-1], "mesh", ModelError)
                fault = why_no_mesh(data, files[-1].suffix.lower())
                if fault:
                    missing[name] = f"mesh '{name[:200]}' cannot be read: {fault}"
    return missing


def collides(geom: mujoco.MjsGeom) -> bool:
    """Return whether a shape can touch others."""
    return bool(geom.contype or geom.conaffinity)


def _reduce(spec: mujoco.MjSpec, missing: dict[str, str], path: Path) -> list[str]:
    """Remove elements that motion and contacts do not need; return notes."""
    notes = []
    broken = {
        mesh.name or Path(mesh.file).stem: missing[mesh.file]
        for mesh in spec.meshes
        if mesh.file in missing
    }
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in list(spec.geoms):
        geom.material = ""
        kind = geom.type
        why = ""
        if geom.meshname in broken and kind == mujoco.mjtGeom.mjGEOM_MESH:
            if collides(geom) or geom.name in paired:
                raise ModelError(broken[geom.meshname], path=path)
            why = broken[geom.meshname]
        elif kind in (mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF):
            why = f"body '{geom.parent.name}' has a height field or a distance field"
        if why:
            notes.append(f"a shape was left out: {why}")
            spec.delete(geom)
    for mesh in list(spec.meshes):
        mesh.material = ""
        if mesh.file in missing:
            spec.delete(mesh)
    for tendon in spec.tendons:
        tendon.material = ""
    for site in spec.sites:
        site.material = ""
    for kind_of in _UNSEEN:
        for obj in list(getattr(spec, kind_of)):
            spec.delete(obj)
    for material in list(spec.materials):
        spec.delete(material)
    # Drop memory and sizes requested by the file, since nothing is simulated here.
    spec.memory, spec.nuserdata, spec.nkey = -1, 0, 0
    # The compiler must neither merge fixed bodies nor drop visual shapes.
    spec.compiler.discardvisual = spec.compiler.fusestatic = spec.compiler.usethread = False
    return notes
