"""How a missing extra is to be installed."""

from __future__ import annotations

import contextlib
import json
import signal
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from rtee.cli.main import cli
from rtee.errors import ConfigError, MissingExtra, needing_extra


@pytest.mark.parametrize(
    ("origin", "said"),
    [
        (
            {"url": "file:///home/a%20b/rtee", "dir_info": {"editable": True}},
            'pip install --editable "/home/a b/rtee[gui]"',
        ),
        ({"url": "file:///tmp/rtee-1-py3-none-any.whl"}, 'pip install "/tmp/rtee-1-py3-none-any'),
        ({"url": "https://x.org/rtee.whl"}, 'pip install "rtee[gui] @ https://x.org/rtee.whl"'),
        (None, 'install "rtee[gui]" from where this rtee was installed'),
    ],
    ids=["checkout", "wheel", "address", "index or folder of wheels"],
)
def test_an_extra_comes_from_where_rtee_came(
    monkeypatch: pytest.MonkeyPatch, origin: dict[str, object] | None, said: str
) -> None:
    """A package of that name on an index may be something else."""
    text = None if origin is None else json.dumps(origin)
    found = SimpleNamespace(read_text=lambda _: text)
    monkeypatch.setattr(metadata, "distribution", lambda _: found)
    assert f"the GUI needs the extra 'gui': {said}" in str(MissingExtra("the GUI", "gui"))


def test_what_cannot_be_loaded_is_not_called_missing() -> None:
    """Pinocchio needs a library of the system; to install the extra again was no help."""
    lacking = "libgomp.so.1: cannot open shared object file: No such file or directory"
    with pytest.raises(ConfigError) as caught, needing_extra("the extraction", "extract"):
        raise ImportError(f"{lacking}\nmore")
    assert str(caught.value) == (
        "the extraction needs the extra 'extract', which is installed but cannot be loaded: "
        + lacking
    )
    assert not isinstance(caught.value, MissingExtra)


@pytest.mark.parametrize(
    ("option", "extra"),
    [("--gui", "gui"), ("--ros2", "ros2"), ("--metrics=127.0.0.1:9464", "metrics")],
)
def test_packages_that_are_only_looked_for_are_called_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, option: str, extra: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    words = ["run", "robotiq_2f_85", option, "--duration=0.1", "--no-log"]
    monkeypatch.setattr("sys.argv", ["rtee", *words])
    with pytest.raises(MissingExtra, match=f"needs the extra '{extra}': "):
        cli(words, standalone_mode=False)


def test_ctrl_c_ends_imports_that_take_it_for_a_missing_package() -> None:
    """`rtee gui`, interrupted while trimesh was imported, went on and heard no Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with (
            pytest.raises(KeyboardInterrupt),
            needing_extra("the GUI", "gui"),
            contextlib.suppress(BaseException),
        ):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
