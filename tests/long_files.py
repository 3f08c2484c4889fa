"""Write ``long_files.txt``: how long the tests of each file take, from a report of pytest.

python tests/long_files.py REPORT.xml    (as ``pytest --junitxml`` writes it)
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree as ET

MOMENT = 1.5
"""What takes less [s], beside five others, stands in no line, and belongs to ``make quick``."""

TESTS = Path(__file__).parent


def file_of(name: str) -> str:
    """Return the file of a test, from the dotted name of its module and perhaps its class."""
    path = TESTS.parent / name.replace(".", "/")
    while not path.with_suffix(".py").is_file():
        path = path.parent
    return path.with_suffix(".py").relative_to(TESTS.parent).as_posix()


def main() -> None:
    seconds: Counter[str] = Counter()
    for case in ET.parse(sys.argv[1]).iter("testcase"):
        seconds[file_of(case.attrib["classname"])] += float(case.attrib["time"])  # type: ignore[assignment]
    lines = [f"{took:6.1f} {name}\n" for name, took in seconds.most_common() if took >= MOMENT]
    (TESTS / "long_files.txt").write_text("".join(lines))


if __name__ == "__main__":
    main()
