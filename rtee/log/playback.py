"""The hand of a recording for its playback: its fingers, and its folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from rtee.errors import LogError
from rtee.hand.embedded_meshes import FOLDER, with_mesh_addresses
from rtee.hand.files import write_all
from rtee.hand.names import check_name
from rtee.log.dataclass_json import from_json
from rtee.log.layout import REPLAY, Replayable
from rtee.log.recording import Recording


def fingers(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Return the actuators of each finger; none if the recording lacks the fingers."""
    attached = recording.attachments.get(REPLAY)
    if attached is None:
        return {}
    by_finger: dict[str, list[str]] = {}
    for actuator in from_json(attached, Replayable).actuators:
        for finger in actuator.fingers:
            by_finger.setdefault(finger, []).append(actuator.name)
    return {finger: tuple(names) for finger, names in by_finger.items()}


def write_hand(recording: Recording, folder: Path) -> Path:
    """Write the hand of a recording as a folder for `rtee run`, and return the folder.

    Writes only the files needed to show the hand: a hand.yaml, the URDF with its meshes, the SRDF,
    the actions. The URDF has absolute paths of the meshes, which RViz needs.

    Args:
        recording: The recording.
        folder: Parent of the hand's folder.

    Raises:
        LogError: if the recording contains no URDF.
        ConfigError: if the folder cannot be written.
    """
    if not recording.urdf:
        raise LogError("contains no URDF", path=recording.paths[0])
    # The name comes from a file and must be checked before it becomes part of a path.
    name = check_name(recording.hand, "hand", path=recording.paths[0])
    home = folder.absolute() / name
    meshes = _meshes(recording, home)
    addresses = {address: path.as_uri() for address, (path, _) in meshes.items()}
    files: dict[Path, str | bytes] = dict(meshes.values())
    files |= _actions(recording.attachments, home)
    files[home / "hand.urdf"] = with_mesh_addresses(recording.urdf, addresses)
    lines = [f"name: {name}", "urdf: hand.urdf"]
    srdf = next(
        (data for file, data in recording.attachments.items() if file.endswith(".srdf")), None
    )
    if srdf is not None:
        files[home / "hand.srdf"] = srdf
        lines.append("srdf: hand.srdf")
    files[home / "hand.yaml"] = "\n".join(lines) + "\n"
    write_all(files)
    return home


def _meshes(recording: Recording, home: Path) -> dict[str, tuple[Path, bytes]]:
    """Return the attached meshes by address in the URDF: the path to write and the content."""
    meshes: dict[str, tuple[Path, bytes]] = {}
    for address, name in recording.meshes.items():
        data = recording.attachments.get(name)
        folder, _, file = name.partition("/")
        if data is not None and folder == FOLDER:
            meshes[address] = home / FOLDER / check_name(file, "mesh"), data
    return meshes


def _actions(attachments: Mapping[str, bytes], home: Path) -> dict[Path, bytes]:
    """Return the attached actions by path; skip names that lead out of their folder."""
    files: dict[Path, bytes] = {}
    for file, data in attachments.items():
        parts = PurePosixPath(file).parts
        # A recording may come from anywhere, so that its names must not leave the hand's folder.
        if len(parts) != 3 or parts[0] != "actions" or not parts[2].endswith(".yaml"):
            continue
        kind = check_name(parts[1], "folder of actions")
        files[home / "actions" / kind / check_name(parts[2], "file of actions")] = data
    return files
