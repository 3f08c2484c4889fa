"""Models that would take minutes or gigabytes are refused before MuJoCo reads them."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from rtee.errors import ModelError
from rtee.exchange import mjcf_files
from rtee.exchange.reading import mjcf_as_urdf

BODY = '<body name="b{0}"><joint name="j{0}" range="0 1"/><geom size="0.01"/>'


def model(folder: Path, inside: str, more: str = "") -> Path:
    path = folder / "hand.xml"
    path.write_text(
        '<mujoco>\n<compiler angle="radian"/><worldbody><body name="palm"><geom size="0.02"/>'
        f"{inside}</body></worldbody>{more}</mujoco>"
    )
    return path


def keys(count: int) -> str:
    entries = "".join(f'<key name="k{k}" qpos="0"/>' for k in range(count))
    return f"<keyframe>{entries}</keyframe>"


@pytest.mark.parametrize(
    ("inside", "more", "said"),
    [
        (BODY.format(0) + "</body>", keys(100_000), "100009 elements; a hand has at most 5000"),
        (BODY.format(0) + "</body>", keys(1001), "1001 elements <key>; a hand has at most 1000"),
        ("".join(map(BODY.format, range(90))) + 90 * "</body>", "", "nested more than 40 deep"),
        (
            "".join(BODY.format(k) + "</body>" for k in range(999)),
            "",
            "1000 bodies; a hand has at most 300",
        ),
    ],
)
def test_what_is_no_hand_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inside: str, more: str, said: str
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("MuJoCo reads it")

    monkeypatch.setattr(mjcf_files.mujoco.MjSpec, "from_file", never)
    with pytest.raises(ModelError, match=said), mjcf_as_urdf(model(tmp_path, inside, more)):
        pass


def test_what_is_allowed_is_read(tmp_path: Path) -> None:
    inside = "".join(map(BODY.format, range(30))) + 30 * "</body>"
    with mjcf_as_urdf(model(tmp_path, inside, "")) as found:
        assert found.urdf.is_file()
