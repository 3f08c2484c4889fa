"""Stands for a command that runs elsewhere: see `rtee_process`. Imports next to nothing."""

import array
import json
import os
import signal
import socket
import struct
import sys

FORWARDED = ("SIGINT", "SIGTERM", "SIGQUIT", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGTSTP")
HEAD = struct.Struct("!I")
"""Length of the request that follows [bytes]; the three streams come with it."""


def stand_for(place: str, words: list[str]) -> None:
    """Have a command run, hand on signals, and end as it does."""
    signals = [getattr(signal, name) for name in FORWARDED]
    # None of them may be lost before it is known to whom it goes.
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    mask = os.umask(0)
    os.umask(mask)
    asked = {"words": words, "cwd": os.getcwd(), "env": dict(os.environ), "umask": mask}
    asked["ignored"] = [int(s) for s in signals if signal.getsignal(s) is signal.SIG_IGN]
    request = json.dumps(asked).encode()
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(place)
        streams = array.array("i", [0, 1, 2])
        link.sendmsg([HEAD.pack(len(request))], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
        link.sendall(request)
        child = HEAD.unpack(exactly(link, HEAD.size))[0]
        for number in signals:
            signal.signal(number, lambda received, _: os.kill(child, sent(received)))
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
        status = os.waitstatus_to_exitcode(HEAD.unpack(exactly(link, HEAD.size))[0])
    if status < 0:
        if -status != signal.SIGKILL:
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


def sent(received: int) -> int:
    """Return the signal that the command gets for one that this process has got."""
    return signal.SIGSTOP if received == signal.SIGTSTP else received


def exactly(link: socket.socket, size: int) -> bytes:
    found = b""
    while len(found) < size:
        if not (more := link.recv(size - len(found))):
            raise ConnectionError("the process that runs commands has ended")
        found += more
    return found


if __name__ == "__main__":
    stand_for(sys.argv[1], sys.argv[2:])
