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

from rtee.errors import BusBroken, ConfigError

_TCGETS2 = 0x802C542A
"""The ioctl that reads the settings of a tty with an arbitrary baud rate, see ioctl_tty(2); the
module termios lacks it."""
_TERMIOS2 = struct.Struct("=4I20s2I")
"""Linux's struct termios2: flags, control characters, input speed, output speed."""
_PIECE = 4096
"""Most bytes to read at once, the usual size of the kernel's buffer of a pseudo-terminal [byte]."""


class Pty:
    """A pseudo-terminal in raw mode with a symbolic link as its address.

    As on a real line, bytes sent while no program has it open are lost. The master reports a
    hang-up all that time, so it is polled edge-triggered.
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
        """Whether the host can find it."""
        return self._master >= 0

    @property
    def address(self) -> str:
        """The address for the host."""
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
        """Create the port; raises `ConfigError` if the link to it cannot be made."""
        import pty
        import tty

        self._master, slave = pty.openpty()
        try:
            # The settings last as long as the master, so the host's end can be closed here.
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
            # A link to a pty comes from another emulator, usually one that was killed. Any other
            # link belongs to another program, such as udev, and is kept.
            if self._leads_to().startswith("/dev/pts/"):
                self._link.unlink()
            self._link.symlink_to(self._name)
        except OSError as error:
            self.unplug()
            words = f"cannot make this link: {error.strerror}"
            raise ConfigError(words, path=self._link) from error

    def unplug(self) -> None:
        """Remove the port."""
        # Another emulator may have replaced the link since.
        if self._link is not None and self.open and self._leads_to() == self._name:
            self._link.unlink()
        if self._changes is not None:
            self._changes.close()
            self._changes = None
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def _leads_to(self) -> str:
        """Return the target of the link; empty if there is none."""
        if self._link is None or not self._link.is_symlink():
            return ""
        return os.readlink(self._link)

    def dispose(self) -> None:
        """Remove the temporary folder of the link."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self._link = None

    def files(self) -> list[int]:
        """Return the file descriptors to wait for."""
        return [self._changes.fileno()] if self._changes is not None else []

    def read(self, file: int) -> bytes | None:
        """Return the received bytes; ``None`` if a host has connected or left."""
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
            # EIO: no program has it open. Handle this once, although the hang-up persists.
            if data or not self._deserted:
                self._desert()
        return bytes(data)

    def _desert(self) -> None:
        """Discard the bytes that the last program did not read."""
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
        """Return the bit rate that the host has set [bit/s], ``None`` if it is unknown."""
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
    def address(self) -> str:
        """The address for the host."""
        return f"{self._scheme}://{self._host}:{self._port}"

    @property
    def heard(self) -> bool:
        """Whether a host is connected."""
        return self._peer is not None

    def plug(self) -> None:
        """Create the port; raises `BusBroken`."""
        try:
            self._server = socket.create_server((self._host, self._port))
        except OSError as error:
            raise BusBroken(self.address, f"cannot listen there: {error.strerror}") from error
        self._port = self._server.getsockname()[1]

    def unplug(self) -> None:
        """Remove the port."""
        for one in (self._peer, self._server):
            if one is not None:
                # Linger time 0: the host gets a reset, as when the device loses power.
                with contextlib.suppress(OSError):
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                one.close()
        self._peer = self._server = None

    def dispose(self) -> None:
        """Do nothing: a socket leaves no files."""

    def files(self) -> list[int]:
        """Return the file descriptors to wait for."""
        return [s.fileno() for s in (self._peer, self._server) if s is not None]

    def read(self, file: int) -> bytes | None:
        """Return the received bytes; ``None`` if a host has connected or left."""
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
            # The requests of a second master would mix with those of the first.
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
        """Return ``None``: a TCP port has no bit rate."""
        return None
