"""Every command of `rtee` as somebody without any extra tries it, and what comes of it."""

from __future__ import annotations

import os
import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path

from rtee_process import RTEE

from rtee.errors import install_line

URDF = """<robot name="claw">
  <link name="palm"><collision><geometry><box size="0.08 0.03 0.02"/></geometry></collision></link>
  {jaws}
</robot>
"""
JAW = """<link name="{name}"><collision><origin xyz="0 0 0.03"/>
    <geometry><box size="0.01 0.02 0.06"/></geometry></collision></link>
  <joint name="{name}_joint" type="revolute"><parent link="palm"/><child link="{name}"/>
    <origin xyz="{x} 0 0.01"/><axis xyz="0 {axis} 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="5"/></joint>
"""
TRIG = """[left]:
  PrimitiveType: 3
  ActionName: trig
  JointsInvolvedCount:
    left_joint: 1
    right_joint: 0
  ActionState_1:
    JointPos:
      left_joint: [0.5]
      right_joint: [0]
"""


@dataclass(frozen=True)
class Case:
    """A command line, its exit status, and what it says, on either stream."""

    line: str
    says: str = ""
    status: int = 0

    @property
    def words(self) -> list[str]:
        return shlex.split(self.line)

    @property
    def command(self) -> str:
        return self.words[0]


def needs(line: str, extra: str) -> Case:
    """A command that needs an extra; all say it in the same words."""
    return Case(line, f"needs the extra '{extra}': {install_line(extra)}", 2)


DEVICES = (
    "allegro",
    "cia402_gripper",
    "dagana",
    "leap_hand",
    "onrobot_3fg15",
    "qb_softhand",
    "robotiq_2f_85",
    "robotiq_3f",
    "schunk_svh",
)
"""Hands of every bus that needs no extra."""

OFFLINE = (
    Case("--version", "rtee "),
    Case("--help", "new-driver"),
    Case("hands", "schunk_svh"),
    needs("new nipper --urdf claw.urdf", "extract"),
    Case("new copy --from claw", "a copy of"),
    needs("extract claw --save", "extract"),
    needs("extract --urdf claw.urdf", "extract"),
    needs("grasp-plan claw --object box:0.02x0.02x0.03", "extract"),
    Case("export claw --urdf --srdf exported", "written to exported/claw.urdf"),
    needs("export claw --mjcf exported", "sim"),
    Case("actions claw", "PinchTight"),
    needs("openings claw --save", "extract"),
    Case("openings robotiq_2f_85", "PinchTight"),
    Case("compose half PinchTight:left,right*0.5 --hand claw", "half"),
    Case("time twice half:after=0.1 PinchTight:left,right --hand claw", "twice"),
    Case("generic point left_joint=0.2 --hand claw", "point"),
    Case("import foreign --hand claw --out imported", "1 actions"),
    Case("new-driver my_gripper", "my_gripper/driver.py"),
    Case("scan", "port"),
    Case("doctor", "processors"),
    Case("doctor --files pc", "pc/rtee@.service"),
    Case("deploy plan robotiq_2f_85 --program /opt/rtee/bin/rtee --root .", "Type=notify"),
    Case("deploy install robotiq_2f_85 --dry-run --root . --program /opt/rtee/bin/rtee", "new: "),
    needs("secure init robotiq_2f_85", "secure"),
    needs("ros2 list", "ros2"),
    needs("mcp claw", "mcp"),
    needs("retarget claw", "retarget"),
    Case("agent admit", "needs a person at a terminal", 2),
    Case("doctor claw", "no stored pinch of two fingertips lies there"),
    Case("doctor robotiq_2f_85", "/dev/ttyUSB0", 1),
    Case("set-id 3 --port /nowhere", "there is no such port", 1),
    Case("locate robotiq_2f_85 --emulated --yes --times 1", ""),
    Case("calibrate robotiq_2f_85 --emulated --yes --out calibration.yaml", ""),
    needs("try claw PinchTight left right", "sim"),
    needs("compare claw --objects box:0.02x0.02x0.03", "sim"),
    needs("metrics", "metrics"),
    Case("router", "give the SITE", 2),
    needs("run claw --driver mujoco --duration 0.1", "sim"),
    needs("run heri_ii --driver heri_ethercat --duration 0.1", "ethercat"),
    needs("run claw --gui --duration 0.1", "gui"),
    *(
        Case(f"run {hand} --driver devices --emulated --duration 0.3 --no-log", "0 goals")
        for hand in DEVICES
    ),
    Case("status", "no hand is running", 1),
)
"""Without any extra, and without a running hand."""

EXTRACTED = (
    Case("new nipper --urdf claw.urdf", "nipper.srdf"),
    Case("extract nipper --save", "PinchTight"),
    Case("doctor nipper", "no two fingertips pinch there"),
    Case("grasp-plan nipper --object box:0.02x0.02x0.03", "to do it: rtee do"),
    needs("grasp-plan nipper --object box:0.02x0.02x0.03 --check", "sim"),
    needs("extract nipper --report nipper.html", "plot"),
    needs("try nipper PinchTight left right", "sim"),
    needs("new other --mjcf other.xml", "sim"),
    needs("new other --urdf other.urdf.xacro", "xacro"),
)
"""With the extra ``extract``."""

ONLINE = (
    Case("do PinchTight left right --intensity 0.3", "reached"),
    Case("state --once", "left_joint"),
    Case("status --json", '"profile": '),
    Case("open", "reached"),
    Case("info", "left_joint"),
    Case("gains", "time_constant"),
    Case("grasp --width 30mm", "mm", 1),
    Case("touch left right", "mm", 1),
    Case("stream play none.csv", "none.csv: ", 2),
    needs('teleop --gamepad "rt=PinchTight left right"', "teleop"),
    Case("stop", ""),
    Case("recover", ""),
    needs("gui claw", "gui"),
)
"""While `rtee run claw` runs."""

RECORDED = (
    Case("log info logs", "PinchTight"),
    Case("log replay --check logs", "the same, bit for bit"),
    Case("log export logs out --format csv", "out"),
    needs("log export logs parquet --format parquet", "plot"),
    needs("log plot logs", "plot"),
    Case("run claw --driver replay --option file=claw.mcap --duration 0.3 --no-log", "0 goals"),
)
"""When it has ended."""

LASTING = (Case("emulate robotiq_2f --link ./port", "port"),)
"""Commands that go on until Ctrl-C."""


def write_hand(folder: Path) -> None:
    """Make a hand with two jaws and its actions, and an action of ROS End-Effector for it.

    What runs this has the extra ``extract``; the robot PC that the hand is taken to may not.
    """
    jaws = JAW.format(name="left", x=-0.035, axis=1) + JAW.format(name="right", x=0.035, axis=-1)
    (folder / "claw.urdf").write_text(URDF.format(jaws=jaws))
    (folder / "foreign").mkdir()
    (folder / "foreign" / "trig.yaml").write_text(TRIG)
    for line in ("new claw --urdf claw.urdf", "extract claw --save"):
        words = [*RTEE, *line.split()]
        subprocess.run(words, cwd=folder, env=with_rtee(), check=True, capture_output=True)


def with_rtee() -> dict[str, str]:
    """Return the environment of processes that import rtee from this checkout."""
    repository = str(Path(__file__).parents[2])
    inherited = os.environ.get("PYTHONPATH", "")
    path = os.pathsep.join(filter(None, (repository, inherited)))
    return {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}


def wrong(case: Case, status: int, said: str) -> str:
    """Return what is wrong with how a command went; nothing if it went as it should."""
    if status == case.status and case.says in said and "Traceback" not in said:
        return ""
    return f"rtee {case.line}: status {status}, not {case.status} with '{case.says}':\n{said}"
