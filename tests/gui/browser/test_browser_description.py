"""The description in a recording, as viewers that run in a browser load it."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtee.hand.embedded_meshes import embed_meshes, with_mesh_addresses
from rtee.hand.load import load_model

from .marks import in_a_browser

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser

LOAD = """
async (text) => {
  const urdf = new DOMParser().parseFromString(text, "application/xml");
  const found = [];
  for (const mesh of urdf.querySelectorAll("mesh")) {
    const response = await fetch(mesh.getAttribute("filename"));
    const bytes = new Uint8Array(await response.arrayBuffer());
    let text = "";
    for (let at = 0; at < bytes.length; at += 4096)
      text += String.fromCharCode(...bytes.subarray(at, at + 4096));
    found.push([response.headers.get("content-type"), btoa(text)]);
  }
  return found;
}
"""


@pytest.mark.heavy
def test_a_browser_loads_every_mesh_of_a_description(context: BrowserContext, shared: Path) -> None:
    folder = shared / "hands" / "robotiq_2f_85"
    hand = load_model(folder / "robotiq_2f_85.urdf")
    meshes = embed_meshes(hand).meshes
    inside = {address: str(mesh.data_url) for address, mesh in meshes.items()}
    page = context.new_page()
    found = page.evaluate(LOAD, with_mesh_addresses(hand.urdf.text, inside))
    page.close()
    shapes = [s for link in hand.urdf.links.values() for s in (*link.visuals, *link.collisions)]
    named = [shape.mesh for shape in shapes if shape.kind == "mesh"]
    assert len(found) == len(named) > 0
    types = {".dae": "model/vnd.collada+xml", ".stl": "model/stl"}
    expected = [
        (types[Path(name).suffix.lower()], (folder / name).read_bytes()) for name in set(named)
    ]
    assert {(kind, base64.b64decode(data)) for kind, data in found} == set(expected)
