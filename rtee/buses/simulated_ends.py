"""The host's end of a simulated line: a pseudo-terminal, or a TCP port of this machine."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import socket
import struct
import tempfile
import termios
from pathlib import Path

from rtee.errors import BusBroken

_TCGETS2 = 0x802C542A
"""The ioctl that reads a tty's settings with any rate, see ioctl_tty(2); termios does not name
it."""
_TERMIOS2 = struct.Struct("=4I20s2I")
"""Linux's termios2: flags, control characters, speed in, speed out."""
_PIECE = 4096
"""Bytes read at a time; what the kernel buffer of a pseudo-terminal usually holds."""


class Pty:
    """A pseudo-terminal, found by a symbolic link, whose host end is kept raw.

    As on a real line, bytes that come while no program has it open are lost. Meanwhile the master
    reports a hang-up all the time, so it is polled edge-triggered.
    """

    def __init__(self, link: Path | str | None) -> None:
        self._folder: str | None = None
        self._link = Path(link) if link is not None else None
        self._master = -1
        self._name = ""
        self._changes: select.epoll | None = None
        self._deserted = True

    @property
    def open(self) -> bool:
        """Whether the host finds it."""
        return self._master >= 0

    @property
    def address(self) -> str:
        """Where the host finds it."""
        return "" if self._link is None else str(self._link)

    @property
    def heard(self) -> bool:
        """Whether a program has it open."""
        if self._deserted and self.open:
            poll = select.poll()
            poll.register(self._master, 0)
            self._deserted = bool(poll.poll(0))  # a hang-up
        return self.open and not self._deserted

    def plug(self) -> None:
        """Make it; raises `BusBroken`."""
        import pty
        import tty

        self._master, slave = pty.openpty()
        try:
            # Its settings last as long as the master: the host's end need not stay open here.
            tty.setraw(slave)
            self._name = os.ttyname(slave)
        finally:
            os.close(slave)
        os.set_blocking(self._master, False)
        self._deserted = True
        self._changes = select.epoll()
        self._changes.register(self._master, select.EPOLLIN | select.EPOLLET)
        if self._link is None:
            self._folder = tempfile.mkdtemp(prefix="rtee-")
            self._link = Path(self._folder) / "port"
        try:
            # One to a pty is another emulator's, mostly one that was killed; any other belongs to
            # somebody else, such as udev.
            if self._leads_to().startswith("/dev/pts/"):
                self._link.unlink()
            self._link.symlink_to(self._name)
        except OSError as error:
            self.unplug()
            raise BusBroken(str(self._link), f"cannot make this link: {error.strerror}") from error

    def unplug(self) -> None:
        """Let it vanish."""
        # Another emulator may have taken the link over meanwhile.
        if self._link is not None and self.open and self._leads_to() == self._name:
            self._link.unlink()
        if self._changes is not None:
            self._changes.close()
            self._changes = None
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def _leads_to(self) -> str:
        """Return where the link leads; empty where there is none."""
        if self._link is None or not self._link.is_symlink():
            return ""
        return os.readlink(self._link)

    def dispose(self) -> None:
        """Leave nothing behind."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self._link = None

    def files(self) -> list[int]:
        """What to wait for until it can be read."""
        return [self._changes.fileno()] if self._changes is not None else []

    def read(self, file: int) -> bytes | None:
        """Return what came, ``None`` where another host has connected or left."""
        if self._changes is None:
            return b""
        self._changes.poll(0)
        data = bytearray()
        try:
            while len(data) < _PIECE:
                data += os.read(self._master, _PIECE)
            self._changes.modify(self._master, select.EPOLLIN | select.EPOLLET)  # there is more
        except BlockingIOError:
            self._deserted = False
        except OSError:
            # EIO: no program has it open. Reported once, though the hang-up stays.
            if data or not self._deserted:
                self._desert()
        return bytes(data)

    def _desert(self) -> None:
        """Lose what the program that has left did not read."""
        self._deserted = True
        with contextlib.suppress(OSError):
            slave = os.open(self._name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                termios.tcflush(slave, termios.TCIFLUSH)
            finally:
                os.close(slave)

    def write(self, data: bytes) -> None:
        """Send bytes to the host."""
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    def rate(self) -> int | None:
        """Return the rate that the host has set [baud], ``None`` where that cannot be known."""
        import fcntl

        try:
            settings = fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size))
        except OSError:
            return None
        return int(_TERMIOS2.unpack(settings)[-1])


class Tcp:
    """A listening port that serves one connection at a time."""

    def __init__(self, host: str, port: int, scheme: str) -> None:
        self._host, self._port, self._scheme = host, port, scheme
        self._server: socket.socket | None = None
        self._peer: socket.socket | None = None

    @property
    def open(self) -> bool:
        """Whether the host finds it."""
        return self._server is not None

    @property
    def address(self) -> str:
        """Where the host finds it."""
        return f"{self._scheme}://{self._host}:{self._port}"

    @property
    def heard(self) -> bool:
        """Whether a host is connected."""
        return self._peer is not None

    def plug(self) -> None:
        """Make it; raises `BusBroken`."""
        try:
            self._server = socket.create_server((self._host, self._port))
        except OSError as error:
            raise BusBroken(self.address, f"cannot listen there: {error.strerror}") from error
        self._port = self._server.getsockname()[1]

    def unplug(self) -> None:
        """Let it vanish."""
        for one in (self._peer, self._server):
            if one is not None:
                # An abortive end: the host sees a reset, as when the box loses power.
                with contextlib.suppress(OSError):
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                one.close()
        self._peer = self._server = None

    def dispose(self) -> None:
        """Nothing stays behind."""

    def files(self) -> list[int]:
        """What to wait for until it can be read."""
        return [s.fileno() for s in (self._peer, self._server) if s is not None]

    def read(self, file: int) -> bytes | None:
        """Return what came, ``None`` where another host has connected or left."""
        if self._server is not None and file == self._server.fileno():
            return self._accept()
        if self._peer is None:
            return b""
        try:
            data = self._peer.recv(_PIECE)
        except OSError:
            data = b""
        if not data:
            self._peer.close()
            self._peer = None
            return None
        return data

    def _accept(self) -> bytes | None:
        if self._server is None:
            return b""
        peer, _ = self._server.accept()
        if self._peer is not None:
            # A second master would mix its requests with those of the first.
            peer.close()
            return b""
        # Small answers must not wait for an acknowledgement (Nagle's algorithm).
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._peer = peer
        return None

    def write(self, data: bytes) -> None:
        """Send bytes to the host, if there is one."""
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.sendall(data)

    def rate(self) -> int | None:
        """Return ``None``: a port has no rate."""
        return None
