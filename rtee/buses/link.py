"""Open a byte link: a tty, ``socket://host:port``, ``tcp://host:port`` or ``rfc2217://host:port``.

The result is always an asyncio transport, so the layers above need not distinguish the links.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
import socket
import termios
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import serial
import serial_asyncio

from rtee.buses.direct_end import SIMULATED, simulated_end
from rtee.buses.simulated_time import on_simulated_time
from rtee.errors import BusBroken, BusBusy, BusError, ConfigError, RteeError

_PIECE = 4096
"""Most bytes to read at once, the size of the kernel's buffer of a tty [byte]."""

_POLL = 0.05
"""Interval at which the reading thread checks whether it has to end [s]: short enough that closing
a port causes no noticeable delay."""

_SCHEMES = ("socket", "tcp", SIMULATED, "rfc2217", "loop", "spy", "hwgrep", "alt")
"""Schemes of addresses: the first three are opened here, the others by pyserial."""

_DENIED = "no permission; add yourself to the group 'dialout' and log in again"
_CAUSES: Mapping[int | None, str] = {
    errno.ENOENT: "there is no such port; is it plugged in? `rtee scan` lists the ports",
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.ECONNREFUSED: "connection refused; nothing listens there",
    errno.ENOTTY: "is not a serial port; `rtee scan` lists the ports",
}
"""Why a port cannot be opened and what to do, by the system's error number."""

LinkProtocol = Callable[[], asyncio.Protocol]


@dataclass(frozen=True, slots=True)
class Line:
    """Settings of a serial line with eight data bits.

    Attributes:
        baudrate: Bit rate [bit/s].
        parity: ``N``, ``E`` or ``O``.
        stopbits: 1 or 2.
    """

    baudrate: int = 115200
    parity: str = "N"
    stopbits: int = 1

    @property
    def bits(self) -> int:
        """Bits on the line per byte: start, eight data, parity and stop bits."""
        return 9 + (self.parity != "N") + self.stopbits


def split_address(url: str, default_port: int | None = None) -> tuple[str, int]:
    """Return host and port of a ``scheme://host[:port]`` address.

    Raises:
        ConfigError: if it has another form.
    """
    _, _, rest = url.partition("://")
    host, colon, port = rest.partition("/")[0].rpartition(":")
    if not colon and default_port is not None:
        host, port = port, str(default_port)
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(
            f"'{url}' is not an address; write it as '{url.partition('://')[0]}://host:port'"
        )
    return host, int(port)


async def open_link(
    url: str, line: Line, protocol: LinkProtocol, *, timeout: float = 3.0, name: str | None = None
) -> tuple[asyncio.Transport, asyncio.Protocol]:
    """Open a byte link.

    Args:
        url: A tty, ``socket://``, ``tcp://`` (the same) or ``rfc2217://`` address.
        line: Settings of the line; plain sockets ignore them.
        protocol: Makes the asyncio protocol that receives the bytes.
        timeout: Longest time to wait for a connection [s].
        name: The address for error messages; by default ``url``.

    Raises:
        BusBusy: if another process has the port open.
        BusBroken: if it cannot be opened.
        ConfigError: if the address is malformed.
    """
    name = name or url
    loop = asyncio.get_running_loop()
    scheme, colon, _ = url.partition("://")
    if colon and scheme not in _SCHEMES:
        raise ConfigError(
            f"'{url}' is not the address of a serial line; give a tty, socket://host:port, "
            "tcp://host:port or rfc2217://host:port"
        )
    try:
        if scheme == SIMULATED:
            return simulated_end(url).connect(protocol(), line.baudrate)
        refuse_on_simulated_time(url)
        if url.startswith(("socket://", "tcp://")):
            host, port = split_address(url, 502 if url.startswith("tcp://") else None)
            async with asyncio.timeout(timeout):
                return await loop.create_connection(protocol, host, port)
        port_object = await _opened(url, line, timeout)
        connection = protocol()
        if url.startswith("rfc2217://"):
            return ThreadTransport(loop, connection, port_object), connection
        return SerialTransport(loop, connection, port_object), connection
    except TimeoutError as error:
        raise BusBroken(name, f"no connection within {timeout:.1f} s") from error
    except RteeError:
        raise
    except (OSError, ValueError) as error:
        raise explained(name, error) from error


def refuse_on_simulated_time(url: str) -> None:
    """Raise `RteeError` on simulated time if this is a real port: time would not wait for it."""
    if on_simulated_time() is not None and ("://" in url or os.path.exists(url)):
        raise RteeError(
            f"'{url}' is a real port, and simulated time does not wait for those; "
            "make a simulated line in the same event loop, or test in real time"
        )


async def _opened(url: str, line: Line, timeout: float) -> Any:
    """Open a pyserial port in a thread; close it again if the wait is cut short."""
    loop = asyncio.get_running_loop()
    opening = loop.run_in_executor(None, _open_port, url, line)
    try:
        async with asyncio.timeout(timeout):
            return await asyncio.shield(opening)
    except BaseException:
        # The thread cannot be interrupted, so a port that it opens later is closed then.
        opening.add_done_callback(_close_unwanted)
        raise


def _close_unwanted(opening: asyncio.Future[Any]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()


def _open_port(url: str, line: Line) -> Any:
    port = serial.serial_for_url(
        url,
        do_not_open=True,
        baudrate=line.baudrate,
        # A pty has no parity, and the C library reports a request for one as an error.
        parity="N" if os.path.realpath(url).startswith("/dev/pts/") else line.parity,
        stopbits=line.stopbits,
        timeout=0,
    )
    if "://" not in url:
        # TIOCEXCL: two masters on the same line would garble each other's answers.
        port.exclusive = True
    try:
        port.open()
    except termios.error as error:
        # termios.error is not an OSError, but has the same arguments.
        raise OSError(*error.args) from error
    if hasattr(port, "set_low_latency_mode"):
        # Sets the latency timer of FTDI adapters to 1 ms; other adapters raise an error.
        with contextlib.suppress(Exception):
            port.set_low_latency_mode(True)
    return port


def explained(name: str, error: OSError | ValueError) -> BusError:
    """Return the `BusError` for an error while opening a port, with a hint for the user."""
    code, cause = getattr(error, "errno", None), error.__context__
    if code is None and isinstance(cause, termios.error):  # pyserial's error has no errno then
        code = cause.args[0]
    if code in (errno.EAGAIN, errno.EBUSY):
        return BusBusy(name, "another program has it open; `rtee doctor` names it")
    # Before `_CAUSES`, since the numbers of its errors are not those of `errno`.
    if isinstance(error, socket.gaierror):
        return BusBroken(name, "the host name is unknown; use the IP address")
    return BusBroken(name, _CAUSES.get(code, f"cannot be opened: {error}"))


async def ended(transport: asyncio.Transport) -> None:
    """Wait until a transport that was aborted has closed its port."""
    if isinstance(transport, SerialTransport):
        await asyncio.shield(transport.given_back)
    else:
        await asyncio.sleep(0)  # its next callback closes the file descriptor


class SerialTransport(serial_asyncio.SerialTransport):  # type: ignore[misc]
    """pyserial-asyncio's transport with less latency, and without log entries for lost adapters.

    It writes at once instead of in the next iteration of the event loop, and reads by one system
    call. It closes the port in a thread, since closing may take the kernel some time, in particular
    after the adapter was unplugged, and must not delay exchanges with other devices.

    Attributes:
        given_back: Future that is done when the port is closed and can be opened again.
    """

    _serial: Any
    _protocol: Any

    def __init__(
        self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, port: Any
    ) -> None:
        self.given_back: asyncio.Future[None] = loop.create_future()
        super().__init__(loop, protocol, port)

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Write as many bytes as the port accepts now, and the rest later."""
        if self._closing:
            return
        if not self._write_buffer:
            try:
                # pyserial-asyncio would wait for the next iteration of the event loop, which takes
                # longer than the bytes of a request.
                data = data[os.write(self._serial.fd, data) :]
            except (BlockingIOError, InterruptedError):
                pass
            except OSError as error:
                self._abort(error)
                return
        if data:
            super().write(bytes(data))

    def read_now(self) -> None:
        """Pass received bytes to the protocol without waiting for the event loop."""
        if self._serial is None or self._closing:
            return
        with contextlib.suppress(OSError):  # the next write to a port that vanished reports it
            if self._serial.in_waiting:
                self._read_ready()

    def _read_ready(self) -> None:
        try:
            data = os.read(self._serial.fd, _PIECE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._close(exc=error)
            return
        if data:
            self._protocol.data_received(data)
        elif self._hung_up():  # no data and no hang-up: `read_now` took the bytes
            self._close(exc=OSError("the port vanished"))

    def _hung_up(self) -> bool:
        # With an empty event mask, poll reports only a hang-up or an error.
        poll = select.poll()
        poll.register(self._serial.fd, 0)
        return bool(poll.poll(0))

    def _fatal_error(self, exc: Exception, message: str = "") -> None:
        self._abort(exc)

    def _call_connection_lost(self, exc: Exception | None) -> None:
        port, self._serial = self._serial, None
        if port is None:  # already called
            return
        self._write_buffer.clear()
        try:
            self._protocol.connection_lost(exc)
        finally:
            self._protocol = None
            closing = self._loop.run_in_executor(None, _close, port)
            closing.add_done_callback(lambda _: self.given_back.set_result(None))


def _close(port: Any) -> None:
    # Closing waits for unsent output, maybe long on a dead line, so discard the output first.
    with contextlib.suppress(Exception):
        port.reset_output_buffer()
    with contextlib.suppress(Exception):
        port.close()


class ThreadTransport(asyncio.Transport):
    """A transport for pyserial ports without a file descriptor (``rfc2217://``), with threads."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, port: Any
    ) -> None:
        super().__init__()
        self._loop = loop
        self._protocol = protocol
        self._port = port
        self._closing = False
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="serial-write")
        # A read of pyserial's RFC 2217 port cannot be interrupted, so the thread reads with a
        # timeout.
        port.timeout = _POLL
        self._reader = threading.Thread(target=self._read, name="serial-read", daemon=True)
        # After the constructor has returned, as in the transports of asyncio.
        loop.call_soon(protocol.connection_made, self)
        self._reader.start()

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Pass bytes to the writing thread."""
        if not self._closing:
            self._writer.submit(self._write, bytes(data))

    def close(self) -> None:
        """Stop both threads, close the port and notify the protocol."""
        self._finish(None)

    def abort(self) -> None:
        """Close at once, like `close`."""
        self._finish(None)

    def is_closing(self) -> bool:
        """Return whether the transport is closed or closing."""
        return self._closing

    def _write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, ValueError) as error:
            self._post(self._finish, error)

    def _read(self) -> None:
        try:
            while not self._closing:
                data = self._port.read(max(1, min(self._port.in_waiting, _PIECE)))
                if data:
                    self._post(self._deliver, data)
        except (OSError, ValueError, TypeError) as error:
            self._post(self._finish, error if isinstance(error, OSError) else OSError(str(error)))
        finally:
            with contextlib.suppress(Exception):
                self._port.close()

    def _post(self, function: Callable[[Any], None], value: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop may be gone
            self._loop.call_soon_threadsafe(function, value)

    def _deliver(self, data: bytes) -> None:
        if not self._closing:
            self._protocol.data_received(data)

    def _finish(self, error: Exception | None) -> None:
        if self._closing:
            return
        self._closing = True
        self._writer.shutdown(wait=False, cancel_futures=True)
        self._loop.call_soon(self._protocol.connection_lost, error)
