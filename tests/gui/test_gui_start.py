"""The page with a card for each hand."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

import anyio
import pytest
import viser
from remote.serving import make_hand, make_library, serving

from rtee.gui.app import Cards
from rtee.remote.fleet import HandAddress, following

pytestmark = pytest.mark.anyio


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        yield server
        server.stop()


async def test_each_hand_has_a_card_a_click_away(
    server: viser.ViserServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    left, right = (make_hand(tmp_path, name) for name in ("left", "right"))
    async with (
        serving(left, make_library(left)),
        serving(right, make_library(right)),
        following() as fleet,
    ):
        await fleet.known()
        cards = Cards(server)
        cards.draw(await fleet.look())
        assert list(cards.cards) == [HandAddress("left"), HandAddress("right")]
        assert all("ready" in words.content for words in cards.cards.values())
        cards.press("stop", "")
        while "right: stopped" not in str(cards.words("")["doing"]):  # noqa: ASYNC110
            await anyio.sleep(0.02)
        assert "left: stopped" in str(cards.words("")["doing"])
        async with anyio.create_task_group() as group:
            group.start_soon(cards.run, fleet)
            cards.choose(HandAddress("right"))
        assert cards.chosen == HandAddress("right")
        cards.draw([])
        assert not cards.cards
