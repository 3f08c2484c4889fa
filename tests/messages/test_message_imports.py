from __future__ import annotations

import subprocess
import sys


def test_the_messages_need_no_rosbags_at_run_time() -> None:
    code = "import sys; from rtee.messages import *; print({'rosbags', 'mcap'} & {*sys.modules})"
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert out.stdout.strip() == "set()"
