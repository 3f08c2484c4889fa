"""Installation of a hand's service in a system, and removal of exactly the installed files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from rtee.deploy.files import ACCOUNTS, UNIT, USER
from rtee.errors import ConfigError
from rtee.hand.files import cleared_on_failure, failing, write_atomically, write_together

MANIFEST = "/etc/rtee/deploy.json"
"""List of the written files and their hands; only root may change it."""

WANTS = "/etc/systemd/system/multi-user.target.wants"


class FileState(StrEnum):
    """State of a file before or after an operation."""

    NEW = "new"
    SAME = "unchanged"
    CHANGED = "updated"
    KEPT = "kept: it was changed by hand"
    REMOVED = "removed"


@dataclass(slots=True)
class Manifest:
    """List of the files written into a system.

    Attributes:
        files: SHA-256 of each written file, by path.
        hands: The hands that need each file, by path.
        folders: Folders that rtee created, parents first.
        user: Whether rtee created the user.
        before: SHA-256 of the files that an installation is replacing, by path; empty once it is
            complete.
    """

    files: dict[str, str] = field(default_factory=dict)
    hands: dict[str, list[str]] = field(default_factory=dict)
    folders: list[str] = field(default_factory=list)
    user: bool = False
    before: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, root: Path) -> Manifest:
        """Return a system's manifest, or an empty one; raises `ConfigError` if it is invalid."""
        path = root / MANIFEST[1:]
        try:
            with path.open("rb") as file:
                document = json.load(file)
            listed = {str(k): v for k, v in document["files"].items()}
            return cls(
                files={k: str(v["sha256"]) for k, v in listed.items()},
                hands={k: [str(hand) for hand in v["hands"]] for k, v in listed.items()},
                folders=[str(folder) for folder in document["folders"]],
                user=bool(document["user"]),
                before={k: str(v["before"]) for k, v in listed.items() if "before" in v},
            )
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"cannot be used: {error}; nothing was changed", path=path) from error

    def of(self, hand: str) -> list[str]:
        """Return the paths of the files that a hand needs."""
        return [path for path, hands in self.hands.items() if hand in hands]

    def wrote(self, path: str, digest: str) -> bool:
        """Return whether rtee wrote the content of a file, given by its SHA-256."""
        return digest in (self.files[path], self.before.get(path))

    def document(self) -> str:
        """Return the manifest as JSON."""
        files: dict[str, dict[str, object]] = {
            path: {"sha256": digest, "hands": self.hands[path]}
            for path, digest in self.files.items()
        }
        for path, digest in self.before.items():
            files[path]["before"] = digest
        whole = {"files": files, "folders": self.folders, "user": self.user}
        return json.dumps(whole, indent=2) + "\n"


class Installation:
    """The services of hands in a system, whose root folder is ``/`` or the folder of an image.

    Raises `ConfigError` if the root is not a folder, or its manifest is invalid.
    """

    def __init__(self, root: Path = Path("/")) -> None:
        if not root.is_dir():
            raise ConfigError("is not a folder", path=root)
        self.root = root.resolve()
        self.manifest = Manifest.read(self.root)

    @property
    def live(self) -> bool:
        """Whether this is the running system."""
        return self.root == Path("/")

    def compare(self, hand: str, files: Mapping[str, bytes]) -> dict[str, FileState]:
        """Return the change that `install` would make to each file, without making it.

        Raises `ConfigError` if a file exists that rtee did not write, or a folder is a link that
        leads out of the system.
        """
        states: dict[str, FileState] = {}
        link = self._link(hand)
        others = [link] if link.exists() and not link.is_symlink() else []
        for path, content in files.items():
            state = self._state(path, content)
            if state is None:
                others.append(self._place(path))
            else:
                states[path] = state
        if others:
            raise ConfigError(
                "exists already and is not from `rtee deploy`; move it away first", path=others[0]
            )
        states[f"{WANTS}/{link.name}"] = FileState.SAME if link.is_symlink() else FileState.NEW
        return states

    def written(self, path: str) -> FileState:
        """Return the state of an installed file; `FileState.NEW` if it is gone."""
        place = self._place(path)
        if not place.is_symlink() and not place.exists():
            return FileState.NEW
        if path.startswith(f"{WANTS}/"):
            same = place.is_symlink() and os.readlink(place) == UNIT
        else:
            same = self.manifest.wrote(path, _digest(place))
        return FileState.SAME if same else FileState.KEPT

    def content(self, path: str) -> bytes:
        """Return the content of a file, empty if it cannot be read."""
        with contextlib.suppress(OSError):
            return self._place(path).read_bytes()
        return b""

    def has_user(self) -> bool:
        """Return whether the user that runs hands exists."""
        return self._account("passwd") is not None

    def user_id(self) -> int | None:
        """Return the ID of the user that runs hands, or ``None``."""
        account = self._account("passwd") or []
        with contextlib.suppress(ValueError, IndexError):
            return int(account[2])
        return None

    def install(self, hand: str, files: Mapping[str, bytes]) -> dict[str, FileState]:
        """Write a hand's files, enable its service, and return the state of each file, by path.

        Raises `ConfigError` if a file cannot be written; then none is. If it is interrupted, or the
        service cannot be enabled, the next installation finishes it, and `uninstall` finds all that
        was written.
        """
        states = self.compare(hand, files)
        # The hand may need fewer files than at its last installation.
        stale = [path for path in self.manifest.of(hand) if path not in states]
        manifest = self.manifest
        wanted = [Path(path).parent for path in (*states, MANIFEST)]
        with _usual_permissions(), contextlib.ExitStack() as made:
            for folder in wanted:
                made.enter_context(cleared_on_failure(self._folder(str(folder))))
            self._make_folders(wanted)
            # List files before writing them, so that an interrupted installation can be undone.
            for path, state in states.items():
                if state is FileState.CHANGED:
                    # If this ends before the file is replaced, the old one is no user's.
                    manifest.before[path] = _digest(self._place(path))
                if path in files and state is not FileState.KEPT:
                    manifest.files[path] = hashlib.sha256(files[path]).hexdigest()
                hands = manifest.hands.setdefault(path, [])
                # A link has no digest, but counts as one of the hand's files.
                manifest.files.setdefault(path, "")
                if hand not in hands:
                    hands.append(hand)
            # Together: otherwise a full disk would leave a list with checksums of files that it did
            # not take, and the next installation would keep the old ones as changed by hand.
            write_together(
                {self._place(MANIFEST): manifest.document()}
                | {
                    self._place(path): files[path]
                    for path, state in states.items()
                    if path in files and state in (FileState.NEW, FileState.CHANGED)
                }
            )
            link = self._link(hand)
            if not link.is_symlink():
                with failing("cannot be made", link):
                    link.symlink_to(UNIT)
        # From here on, an old content is there again only if somebody has put it back. What other
        # hands need, or this one no longer, is not replaced here.
        for path in states:
            manifest.before.pop(path, None)
        # Remove old files last, so that a failed installation still has them.
        states |= self._drop(hand, stale)
        return states

    def uninstall(self, hand: str) -> dict[str, FileState]:
        """Remove the files that only this hand needs, except those changed by hand.

        Raises `ConfigError` if the hand was not installed, or a file cannot be removed.
        """
        paths = self.manifest.of(hand)
        if not paths:
            installed = sorted({each for hands in self.manifest.hands.values() for each in hands})
            raise ConfigError(
                f"hand '{hand}' was not installed by `rtee deploy`;"
                f" installed are: {', '.join(installed) or 'none'}"
            )
        return self._drop(hand, paths)

    def make_user(self) -> str:
        """Create the user that runs hands, unless it exists.

        Returns a sentence about a problem that needs attention, or ``""``.
        """
        if self.has_user():
            return ""
        problem = self._call("systemd-sysusers", *self._in_root("--root={}"), Path(ACCOUNTS).name)
        if problem:
            return f"the user was not created ({problem}); the system creates it at its next start"
        self.manifest.user = True
        with _usual_permissions():
            self._save()
        return ""

    def remove_user(self) -> str:
        """Remove the user if `make_user` created it and no hand is left; return as `make_user`."""
        if not self.manifest.user or self.manifest.files:
            return ""
        problem = self._call("userdel", *self._in_root("--prefix", "{}"), USER)
        # userdel may keep the group, by its configuration or for other members.
        if not problem and self._account("group"):
            problem = self._call("groupdel", *self._in_root("--prefix", "{}"), USER)
        if problem:
            return f"the user was not removed ({problem}); type: userdel {USER}"
        self.manifest.user = False
        self._tidy()
        return ""

    def reload(self) -> list[str]:
        """Make the running system read the files; return sentences about failures."""
        if not self.live:
            return []
        commands = (
            ("systemctl", "daemon-reload"),
            ("udevadm", "control", "--reload"),
            # Rules apply when a device appears; announce present devices again.
            ("udevadm", "trigger", "--subsystem-match=tty", "--subsystem-match=usb-serial"),
        )
        failed = [(words, self._call(*words)) for words in commands]
        return [f"{' '.join(words)}: {problem}" for words, problem in failed if problem]

    def stop(self, hand: str) -> str:
        """Stop the service of a hand, which brings it to rest; return as `make_user`."""
        if not self.live:
            return ""
        return self._call("systemctl", "stop", f"rtee@{hand}.service")

    # --- within the system -------------------------------------------------------------------

    def _place(self, path: str) -> Path:
        """Return a file's path below the root; raises `ConfigError` if links leave the root."""
        return self._folder(str(Path(path).parent)) / Path(path).name

    def _folder(self, path: str) -> Path:
        place = self.root / path.lstrip("/")
        if not place.resolve().is_relative_to(self.root):
            raise ConfigError("is a link that leads out of the system", path=place)
        return place

    def _link(self, hand: str) -> Path:
        return self._place(f"{WANTS}/rtee@{hand}.service")

    def _state(self, path: str, content: bytes) -> FileState | None:
        """Return the state of a file; ``None`` if rtee did not write it."""
        place = self._place(path)
        if not place.is_symlink() and not place.exists():
            return FileState.NEW
        digest = _digest(place)
        if digest == hashlib.sha256(content).hexdigest() and path in self.manifest.files:
            return FileState.SAME
        # Even with the same content, since uninstalling must not remove somebody else's file.
        if path not in self.manifest.files:
            return None
        return FileState.CHANGED if self.manifest.wrote(path, digest) else FileState.KEPT

    def _make_folders(self, folders: Sequence[Path]) -> None:
        for folder in folders:
            # One by one, since `_tidy` removes each created folder with the last hand.
            for each in (*reversed(folder.parents), folder):
                place = self._folder(str(each))
                if place.is_dir():
                    continue
                try:
                    place.mkdir()
                except OSError as error:
                    raise ConfigError(f"cannot be made: {error.strerror}", path=place) from error
                if str(each) not in self.manifest.folders:
                    self.manifest.folders.append(str(each))

    def _drop(self, hand: str, paths: Sequence[str]) -> dict[str, FileState]:
        """Remove a hand from the users of some files, and remove files that no hand needs."""
        states: dict[str, FileState] = {}
        manifest = self.manifest
        for path in paths:
            manifest.hands[path].remove(hand)
            if manifest.hands[path]:
                continue
            place, state = self._place(path), self.written(path)
            if state is FileState.SAME:
                try:
                    place.unlink()
                except OSError as error:
                    # Removed files are no longer in the manifest; the rest can be tried again.
                    manifest.hands[path].append(hand)
                    self._save()
                    raise ConfigError(f"cannot be removed: {error.strerror}", path=place) from error
                states[path] = FileState.REMOVED
            elif state is FileState.KEPT:
                # A changed file also leaves the manifest: it now belongs to its author.
                states[path] = state
            del manifest.hands[path], manifest.files[path]
            manifest.before.pop(path, None)
        self._tidy()
        return states

    def _tidy(self) -> None:
        """Remove an empty manifest, and the empty folders that rtee created."""
        needed = bool(self.manifest.files or self.manifest.user)
        if not needed:
            # Before the folders, since the manifest's own folder must be empty.
            self._place(MANIFEST).unlink(missing_ok=True)
        # The longest path first, so that a folder is removed before its parent.
        for folder in sorted(self.manifest.folders, key=len, reverse=True):
            with contextlib.suppress(OSError):  # other files are in the folder
                self._folder(folder).rmdir()
                self.manifest.folders.remove(folder)
        if needed:
            with _usual_permissions():
                self._save()

    def _save(self) -> None:
        write_atomically(self._place(MANIFEST), self.manifest.document())

    def _account(self, file: str) -> list[str] | None:
        """Return the fields of the user's line in the system's ``passwd`` or ``group``, if any."""
        with contextlib.suppress(OSError):
            # The modules pwd and grp only know the accounts of the running system.
            for line in self._place(f"/etc/{file}").read_text("utf-8", "replace").splitlines():
                if line.startswith(f"{USER}:"):
                    return line.split(":")
        return None

    def _in_root(self, *words: str) -> list[str]:
        return [] if self.live else [word.replace("{}", str(self.root)) for word in words]

    def _call(self, *words: str) -> str:
        """Run a program; return the reason for a failure, or ``""``."""
        # A user's PATH often lacks sbin, the folder of userdel and groupdel.
        program = shutil.which(words[0], path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
        if program is None:
            return f"there is no {words[0]} here"
        done = subprocess.run([program, *words[1:]], capture_output=True, text=True)
        if done.returncode == 0:
            return ""
        output = (done.stderr or done.stdout).strip().splitlines()
        return output[-1] if output else f"status {done.returncode}"


def _digest(place: Path) -> str:
    """Return the SHA-256 of a regular file; empty for anything else."""
    if place.is_symlink() or not place.is_file():
        return ""
    with contextlib.suppress(OSError), place.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return ""


@contextlib.contextmanager
def _usual_permissions() -> Iterator[None]:
    """Set the umask so that everybody may read new files and only their owner may change them."""
    # Root's own umask may be stricter, but the service's user must read the hand's files.
    before = os.umask(0o022)
    try:
        yield
    finally:
        os.umask(before)
