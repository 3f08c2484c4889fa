"""Read XML as a tree of elements with their lines. Document types and entities are refused."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

from rtee.errors import ModelError, foreign
from rtee.hand.files import read_bytes

MAX_DEPTH: Final = 100
"""Largest nesting depth of elements; a URDF has five levels."""


@dataclass(slots=True)
class Element:
    """An XML element.

    Attributes:
        tag: Its name.
        attributes: Its attributes.
        line: The line of its start tag, counted from 1.
        path: The file it is in.
        children: The elements inside it, in order.
        texts: Pieces of its text, without that of its children.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    path: Path
    children: list[Element] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The text inside it."""
        return "".join(self.texts).strip()

    def all(self, tag: str) -> Iterator[Element]:
        """Yield the children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """Return the first child with a tag, if there is one."""
        return next(self.all(tag), None)

    def required(self, attribute: str) -> str:
        """Return an attribute that must exist and not be empty.

        Raises:
            ModelError: if it is missing or empty.
        """
        value = self.attributes.get(attribute, "").strip()
        if not value:
            raise self.error(f"<{self.tag}> needs the attribute '{attribute}'")
        return value

    def number(
        self, attribute: str, default: float | None = None, *, most: float = math.inf
    ) -> float:
        """Return an attribute as a finite number.

        Raises:
            ModelError: if it is not finite, is larger than ``most``, or is missing without a
                default.
        """
        if attribute not in self.attributes and default is not None:
            return default
        return self._finite(attribute, self.required(attribute), most)

    def numbers(
        self,
        attribute: str,
        count: int,
        default: tuple[float, ...] | None = None,
        *,
        most: float = math.inf,
    ) -> tuple[float, ...]:
        """Return the finite numbers in an attribute, which blanks separate.

        Raises:
            ModelError: if there are not ``count`` of them, one is not finite or is larger than
                ``most``, or the attribute is missing without a default.
        """
        if attribute not in self.attributes and default is not None:
            return default
        text = self.required(attribute)
        parts = text.split()
        if len(parts) != count:
            raise self.error(f'{attribute}="{text[:80]}" should be {count} numbers')
        return tuple(self._finite(attribute, part, most) for part in parts)

    def error(self, message: str, line: int | None = None) -> ModelError:
        """Return an error that points at this element, or at another line of its file."""
        return ModelError(message, path=self.path, line=self.line if line is None else line)

    def _finite(self, attribute: str, text: str, most: float) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f'{attribute}="{text[:80]}" is not a finite number')
        if abs(value) > most:
            raise self.error(
                f'{attribute}="{text[:80]}" is beyond {most:g}, the largest value for a hand'
            )
        return value


def check_expanded(root: Element) -> None:
    """Refuse a xacro file, which would otherwise be reported as one without content.

    Raises:
        ModelError: if one of the elements is xacro's.
    """
    macro = next((child for child in root.children if child.tag.startswith("xacro:")), None)
    if macro is not None:
        raise macro.error(
            "is a xacro file; rename it to end with .xacro, so that rtee expands it (and runs its "
            "expressions)"
        )


def to_text(root: Element) -> str:
    """Return an element as XML; comments and the place of text between elements are lost."""
    # Imports urllib and email, which a running hand does not need.
    from xml.sax.saxutils import escape, quoteattr

    lines: list[str] = []
    # A stack of elements to write, since elements may be nested deeply.
    pending: list[tuple[int, Element | str]] = [(0, root)]
    while pending:
        depth, each = pending.pop()
        if isinstance(each, str):
            lines.append(each)
            continue
        attributes = "".join(f" {n}={quoteattr(value)}" for n, value in each.attributes.items())
        start, indent = f"{'  ' * depth}<{each.tag}{attributes}", "  " * depth
        if each.children:
            lines.append(f"{start}>{escape(each.text)}")
            pending.append((depth, f"{indent}</{each.tag}>"))
            pending += [(depth + 1, child) for child in reversed(each.children)]
        else:
            lines.append(f"{start}>{escape(each.text)}</{each.tag}>" if each.text else f"{start}/>")
    return "\n".join(lines) + "\n"


class _Builder:
    """Builds the tree from the events of the parser."""

    def __init__(self, path: Path, parser: expat.XMLParserType) -> None:
        self.path = path
        self.parser = parser
        self.root: Element | None = None
        self.open: list[Element] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self.parser.CurrentLineNumber, self.path)
        # Here, since attributes become names, lines of other files and words on terminals.
        for attribute, value in attributes.items():
            if not value.isprintable():
                foreign(f"{attribute}: {value}", element.error)
        # Checked here, since later steps may recurse over the tree.
        if len(self.open) >= MAX_DEPTH:
            raise element.error(f"elements are nested deeper than {MAX_DEPTH}")
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self, _tag: str) -> None:
        self.open.pop()

    def characters(self, text: str) -> None:
        if self.open:
            self.open[-1].texts.append(text)

    def refuse(self, *_: object) -> None:
        raise ModelError(
            "declares a document type or entities, which rtee refuses; remove the <!DOCTYPE …>",
            path=self.path,
            line=self.parser.CurrentLineNumber,
        )


def read_xml(path: Path | str, what: str) -> tuple[Element, str]:
    """Read an XML file.

    Args:
        path: The file.
        what: Kind of file for messages, such as ``"URDF"``.

    Returns:
        The root element and the file's text.

    Raises:
        ModelError: if the file does not exist or cannot be read, is not well-formed XML, or
            declares a document type or entities.
    """
    file = Path(path)
    data = _decodable(read_bytes(file, what, ModelError))
    parser = expat.ParserCreate()
    builder = _Builder(file, parser)
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.characters
    # Entities may expand to gigabytes ("billion laughs"), or read other files.
    parser.StartDoctypeDeclHandler = builder.refuse
    parser.EntityDeclHandler = builder.refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        text = expat.ErrorString(error.code)
        raise ModelError(f"{what} is not XML: {text}", path=file, line=error.lineno) from None
    except (LookupError, ValueError) as error:
        # Errors of the builder pass through the parser unchanged.
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{what} is not XML: {error}", path=file) from None
    if builder.root is None:
        raise ModelError(f"{what} is empty", path=file)
    return builder.root, _text(data)


_LEAD: Final = re.compile(rb"\A((?>\s|<!--.*?-->)++)(<\?xml[^>]*\?>)", re.DOTALL)
"""Blank lines and comments, which some files have before their XML declaration.

Atomic: a comment ends at its first end, or many comments would be tried in all combinations.
"""

_DECLARED: Final = re.compile(
    rb"""\A<\?xml[^>]*?\sencoding\s*=\s*["'](?!utf-?8["'])""", re.IGNORECASE
)
"""A declaration of another encoding than UTF-8."""


def _decodable(data: bytes) -> bytes:
    """Return slightly malformed XML as it is meant, as other programs read it.

    Text before the declaration is moved behind it, with as many lines. Text that claims to be
    UTF-8 but is not, such as a name in a comment, is read as Latin-1.
    """
    lead = _LEAD.match(data)
    if lead is not None:
        data = lead[2] + lead[1] + data[lead.end() :]
    if _DECLARED.match(data) or data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data
    try:
        # Zeros mean UTF-16 without a mark, which the parser detects.
        data.decode("utf-8")
    except UnicodeDecodeError:
        if b"\0" in data[:4]:
            return data
        return _ENCODING.sub(r"\1", data.decode("latin-1"), count=1).encode()
    return data


_ENCODING: Final = re.compile(r"""(\A<\?xml[^>]*?)\s+encoding\s*=\s*(?:"[^"]*"|'[^']*')""")
"""The part of an XML declaration up to its encoding, and the encoding."""


def _text(data: bytes) -> str:
    """Return the text of a file without its declared encoding, to write it again in UTF-8."""
    try:
        # UTF-16 without a byte order mark can be decoded as UTF-8, too, but contains zeros.
        if b"\0" not in data[:2]:
            return data.decode("utf-8-sig")
        encoding = "utf-16-be" if data.startswith(b"\0") else "utf-16-le"
    except UnicodeDecodeError:
        marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        # The parser has accepted the data, so this never fails; Latin-1 keeps at least ASCII.
        encoding = "utf-16" if marked else "latin-1"
    return _ENCODING.sub(r"\1", data.decode(encoding), count=1)
