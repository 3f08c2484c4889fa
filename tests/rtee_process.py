"""`rtee`, and programs that import it, in a process of their own that takes no time to start.

`RTEE` is used as ``(sys.executable, "-m", "rtee")`` is, and `PYTHON` as ``(sys.executable,)`` is,
before ``-c CODE`` or ``-m MODULE``. The first command starts a process that imports what commands
need; each command then runs in a fork of that, with the folder, environment, streams, signals and
exit status of the process that stands for it. So a command takes 0.05 s of processor time less its
own work, instead of half a second and more. All processes of ``pytest -n`` share one.

Use a real process where how `rtee` is imported is what is tested, or limits of the process are, or
its identifier. Stop a fork by SIGTSTP instead of SIGSTOP, which only what stands for it would get.
After SIGKILL, wait for the end of its streams: it goes a moment later than what stands for it.
"""

from __future__ import annotations

import atexit
import json
import os
import runpy
import selectors
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
from pathlib import Path
from types import ModuleType
from typing import IO, NoReturn

from rtee_client import HEAD, exactly

# --- what runs them ------------------------------------------------------------------------------


def serve(listening: socket.socket) -> None:
    """Run commands, each in a fork, until standard input ends."""
    awake, wake = os.pipe2(os.O_NONBLOCK)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    running: dict[int, socket.socket] = {}
    ready = False
    with selectors.DefaultSelector() as waiting:
        waiting.register(0, selectors.EVENT_READ)
        waiting.register(awake, selectors.EVENT_READ)
        waiting.register(listening, selectors.EVENT_READ)
        while True:
            for key, _ in waiting.select():
                if key.fd == 0:
                    for child in running:
                        os.kill(child, signal.SIGKILL)
                    return
                if key.fd == awake:
                    os.read(awake, 4096)
                    for child in list(running):
                        ended, status = os.waitpid(child, os.WNOHANG)
                        if ended:
                            link = running.pop(child)
                            if link.fileno() in waiting.get_map():  # nobody has killed it
                                waiting.unregister(link)
                            _tell(link, status)
                            link.close()
                elif key.fileobj is listening:
                    link, _ = listening.accept()
                    request = _received(link)
                    if request is None:
                        link.close()
                        continue
                    if not ready:
                        _import()
                        ready = True
                    asked, streams = request
                    child = os.fork()
                    if not child:
                        signal.set_wakeup_fd(-1)
                        waiting.close()
                        for each in (link, listening, *running.values()):
                            each.close()
                        os.close(awake)
                        os.close(wake)
                        _run(asked, streams)
                    for stream in streams:
                        os.close(stream)
                    running[child] = link
                    waiting.register(link, selectors.EVENT_READ)
                    _tell(link, child)
                else:  # what stands for it has been killed
                    for child, link in running.items():
                        if link is key.fileobj:
                            os.kill(child, signal.SIGKILL)
                    waiting.unregister(key.fileobj)


def _tell(link: socket.socket, number: int) -> None:
    try:
        link.sendall(HEAD.pack(number))
    except OSError:
        pass  # nobody waits any more


def _received(link: socket.socket) -> tuple[dict[str, object], list[int]] | None:
    try:
        head, streams, _, _ = socket.recv_fds(link, HEAD.size, 3)
        return json.loads(exactly(link, HEAD.unpack(head)[0])), streams
    except (OSError, struct.error):
        return None


def _import() -> None:
    """Import what most commands need; nothing here starts a thread or looks at the environment."""
    import gc
    import importlib

    from rtee.cli.main import COMMANDS

    for module, _ in COMMANDS.values():
        importlib.import_module(module.partition(":")[0])
    names = "rtee.running.run rtee.loop.handloop rtee.remote.client rtee.remote.server "
    names += "rtee.log.recorder rtee.hand.load rtee.actions.library rtee.extract.jobs "
    names += "rtee.drivers.kinematic.driver rtee.buses.pool "
    names += "anyio._backends._asyncio pinocchio coal mujoco"
    for name in names.split():
        try:
            importlib.import_module(name)
        except ImportError:
            pass
    gc.collect()
    gc.freeze()  # forks share these objects as long as nobody touches them


def _run(asked: dict[str, object], streams: list[int]) -> NoReturn:
    """Become a command, and end."""
    status = 70
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number in asked["ignored"]:  # type: ignore[attr-defined]
            signal.signal(number, signal.SIG_IGN)
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        os.chdir(str(asked["cwd"]))
        os.umask(int(asked["umask"]))  # type: ignore[call-overload]
        os.environ.clear()
        os.environ.update(asked["env"])  # type: ignore[call-overload]
        kind, what, *words = asked["words"]  # type: ignore[misc]
        inherited = [each for each in os.environ.get("PYTHONPATH", "").split(os.pathsep) if each]
        sys.path[:0] = [os.getcwd(), *inherited]
        for folder in inherited:  # as the interpreter does when it starts
            if (own := Path(folder) / "sitecustomize.py").is_file():
                runpy.run_path(str(own))
        _open_streams()
        status = _ended(kind, what, words)
        threading._shutdown()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _ended(kind: str, what: str, words: list[str]) -> int:
    """Run code or a module, and return the exit status, as the interpreter does."""
    try:
        _execute(kind, what, words)
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        return 1
    return 0


def _execute(kind: str, what: str, words: list[str]) -> None:
    sys.argv = [what, *words]
    if (kind, what) == ("-m", "rtee"):  # which is imported already
        from rtee.cli import main

        main()
    elif kind == "-m":
        sys.modules.pop(what, None)  # runpy warns of one that is imported already
        runpy.run_module(what, run_name="__main__", alter_sys=True)
    else:
        sys.argv[0] = kind
        main_module = sys.modules["__main__"] = ModuleType("__main__")
        exec(compile(what, "<string>", "exec"), main_module.__dict__)


def _open_streams() -> None:
    now = bool(os.environ.get("PYTHONUNBUFFERED"))

    encoding = os.environ.get("PYTHONIOENCODING", "utf-8")

    def text(number: int, mode: str, errors: str) -> IO[str]:
        stream = open(number, mode, encoding=encoding, errors=errors, closefd=False)  # noqa: SIM115
        stream.reconfigure(write_through=now)  # type: ignore[attr-defined]
        return stream

    sys.stdin = text(0, "r", "strict")
    sys.stdout = text(1, "w", "strict")
    sys.stderr = text(2, "w", "backslashreplace")
    sys.stderr.reconfigure(line_buffering=True)  # type: ignore[attr-defined]


# --- how tests call it ---------------------------------------------------------------------------


_PLACE = "TESTS_OF_RTEE_COMMANDS"
"""Variable of the environment: where the process listens that runs the commands of these tests."""


def _started() -> str:
    """Start the process that runs the commands of these tests; return where it listens.

    The processes of ``pytest -n`` find the one of the process that started them.
    """
    if _PLACE in os.environ:
        return os.environ[_PLACE]
    folder = tempfile.TemporaryDirectory(prefix="rtee-tests-")
    place = str(Path(folder.name) / "commands")
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(place)
    listening.listen(64)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("RTEE_")}
    server = subprocess.Popen(
        [sys.executable, __file__, str(listening.fileno())],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        pass_fds=[listening.fileno()],
        env=environment,
        start_new_session=True,
    )
    listening.close()

    def end() -> None:
        assert server.stdin is not None
        server.stdin.close()
        server.wait()
        folder.cleanup()

    atexit.register(end)
    os.environ[_PLACE] = place
    return place


def python(*words: str) -> list[str]:
    """Return a command line as `rtee.child.python` does, which tests put in its place."""
    return [*PYTHON, *words]


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
else:
    PYTHON = (sys.executable, "-IS", str(Path(__file__).with_name("rtee_client.py")), _started())
    """The command line of Python in a warm process, before ``-c CODE`` or ``-m MODULE``."""

    RTEE = (*PYTHON, "-m", "rtee")
    """The command line of `rtee` in a warm process."""
