"""Workers on a Dask cluster: the hands' files go with the tasks, whatever the workers have."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import json
import logging
import threading
import zipfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from rtee.errors import ConfigError, UserError, WorkerLost, needing_extra
from rtee.hand.files import new_tree
from rtee.hand.own_copy import TRIALS
from rtee.objects.shape import is_shape
from rtee.trials.bench import bench
from rtee.trials.work import (
    Task,
    from_text,
    object_of,
    perform,
    to_text,
    versions,
    with_object,
)

_PATIENCE: Final = 10.0
"""Time for a scheduler, and for its first worker, to answer [s]."""

_ALONE = threading.Lock()
"""A worker with several threads does one task at a time: they share the hand's model."""


class Cluster:
    """The workers of a scheduler that have this rtee; the others are left out, by name."""

    def __init__(
        self,
        address: str,
        hands: Mapping[str, Path],
        objects: Iterable[str],
        tell: Callable[[str], None],
    ) -> None:
        """Send the hands and the meshes of objects to all workers.

        Args:
            address: Address of the scheduler.
            hands: The hands as tasks call them, with their folders.
            objects: The objects, as on the command line.
            tell: Called with a sentence for each worker that is left out.

        Raises:
            MissingExtra: if Dask is missing.
            ConfigError: if the scheduler does not answer.
            WorkerLost: if no worker can be used.
        """
        with needing_extra("a sweep on a cluster", "sweep"):
            distributed: Any = importlib.import_module("distributed")
        # It reports lost connections in tracebacks; here, one sentence is enough.
        for name in ("client", "core", "batched"):
            logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL)
        self._address, self._tell = address, tell
        self._out: set[str] = set()
        try:
            self._client = distributed.Client(address, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            raise ConfigError(f"no Dask scheduler answers at '{address}': {error}") from error
        try:
            self._client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError:
            self.close()
            raise WorkerLost(f"the scheduler at '{address}' has no workers") from None
        self._hands = {hand: f"{n}/{hands[hand].name}" for n, hand in enumerate(hands)}
        meshes = [text for text in dict.fromkeys(objects) if not is_shape(text)]
        self._objects = {text: f"{n}{Path(text).suffix}" for n, text in enumerate(meshes)}
        self._upload(hands)
        self.look()

    def _upload(self, hands: Mapping[str, Path]) -> None:
        """Send one archive of all needed files to all workers, including later ones."""
        with TemporaryDirectory() as folder:
            archive = Path(folder) / "all.zip"
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
                for hand, name in self._hands.items():
                    for path in sorted(hands[hand].rglob("*")):
                        if path.is_file() and path.name != TRIALS:
                            file.write(path, f"{name}/{path.relative_to(hands[hand])}")
                for text, name in self._objects.items():
                    file.write(text, f"objects/{name}")
            digest = hashlib.sha256(archive.read_bytes()).hexdigest()[:16]
            self._archive = f"rtee-{digest}.zip"
            named = archive.rename(archive.with_name(self._archive))
            with zipfile.ZipFile(named) as file:
                file.extractall(folder)
            for hand, name in self._hands.items():
                try:
                    bench(str(Path(folder) / name))
                except UserError as error:
                    why = f"hand '{hands[hand].name}' needs files outside of its folder: {error}"
                    raise ConfigError(why) from error
            self._client.upload_file(str(named), load=False)

    @property
    def capacity(self) -> int:
        """Number of tasks submitted at once, so that each worker has one waiting."""
        return max(2, 2 * len(self._workers()))

    def _workers(self) -> dict[str, Any]:
        found = self._client.scheduler_info(n_workers=-1)["workers"]
        return {address: about for address, about in found.items() if address not in self._out}

    def submit(self, hand: str, task: Task) -> Future[str]:
        """Give a task of a hand to a worker that may do it."""
        shape = object_of(task)
        file = f"objects/{self._objects[shape]}" if shape in self._objects else ""
        executor = self._client.get_executor(
            pure=False, workers=list(self._workers()) if self._out else None
        )
        done: Future[str] = executor.submit(
            _perform, self._archive, self._hands[hand], file, to_text(task)
        )
        return done

    def check(self) -> None:
        """Raise `WorkerLost` if the scheduler is gone, or all workers."""
        if self._client.status != "running":
            raise WorkerLost(f"the scheduler at '{self._address}' is gone")
        if not self._workers():
            raise WorkerLost(f"no worker of the scheduler at '{self._address}' is left")

    def failed(self, error: BaseException) -> None:
        """Find out why a task failed: leave out workers, or raise `WorkerLost`."""
        if isinstance(error, CancelledError):
            raise WorkerLost(f"the scheduler at '{self._address}' is gone") from error
        self.look()

    def look(self) -> None:
        """Leave out the workers without this rtee."""
        known = self._workers()
        # Standard library only, so that a worker without rtee can answer, too.
        said = self._client.run(
            importlib.metadata.version, "rtee", workers=list(known), on_error="return"
        )
        for worker, found in said.items():
            if isinstance(found, Exception):
                self.refuse(worker, "it has no rtee")
        left = list(self._workers())
        said = self._client.run(versions, workers=left, on_error="return") if left else {}
        for worker, found in said.items():
            if isinstance(found, Exception):
                self.refuse(worker, f"its rtee does not work: {found}")
            elif found != versions():
                self.refuse(worker, f"it has {found} instead of {versions()}")
        self.check()

    def refuse(self, worker: str, why: str) -> None:
        """Leave a worker out from now on."""
        if worker not in self._out:
            about = self._client.scheduler_info(n_workers=-1)["workers"].get(worker, {})
            self._out.add(worker)
            self._tell(f"worker {about.get('name', worker)} ({worker}) is left out: {why}")

    def close(self) -> None:
        """Leave the cluster, and give up its running tasks."""
        self._client.close()


def _perform(archive: str, hand: str, file: str, text: str) -> str:
    """Do a task on a worker, with the files that came with it."""
    worker: Any = importlib.import_module("distributed").get_worker()
    place = Path(worker.local_directory)
    with _ALONE:
        folder = place / archive.removesuffix(".zip")
        if not folder.exists():
            with zipfile.ZipFile(place / archive) as packed, new_tree(folder) as fresh:
                packed.extractall(fresh)
        task = from_text(text)
        if file:
            text = to_text(with_object(task, str(folder / file)))
        said = perform(str(folder / hand), text)
    if file:
        # Notes on the object contain its path, which differs on this computer.
        here, there = (json.dumps(path)[1:-1] for path in (str(folder / file), object_of(task)))
        said = said.replace(here, there)
    return json.dumps({**json.loads(said), "worker": worker.address})
