"""Install the software of `peers.toml`, each in a folder of its own: `install.py FOLDER`."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

TABLE = Path(__file__).with_name("peers.toml")


def main(root: Path) -> None:
    """Install all; what fails leaves its reason behind, which tests then skip with."""
    shutil.rmtree(root, ignore_errors=True)
    for peer in tomllib.loads(TABLE.read_text("utf-8"))["peers"]:
        if peer.get("own"):
            continue
        folder = root / peer["package"]
        folder.mkdir(parents=True)
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(folder)]
        # Without what it wants for plots and the like.
        asked = [["--no-deps", f"{peer['package']}=={peer['version']}"], peer["needs"]]
        for words in filter(None, asked):
            done = subprocess.run([*pip, *words], capture_output=True, text=True, check=False)
            if done.returncode:
                reason = (done.stderr.strip() or "pip failed").splitlines()[-1]
                (folder / "FAILED").write_text(reason, "utf-8")
                print(f"{peer['package']}: {reason}")
                break


if __name__ == "__main__":
    main(Path(sys.argv[1]))
