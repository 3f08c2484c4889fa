"""The benchmarks' command lines, as the documentation has them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

PARSE = """
import argparse, json, runpy, sys
from pathlib import Path

class Parsed(Exception):
    pass

parse = argparse.ArgumentParser.parse_args

def parse_only(self, args=None, namespace=None):
    parse(self, args, namespace)
    raise Parsed

argparse.ArgumentParser.parse_args = parse_only
sys.path.insert(0, "benchmarks")
path = list(sys.path)
for words in json.loads(sys.argv[1]):
    sys.argv, sys.path[:] = words, path
    try:
        runpy.run_path(words[0], run_name="__main__")
    except Parsed:
        continue
    except SystemExit:
        pass
    print(*words)
"""
"""Reads command lines, starts nothing, and prints those that are wrong."""


def documented(text: str) -> list[list[str]]:
    """Return the command lines of benchmarks in a text; what is in brackets is taken along."""
    return [
        re.sub(r"[\[\]]", "", line).split()
        for line in re.findall(r"python (benchmarks/\w+\.py[^`\n]*)", text)
    ]


@pytest.mark.heavy
def test_documented_command_lines_are_understood(repository: Path) -> None:
    pytest.importorskip("mujoco")
    pages = sorted((repository / "docs" / "benchmarks").glob("*.md"))
    lines = documented("\n".join(page.read_text() for page in pages))
    lines += [[f"benchmarks/{name}.py"] for name in ("gui", "loop", "drivers", "simulation")]
    assert {Path(words[0]).stem for words in lines} > {"codecs", "extract", "gui_motion", "log"}
    lines.append(["benchmarks/codecs.py", "--no-such-option"])
    done = subprocess.run(
        [sys.executable, "-c", PARSE, json.dumps(lines)],
        cwd=repository,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "benchmarks/codecs.py --no-such-option\n", done.stderr


def test_options_take_the_types_of_their_defaults(benchmarks: None) -> None:
    from common import command_line

    parser = command_line("What.", seconds=3.0, cycles=2, only=str, no_matrix=False)
    given = parser.parse_args(["--seconds", "1", "--only", "svh"])
    assert vars(given) == {"seconds": 1.0, "cycles": 2, "only": "svh", "no_matrix": False}
    assert parser.parse_args(["--no-matrix"]).no_matrix
    assert parser.parse_args([]).only is None


def test_the_interval_of_a_median(benchmarks: None) -> None:
    import math
    import random

    from common import interval_of_median

    assert interval_of_median([1.0, 2.0, 3.0]) == (-math.inf, math.inf)
    assert interval_of_median([3.0, 6.0, 1.0, 2.0, 4.0, 5.0]) == (1.0, 6.0)
    assert interval_of_median([float(n) for n in range(10)]) == (1.0, 8.0)  # as in tables
    chance = random.Random(1)
    hits = 0
    for _ in range(2000):
        low, high = interval_of_median([chance.expovariate(1.0) for _ in range(15)])
        hits += low <= math.log(2.0) <= high  # the median of that distribution
    assert 0.95 <= hits / 2000 < 0.99


def test_a_table_is_markdown_in_columns(
    benchmarks: None, capsys: pytest.CaptureFixture[str]
) -> None:
    from common import Table

    table = Table("device", "rate", widths=(8,))
    table.row("svh", 428)
    assert capsys.readouterr().out == (
        "| device   | rate |\n| ---      | --- |\n| svh      | 428 |\n"
    )
    with pytest.raises(ValueError, match="zip"):
        table.row("svh")


@pytest.fixture
def benchmarks(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules of the benchmarks can be imported, as from a benchmark."""
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    monkeypatch.delitem(sys.modules, "common", raising=False)
