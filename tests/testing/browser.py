"""A headless Chromium for tests and screenshots of the GUI; software WebGL, loopback network."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from rtee.errors import ConfigError

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
"""Names of the program on the path; ``RTEE_BROWSER`` names another program."""

_ARGUMENTS: Final = (
    # Chromium refuses to run as root with its sandbox, as in containers.
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    # Nothing but the page under test may use the network.
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # WebGL in software, since computers that run tests seldom have a graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Pages are put together by the processor itself, not by its copy of a graphics card.
    "--disable-gpu-compositing",
    "--disable-gpu-rasterization",
    "--disable-accelerated-2d-canvas",
)
_PATIENCE: Final = 60_000.0
"""Longest time for one action in the page [ms]; software WebGL is slow on a busy computer."""


def find_browser() -> str | None:
    """Return the path of a Chromium, or ``None`` if there is none."""
    for name in (os.environ.get("RTEE_BROWSER", ""), *NAMES):
        if name and (path := shutil.which(name)):
            return path
    return None


@contextlib.contextmanager
def browser(
    width: int = 800, height: int = 600, *, scale: float = 1.0, arguments: Sequence[str] = ()
) -> Iterator[BrowserContext]:
    """Start a headless browser with a fresh profile for as long as the context lasts.

    Args:
        width: Width of the windows [CSS px].
        height: Height of the windows [CSS px].
        scale: Device pixels per CSS pixel; a smaller value is faster without a graphics card.
        arguments: Further command line arguments of the program.

    Raises:
        ConfigError: if there is no Chromium, or Playwright is not installed.
    """
    program = find_browser()
    if program is None:
        raise ConfigError("no Chromium was found; install it, or name it in RTEE_BROWSER")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise ConfigError(f"a browser is driven by Playwright ({error}); install it") from error
    with (
        tempfile.TemporaryDirectory(prefix="rtee-browser-", ignore_cleanup_errors=True) as profile,
        sync_playwright() as playwright,
    ):
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=program,
            headless=True,
            args=[*_ARGUMENTS, *arguments],
            viewport={"width": width, "height": height},
            device_scale_factor=scale,
        )
        context.set_default_timeout(_PATIENCE)
        try:
            yield context
        finally:
            context.close()
