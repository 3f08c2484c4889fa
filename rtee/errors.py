"""Every error that rtee raises on purpose.

The tree::

    RteeError                      every error below, described in one sentence
    ├── UserError                  a mistake in the user's files or options: exit status 2
    │   ├── ConfigError            hand.yaml, options, command line
    │   │   └── MissingExtra       an extra that is needed but not installed
    │   ├── ModelError             URDF, SRDF, meshes
    │   │   ├── ExpressionError    a non-linear mimic expression
    │   │   └── UnknownJoint · UnknownActuator · UnknownFinger · UnknownLink
    │   ├── ActionError            an action's file or definition
    │   │   └── UnknownAction
    │   ├── CalibrationError       a calibration that does not fit the device
    │   └── LogError               a recording that cannot be read
    ├── BusError(bus)
    │   ├── BusClosed              closed on this side
    │   ├── BusBroken (OSError)    broken by an external cause: unplugged, reset
    │   ├── BusBusy                owned by somebody else
    │   ├── BusTimeout (TimeoutError)
    │   └── FrameError             bytes that are not a valid frame
    ├── DriverError(device)
    │   ├── NotConnected (ConnectionError)
    │   ├── HandshakeError         another device than the one expected
    │   ├── DeviceFault            the device reports a fault
    │   └── CommandRejected        a reference that the device refuses
    ├── MessageError (ValueError)  bytes that are not a valid message
    ├── WorkerLost                 something outside killed a worker process
    ├── SimulationUnstable         the equations of a simulation diverged
    ├── LoopError                  the loop itself failed; carries its last cycles
    └── RemoteError
        ├── NoHand                 nobody answers on the network
        ├── NoRouter               the ROS 2 router does not answer
        ├── NotReady (TimeoutError)  a device of the hand did not become active in time
        ├── LeaseHeld              another client holds the lease
        └── RequestRejected        the hand refused, with its reason
            ├── GoalRejected (ActionError)  a goal that cannot be executed
            └── TooManyRequests    this client sends requests too fast
"""

from __future__ import annotations

import difflib
import json
import signal
import sys
import threading
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote, urlsplit


class RteeError(Exception):
    """Base of all errors of rtee: one sentence of what is wrong, where, and what would be right."""

    exit_status: ClassVar[int] = 1

    def __init__(self, text: str = "") -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:  # OSError among the bases would print "[Errno …]"
        return self.text

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash((type(self), self.text))

    # By default, copying and pickling call the class with the text alone.
    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), *self.args), vars(self)


def _again(kind: type[RteeError], *arguments: object) -> RteeError:
    return kind.__new__(kind, *arguments)


def foreign(text: str, refuse: Callable[[str], Exception] | None = None) -> str:
    """Return a name or a line of text from outside, with unprintable characters escaped.

    All readers of names from outside use this: those of URDF, SRDF, MJCF, YAML, messages,
    recordings and devices. A line break would turn a name into several lines of a file. Control
    characters, text-direction marks and zero-width characters mislead a terminal or a reader. The
    writers of YAML, XML and HTML escape quotes and other syntax.

    Args:
        text: The text.
        refuse: Makes the error to raise from a reason; without it, characters are escaped.
    """
    if text.isprintable():
        return text
    if refuse is not None:
        wrong = next(c for c in text if not c.isprintable())
        name = unicodedata.name(wrong, "a control character").lower()
        raise refuse(f"U+{ord(wrong):04X} ({name}) in '{foreign(text[:80])}' is not printable")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class UserError(RteeError):
    """A mistake in a file, name or value that the user gave.

    Attributes:
        message: What is wrong and what would be right, in one line.
        path: The file with the mistake, if any.
        line: The line in that file, counted from 1, if known.
    """

    exit_status: ClassVar[int] = 2

    def __init__(
        self, message: str, *, path: Path | str | None = None, line: int | None = None
    ) -> None:
        # It may quote files and names, which must not send control characters to a terminal.
        message = foreign(message)
        super().__init__(message)
        self.message = message
        self.path = None if path is None else Path(path)
        self.line = line

    def __str__(self) -> str:
        if self.path is None:
            return self.message
        place = foreign(str(self.path))
        if self.line is None:
            return f"{place}: {self.message}"
        return f"{place}:{self.line}: {self.message}"


# Errors also derive from the fitting built-in error, which callers may already catch.
class ConfigError(UserError, ValueError):
    """A configuration that cannot be used.

    Attributes:
        key: The field, dotted from the root of the document (``devices.svh.port``), if any.
    """

    def __init__(
        self,
        message: str,
        *,
        path: Path | str | None = None,
        line: int | None = None,
        key: str | None = None,
    ) -> None:
        super().__init__(message, path=path, line=line)
        self.key = key


class MissingExtra(ConfigError):
    """A feature needs an extra of rtee that is not installed.

    Attributes:
        extra: The extra, as written in brackets after the package's name.
    """

    def __init__(self, what: str, extra: str) -> None:
        """Describe the missing extra, and how to install it.

        Args:
            what: The feature that needs it, in the singular, to begin a sentence: ``the GUI``.
            extra: Name of the extra.
        """
        super().__init__(f"{what} needs the extra '{extra}': {install_line(extra)}")
        self.extra = extra


def check_system() -> None:
    """Raise `ConfigError` on an operating system that lacks what rtee needs."""
    if sys.platform == "win32":
        raise ConfigError(
            "rtee runs on Linux, and without real devices on macOS, but not on Windows; use WSL 2"
        )


def install_line(extra: str) -> str:
    """Return the command that adds an extra to this rtee, from its original source.

    A package of the same name on an index may be something else. The installer records the origin
    (PEP 610), except for packages from an index or from a folder of wheels.
    """
    from importlib import metadata  # at the top, it would slow every start by milliseconds

    try:
        origin = metadata.distribution("rtee").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        origin = None
    given = json.loads(origin or "{}")
    parts = urlsplit(given.get("url", ""))
    if parts.scheme == "file":
        editable = "--editable " if given.get("dir_info", {}).get("editable") else ""
        return f'pip install {editable}"{unquote(parts.path)}[{extra}]"'
    if parts.scheme:
        return f'pip install "rtee[{extra}] @ {given["url"]}"'
    return f'install "rtee[{extra}]" from where this rtee was installed'


@contextmanager
def needing_extra(what: str, extra: str) -> Iterator[None]:
    """Turn a failed import inside the context into a sentence for the user.

    Args:
        what: The feature that needs the import, as for `MissingExtra`.
        extra: Name of the extra.

    Raises:
        MissingExtra: if a package imported inside the context is not installed.
        ConfigError: if it is installed but cannot be loaded, such as for want of a library of the
            system.
    """
    try:
        with _interruptible():
            yield
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "rtee":  # a bug of rtee, not a missing extra
            raise
        if isinstance(error, ModuleNotFoundError):
            raise MissingExtra(what, extra) from error
        reason = str(error).strip().partition("\n")[0]
        raise ConfigError(
            f"{what} needs the extra '{extra}', which is installed but cannot be loaded: {reason}"
        ) from error


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise `KeyboardInterrupt` again at the end: trimesh mistakes it for a missing package."""
    default, pressed = signal.default_int_handler, False

    def press(*_: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    # A program with its own handler, such as asyncio's, is notified by that handler.
    if not main or signal.getsignal(signal.SIGINT) is not default:
        yield
        return
    signal.signal(signal.SIGINT, press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, default)
        if pressed:
            raise KeyboardInterrupt


class ModelError(UserError, ValueError):
    """A URDF, SRDF or mesh that cannot be used."""


class ExpressionError(ModelError):
    """A mimic expression outside the grammar.

    Attributes:
        column: Position of the offending character, counted from 0.
    """

    def __init__(
        self,
        message: str,
        *,
        column: int = 0,
        path: Path | str | None = None,
        line: int | None = None,
    ) -> None:
        super().__init__(message, path=path, line=line)
        self.column = column


def first_error(group: BaseExceptionGroup[BaseException]) -> RteeError | None:
    """Return the first error of a group if all of them are sentences for the user."""
    own, others = group.split(RteeError)
    first: BaseException | None = own if others is None else None
    while isinstance(first, BaseExceptionGroup):
        first = first.exceptions[0]
    return first if isinstance(first, RteeError) else None


def sole_error(error: Exception) -> Exception:
    """Return the error in a task group's group of a single one; any other error as it is."""
    while isinstance(error, ExceptionGroup) and len(error.exceptions) == 1:
        error = error.exceptions[0]
    return error


def closest(name: str, valid: Iterable[str]) -> str:
    """Return the valid name most similar to a name, ignoring case; ``""`` if none is similar."""
    folded = {each.casefold(): each for each in valid}
    return next(
        (folded[each] for each in difflib.get_close_matches(name.casefold(), folded, 1)), ""
    )


def suggestion(name: object, valid: Iterable[str], *, most: int = 12) -> str:
    """Return a hint that names the closest valid name, or lists the valid ones.

    The ``name`` may be anything that somebody gave instead.
    """
    names = sorted(valid)
    if close := closest(str(name), names):
        return f"did you mean '{close}'?"
    if not names:
        return "there are none"
    shown = ", ".join(names[:most]) + (", …" if len(names) > most else "")
    return f"valid: {shown}"


class _UnknownName(ModelError):
    what: ClassVar[str] = "name"

    def __init__(
        self,
        name: str,
        valid: Sequence[str] = (),
        *,
        path: Path | str | None = None,
        line: int | None = None,
    ) -> None:
        super().__init__(
            f"unknown {self.what} '{name}'; {suggestion(name, valid)}", path=path, line=line
        )
        self.name = name
        self.valid = tuple(valid)


class UnknownJoint(_UnknownName):
    """A joint that the model does not have."""

    what = "joint"


class UnknownActuator(_UnknownName):
    """An actuator that the hand does not have."""

    what = "actuator"


class UnknownFinger(_UnknownName):
    """A finger that the hand does not have."""

    what = "finger"


class UnknownLink(_UnknownName):
    """A link that the model does not have."""

    what = "link"


class ActionError(UserError, ValueError):
    """A grasping action that is not well defined."""


class UnknownAction(ActionError):
    """An action that the library does not have.

    Attributes:
        name: The unknown name.
        valid: The names of the library's actions.
    """

    def __init__(self, name: str, valid: Sequence[str] = ()) -> None:
        super().__init__(f"unknown action '{name}'; {suggestion(name, valid)}")
        self.name = name
        self.valid = tuple(valid)


class CalibrationError(UserError):
    """A calibration that is missing, of another device, or out of range.

    Attributes:
        device: The device's name.
    """

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"device '{device}': {message}")
        self.device = device


class LogError(UserError):
    """A recording that cannot be read or written."""


class BusError(RteeError):
    """Something went wrong on a bus.

    Attributes:
        bus: The bus's address, as configured.
    """

    def __init__(self, bus: str, message: str) -> None:
        super().__init__(f"bus '{bus}': {message}")
        self.bus = bus
        self.message = message


class BusClosed(BusError):
    """The bus was closed on this side."""


class BusBroken(BusError, OSError):
    """An external cause broke the bus: adapter unplugged, connection reset, bus-off."""


class BusBusy(BusError):
    """The bus already has an owner."""


class BusTimeout(BusError, TimeoutError):
    """No answer arrived within the deadline and the retry budget."""


class FrameError(BusError):
    """Bytes arrived that are not a valid frame.

    Attributes:
        raw: The offending bytes.
    """

    def __init__(self, bus: str, message: str, raw: bytes = b"") -> None:
        super().__init__(bus, message)
        self.raw = raw


class DriverError(RteeError):
    """A device cannot carry out a request.

    Attributes:
        device: The device's name.
        hint: Advice for the user.
    """

    def __init__(self, device: str, message: str, *, hint: str = "") -> None:
        super().__init__(f"device '{device}': {message}" + (f"; {hint}" if hint else ""))
        self.device = device
        self.message = message
        self.hint = hint


class NotConnected(DriverError, ConnectionError):
    """The device cannot be reached."""


class HandshakeError(DriverError):
    """The device that answers is not the expected one.

    Attributes:
        expected: The expected device.
        found: The device that answered.
    """

    def __init__(self, device: str, expected: str, found: str, *, hint: str = "") -> None:
        super().__init__(device, f"expected {expected}, found {found}", hint=hint)
        self.expected = expected
        self.found = found


class DeviceFault(DriverError):
    """The device reports a fault.

    Attributes:
        code: The device's own code.
        name: The fault's name.
        recoverable: Whether ``recover()`` may clear it.
    """

    def __init__(
        self, device: str, code: int, name: str, *, recoverable: bool = True, hint: str = ""
    ) -> None:
        super().__init__(device, f"fault {code} ({name})", hint=hint)
        self.code = code
        self.name = name
        self.recoverable = recoverable


class CommandRejected(DriverError):
    """The device refuses a reference, for example one with an effort limit it cannot apply."""


class MessageError(RteeError, ValueError):
    """Bytes that are not a valid message, or a message with invalid values."""


class WorkerLost(RteeError):
    """Something outside the program killed a worker process."""


class SimulationUnstable(RteeError):
    """The equations of a simulation diverged, and it was restarted: its earlier states are void."""

    def __init__(self) -> None:
        super().__init__("the simulation became unstable and was restarted")


class LoopError(RteeError):
    """The loop itself failed."""


class RemoteError(RteeError):
    """Something went wrong between a client and the hand."""


class NoHand(RemoteError):
    """No running hand answers on the network."""


class NoRouter(RemoteError):
    """The ROS 2 router does not answer."""


class NotReady(RemoteError, TimeoutError):
    """A hand runs, but did not become ready in time; the text says why."""


class LeaseHeld(RemoteError):
    """Another client holds the lease of the hand.

    Attributes:
        holder: The client that holds it.
    """

    def __init__(self, holder: str) -> None:
        super().__init__(f"the hand is held by '{holder}'; stop is always possible, motion is not")
        self.holder = holder


class RequestRejected(RemoteError):
    """The hand refused a request, with its reason."""

    exit_status: ClassVar[int] = 2


class GoalRejected(ActionError, RequestRejected):
    """A goal, or another motion, that cannot be executed; the hand has not moved.

    It is the same error whether the hand or this computer refuses the goal.

    Attributes:
        code: Kind of the mistake: ``unknown`` for an unknown name or word, otherwise ``value``.
        option: The option or argument that is wrong, if one is.
        valid: Valid values of the option or argument, if they can be listed.
        nearest: The most similar valid name; empty: none.
    """

    def __init__(
        self,
        message: str,
        *,
        option: str = "",
        given: str = "",
        valid: Iterable[str] = (),
        path: Path | str | None = None,
        line: int | None = None,
    ) -> None:
        super().__init__(message, path=path, line=line)
        self.option = option
        self.valid = tuple(valid)
        self.code = "unknown" if self.valid else "value"
        self.nearest = closest(given, self.valid)


class TooManyRequests(RequestRejected):
    """The hand refused a request because this client sends too many of its kind."""

    # Unlike other refused requests, this one is valid and may be sent again later.
    exit_status: ClassVar[int] = 1
