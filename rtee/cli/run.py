"""`rtee run`: run one hand or several."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rtee.cli._common import (
    EmulatedOption,
    FrictionOption,
    HandsArgument,
    IdealOption,
    VerboseOption,
    check_files,
    log_to_stderr,
    named_values,
)
from rtee.errors import ConfigError, needing_extra
from rtee.hand.config_schema import Lines


def _complete_driver(incomplete: str) -> list[str]:
    from rtee.drivers.registry import driver_names

    return [name for name in ("devices", *driver_names()) if name.startswith(incomplete)]


def _companions(gui: bool, hands: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    if not gui:
        return ()
    from rtee.loop.shutdown_signals import beside_this_run

    with needing_extra("the GUI", "gui"):
        if importlib.util.find_spec("viser") is None:  # importing it would take a second
            # As the import would; `needing_extra` turns it into a sentence.
            raise ModuleNotFoundError
    # The name of a hand given by its folder is not known yet; the GUI shows the first that runs.
    shown = [] if Path(hands[0]).exists() else [hands[0]]
    return (beside_this_run("gui", *shown),)


def _scene(
    driver: str | None, shape: str | None, gravity: float | None, friction: float | None
) -> dict[str, object]:
    """Return object, gravity [m/s²] and friction as options of the driver ``mujoco``."""
    given = {"object": shape, "gravity": gravity, "friction": friction}
    if driver == "mujoco":
        return {name: value for name, value in given.items() if value is not None}
    for name in ("gravity", "friction"):
        if given[name] is not None:
            raise ConfigError(f"--{name} needs --driver mujoco")
    return {}


def run(
    hands: HandsArgument,
    *,
    driver: Annotated[str | None, typer.Option(autocompletion=_complete_driver)] = None,
    option: list[str] | None = None,
    object_: str | None = None,
    gravity: float | None = None,
    friction: FrictionOption = None,
    emulated: EmulatedOption = False,
    ideal: IdealOption = False,
    home: bool = False,
    rate: float | None = None,
    realtime: bool = False,
    log: Path | None = None,
    no_log: bool = False,
    gui: bool = False,
    ros2: bool = False,
    metrics: str = "",
    events: Lines | None = None,
    duration: float | None = None,
    trace: bool = False,
    verbose: VerboseOption = False,
) -> None:
    """Run one hand or several until Ctrl-C: take goals, drive the devices, record everything.

    Arguments and options:
        driver: kinematic, devices (those of hand.yaml), or a driver's name.
        option (NAME=VALUE): Option of the driver; overrides hand.yaml.
        object_ (SHAPE): Object between the fingers. With --emulated: 50mm, or 0.4 of their closing
            travel. With --driver mujoco: box:WxDxH, cylinder:RxH, sphere:R, capsule:RxL [m], drill,
            or a mesh.
        gravity (-100.0..100.0; A): With --driver mujoco: along z [m/s²], -9.81 unless given.
        home: Home devices that need it, which moves them all the way.
        rate: Ticks per second, 1 to 2000.
        realtime: Ask for real-time scheduling.
        log (DIR): Folder for the recordings.
        no_log: Write no recordings; the time before a fault is saved only if --log or hand.yaml
            gives a folder.
        gui: Open the hands in the browser.
        ros2: Offer the hands as ROS 2 nodes.
        metrics (HOST:PORT): Serve metrics for Prometheus there.
        events: Write each event as a line of JSON, or to the journal.
        duration (0.0..; S): End after this many seconds.
        trace: Record the bytes on all buses.
    """
    from rtee.remote.directory import about_to_run

    # First, since importing the rest takes a second, and clients should wait for the hands.
    with about_to_run([Path(hand).name for hand in hands]):
        import anyio

        from rtee.loop.realtime import backend_options
        from rtee.running.run import RunOptions, run_hands

        check_files()
        if driver is not None and not driver.strip():
            raise ConfigError("--driver is empty; give kinematic, devices or a driver's name")
        log_to_stderr(verbose)
        if ros2:
            from rtee.ros2.session import check_environment

            check_environment()
        driver_options = named_values(option or [], "--option", "the option")
        driver_options |= _scene(driver, object_, gravity, friction)
        options = RunOptions(
            driver=driver,
            emulated=emulated,
            ideal=ideal,
            # There, the object is an option of the driver, see `_scene`.
            object_in_hand=None if driver == "mujoco" else object_,
            driver_options=driver_options,
            home=home,
            rate=rate,
            realtime=realtime,
            log=log,
            record=not no_log,
            duration=duration,
            trace=trace,
            companions=_companions(gui, hands),
            ros2=ros2,
            metrics=metrics,
            events=events,
        )

        async def main() -> int:
            def say(line: str) -> None:
                # Flushed, since a program that reads the output may wait for a line.
                print(line, flush=True, file=sys.stderr if events is Lines.STDOUT else sys.stdout)

            return await run_hands(hands, options, say=say)

        raise typer.Exit(anyio.run(main, backend_options=backend_options()))
