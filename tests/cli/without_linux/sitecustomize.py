"""Hides what only Linux has, as on a Mac. Python imports it at its start, from ``PYTHONPATH``."""

from __future__ import annotations

import builtins
import ctypes
import io
import os
import select
import socket
import sys

for module, names in (
    (select, ("epoll",)),
    (os, ("pipe2", "eventfd", "memfd_create", "pidfd_open", "posix_fadvise", "posix_fallocate")),
    (os, [name for name in dir(os) if name.startswith("sched_") and name != "sched_yield"]),
    (socket, ("SO_PEERCRED", "AF_PACKET", "AF_CAN", "AF_NETLINK", "SOCK_CLOEXEC", "SOCK_NONBLOCK")),
):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)

_found = ctypes.CDLL.__getattr__


def _function(library: ctypes.CDLL, name: str) -> object:
    if name.startswith(("timerfd_", "sched_", "prctl", "mall", "pthread_setaff", "epoll")):
        raise AttributeError(name)
    return _found(library, name)


ctypes.CDLL.__getattr__ = _function  # type: ignore[method-assign]


def _without_proc(function):  # type: ignore[no-untyped-def]
    def call(path, *words, **named):  # type: ignore[no-untyped-def]
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(("/proc", "/sys")):
            raise FileNotFoundError(2, "No such file or directory", os.fspath(path))
        return function(path, *words, **named)

    return call


builtins.open = io.open = _without_proc(open)
for name in ("open", "stat", "listdir", "scandir", "readlink"):
    setattr(os, name, _without_proc(getattr(os, name)))
sys.platform = "darwin"
