"""Lets hands and GUIs be found alive however long a busy computer lets their threads wait.

And lets the trials and plans that a GUI starts wait at a gate: see `conftest.GATE`. Such a GUI
keeps its priority: stood back, it would wait for whatever else a computer does. It draws for eyes
less often than 30 times a second.
"""

import os
import sys
import time

if session := sys.modules.get("rtee.remote.session"):
    session._COMMON["transport/link/tx/lease"] = 30_000  # instead of 1 s

if gate := os.environ.get("RTEE_TEST_GATE"):
    os.nice = lambda increment: 0
    os.sched_setscheduler = lambda pid, policy, param: None

trials = "rtee.trials" in sys.orig_argv
if gate and not trials:
    from rtee.gui import app, watch

    app._DRAW_PERIOD = watch._PERIOD = 0.1

while gate and trials and os.path.exists(gate):
    time.sleep(0.02)
