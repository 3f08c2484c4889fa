"""Check the settings of this computer that matter to a fast loop."""

from __future__ import annotations

import os
import platform
import resource
import shutil
from pathlib import Path

from rtee.child import processors
from rtee.drivers.diagnosis.checks import Check, ok, warning
from rtee.hand.config_schema import RealtimeSettings

_PRIORITY = RealtimeSettings().priority
"""Default real-time priority of a hand's loop."""

LIMITS = "/etc/security/limits.d/rtee.conf"
"""File that raises the user's limits (pam_limits)."""


def check_machine(root: Path = Path("/")) -> list[Check]:
    """Check this computer's settings; its ``sys`` is below ``root``."""
    return [
        ok("Python", platform.python_version()),
        _kernel(root),
        _governor(root),
        _priority(),
        _memory(),
        _processors(),
        _disk(),
    ]


def _kernel(root: Path) -> Check:
    release, version = platform.release(), platform.version()
    # Only this file identifies older real-time kernels.
    realtime = root / "sys/kernel/realtime"
    if "PREEMPT_RT" in version or _read(realtime) == "1":
        return ok("kernel", f"{release}, real-time")
    if "PREEMPT" in version:
        return ok("kernel", f"{release}, preemptible (a PREEMPT_RT kernel is steadier still)")
    return warning("kernel", f"{release}, not preemptible", "sudo apt install linux-image-rt-amd64")


def _governor(root: Path) -> Check:
    files = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = {_read(file) for file in files}
    if not governors:
        return ok("CPU governor", "none: the clock is not scaled")
    if governors == {"performance"}:
        return ok("CPU governor", "performance")
    return warning(
        "CPU governor",
        f"{', '.join(sorted(governors))}, which lowers the clock rate between ticks",
        "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
    )


def _priority() -> Check:
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if os.geteuid() == 0 or soft == resource.RLIM_INFINITY or soft >= _PRIORITY:
        return ok("real-time priority", "allowed")
    return warning(
        "real-time priority",
        f"allowed up to {soft}, `rtee run --realtime` asks for {_PRIORITY}",
        f"echo '{_user()} - rtprio 90' | sudo tee -a {LIMITS}   # then log in again",
    )


def _memory() -> Check:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if os.geteuid() == 0 or soft == resource.RLIM_INFINITY:
        return ok("locked memory", "unlimited")
    return warning(
        "locked memory",
        f"limited to {soft // 1024} KiB",
        f"echo '{_user()} - memlock unlimited' | sudo tee -a {LIMITS}   # then log in again",
    )


def _processors() -> Check:
    count = processors()
    if count < 2:
        return warning(
            "processors", "one", "a loop at 1 kHz needs a second CPU for everything else"
        )
    load = os.getloadavg()[0]
    if load > count:
        return warning("processors", f"{count}, load {load:.1f}", "end other programs")
    return ok("processors", f"{count}, load {load:.1f}")


def _disk() -> Check:
    free = shutil.disk_usage(".").free / 1e9
    if free < 1.0:
        return warning("disk", f"{free:.1f} GB free here for recordings", "free some, or use --log")
    return ok("disk", f"{free:.0f} GB free here for recordings")


def _user() -> str:
    return os.environ.get("USER") or "<user>"


def _read(file: Path) -> str:
    try:
        return file.read_text("ascii").strip()
    except (OSError, ValueError):
        return ""
