"""Lets the trials and plans that a GUI starts wait at a gate: see `conftest.GATE`."""

import os
import sys
import time

gate = os.environ.get("RTEE_TEST_GATE")
while gate and "rtee.trials" in sys.orig_argv and os.path.exists(gate):
    time.sleep(0.02)
