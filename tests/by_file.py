"""Each process of ``pytest -n`` imports only the files of tests that it runs.

By itself, every process of pytest-xdist collects all tests, which are then shared out by their
names: 370 modules and 13,000 tests, 5 s of processor time in each. Files are shared out here, whose
names are known without importing them. The process that gets a file collects and runs its tests.
"""

from __future__ import annotations

import gc
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def collecting() -> Generator[None, None, None]:
    """Collect without the garbage collector, which would look through all tests again and again.

    They stay to the end, so that it leaves them out afterwards, too.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


class TestFile(pytest.File):
    """A file of tests that is not imported yet.

    Args:
        path: The file.
        module: What would collect its tests.
        given: Arguments of pytest.
    """

    __test__ = False

    def __init__(self, path: Path, module: pytest.Module, **given: Any) -> None:
        super().__init__(path=path, **given)
        self.module = module
        self.add_marker(pytest.mark.timeout(0))  # each test has its own

    def collect(self) -> Iterator[pytest.Item]:
        yield AllTests.from_parent(self, name="all")


class AllTests(pytest.Item):
    """All tests of a file, which are one to xdist."""

    parent: TestFile

    def runtest(self) -> None:
        raise AssertionError("each test is run by itself")

    def run(self, nextitem: pytest.Item | None) -> None:
        """Collect the tests and run them; ``nextitem`` comes after the last."""
        session, hook = self.session, self.config.hook
        gc.collect()  # what is frozen now is never looked at again
        with collecting():
            tests = list(session.genitems(self.parent.module))
        hook.pytest_collection_modifyitems(session=session, config=self.config, items=tests)
        if not tests:  # the last test of the file before has left set up what this one shares
            session._setupstate.teardown_exact(nextitem)
        place = session.items.index(self)
        for test, following in zip_longest(tests, tests[1:], fillvalue=nextitem):
            assert test is not None
            session.items[place] = test  # xdist compares it with what is reported
            hook.pytest_runtest_protocol(item=test, nextitem=following)
            if session.shouldfail or session.shouldstop:
                break
        session.items[place] = self


@pytest.hookimpl(wrapper=True)
def pytest_collect_file() -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    return [
        TestFile.from_parent(node.parent, path=node.path, module=node)
        if isinstance(node, pytest.Module)
        else node
        for node in (yield)
    ]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    if not isinstance(item, AllTests):
        return None
    item.run(nextitem)
    return True
