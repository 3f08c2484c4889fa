from __future__ import annotations

import subprocess
import sys


def test_the_messages_need_no_rosbags_at_run_time() -> None:
    code = "import sys, rtee.messages; print('rosbags' in sys.modules, 'mcap' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert out.stdout.split() == ["False", "False"]
