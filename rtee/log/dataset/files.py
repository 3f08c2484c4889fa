"""Files of a LeRobot dataset, format v3.0: Parquet by pyarrow, videos by PyAV.

The format is that of ``LeRobotDataset`` (lerobot 0.4 and later): a file of frames, one of episodes,
one of tasks, ``info.json``, ``stats.json``, and a video for each episode and camera.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtee.errors import LogError

Vectors = Mapping[str, NDArray[Any]]
"""Values by feature ``(frames, n)``."""

Stats = dict[str, NDArray[Any]]

_ROBOT: Final = "rtee_hand"
"""The kind of robot, that of the plugin."""

_CHUNK: Final = 1000
"""Files in a folder, as LeRobot has it."""

_FILE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA: Final = f"data/{_FILE}.parquet"
_EPISODES: Final = f"meta/episodes/{_FILE}.parquet"
_VIDEO: Final = f"videos/{{video_key}}/{_FILE}.mp4"

_QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)

_COUNTERS: Final = ("frame_index", "episode_index", "index", "task_index")

_CODEC: Final = ("libx264", "yuv420p", {"g": "2", "bf": "0", "crf": "23"})
"""A key frame at every second frame, and none that needs later ones: training reads at random."""

_SAMPLED: Final = 50
"""Number of images of an episode used for a camera's statistics: enough pixels."""

_THINNED: Final = 4
"""Step in rows and columns of these images."""


class DatasetFiles:
    """Writes a dataset into an empty folder, episode by episode.

    Args:
        folder: The folder.
        fps: Frames per second [Hz].
        names: Names of the numbers by feature.
        cameras: Names of the cameras.
    """

    def __init__(
        self,
        folder: Path,
        fps: int,
        names: Mapping[str, Sequence[str]],
        cameras: Sequence[str],
    ) -> None:
        self._folder, self._fps = folder, fps
        self._names = {key: list(each) for key, each in names.items()}
        self._cameras = {name: f"observation.images.{name}" for name in cameras}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._frames: dict[str, list[NDArray[Any]]] = {}
        self._pixels = {key: np.zeros((3, 256)) for key in self._cameras.values()}
        self._images = 0
        self._index = 0

    def add(self, task: str, vectors: Vectors, images: Mapping[str, Iterator[Any]]) -> None:
        """Write an episode: its task, its numbers, and the frames of its cameras (PyAV).

        Raises:
            LogError: if the images of a camera have several sizes.
        """
        count, number = len(next(iter(vectors.values()))), len(self._episodes)
        frames = np.arange(count)
        columns = {key: vectors[key].astype(np.float32) for key in self._names}
        columns["timestamp"] = (frames / self._fps).astype(np.float32)[:, np.newaxis]
        constant = self._tasks.setdefault(task, len(self._tasks))
        counters = (frames, np.full(count, number), self._index + frames, np.full(count, constant))
        columns |= {k: c[:, np.newaxis] for k, c in zip(_COUNTERS, counters, strict=True)}
        for key, column in columns.items():
            self._frames.setdefault(key, []).append(column)
        where = {"chunk_index": number // _CHUNK, "file_index": number % _CHUNK}
        episode: dict[str, Any] = {
            "episode_index": number,
            "tasks": [task],
            "length": count,
            "dataset_from_index": self._index,
            "dataset_to_index": self._index + count,
            **{f"{of}/{index}": 0 for of in ("data", "meta/episodes") for index in where},
        }
        stats = {key: _of_rows(column) for key, column in columns.items()}
        for name, key in self._cameras.items():
            path = self._folder / _VIDEO.format(video_key=key, **where)
            pixels = self._video(path, key, images[name], count)
            self._pixels[key] += pixels
            stats[key] = _of_pixels(pixels, min(count, _SAMPLED))
            episode |= {f"videos/{key}/{index}": value for index, value in where.items()}
            episode |= {
                f"videos/{key}/from_timestamp": 0.0,
                f"videos/{key}/to_timestamp": count / self._fps,
            }
        for key, each in stats.items():
            episode |= {f"stats/{key}/{name}": value.tolist() for name, value in each.items()}
        self._episodes.append(episode)
        self._images += min(count, _SAMPLED)
        self._index += count

    def _video(
        self, path: Path, key: str, images: Iterator[Any], count: int
    ) -> NDArray[np.float64]:
        """Encode the images of an episode; return their colour histograms ``(3, 256)``."""
        import av

        codec, pixel_format, options = _CODEC
        pixels = np.zeros((3, 256))
        chosen = set(np.linspace(0, count - 1, min(count, _SAMPLED)).round().astype(int).tolist())
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as file:
            stream: Any = file.add_stream(codec, rate=self._fps, options=options)
            stream.pix_fmt = pixel_format
            for number, image in enumerate(itertools.islice(images, count)):
                size = self._sizes.setdefault(key, (image.height, image.width))
                if size != (image.height, image.width):
                    raise LogError(
                        f"the camera '{key}' has images of {size[1]} x {size[0]} and of "
                        f"{image.width} x {image.height} pixels; a dataset has one size"
                    )
                if not number:
                    # Colours have half the resolution: an odd row or column is left out.
                    stream.height, stream.width = (side // 2 * 2 for side in size)
                colours = image.to_ndarray(format="rgb24")
                if number in chosen:
                    seen = colours[::_THINNED, ::_THINNED]
                    pixels += [np.bincount(seen[..., i].ravel(), minlength=256) for i in range(3)]
                # A copy, since the same image may be shown again while the encoder still has it.
                frame = av.VideoFrame.from_ndarray(colours, format="rgb24")
                frame = frame.reformat(stream.width, stream.height, pixel_format)
                frame.pts, frame.time_base = number, Fraction(1, self._fps)
                file.mux(stream.encode(frame))
            file.mux(stream.encode(None))
        return pixels

    def finish(self) -> None:
        """Write the metadata of all episodes."""
        import pyarrow as pa
        from pyarrow import parquet

        columns = {key: np.concatenate(parts) for key, parts in self._frames.items()}
        arrays = {}
        for key, values in columns.items():
            flat = pa.array(values.ravel())
            # LeRobot stores a vector of one element as a plain number.
            arrays[key] = (
                flat
                if values.shape[1] == 1
                else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            )
        first = {"chunk_index": 0, "file_index": 0}
        tasks = pa.table({"task_index": list(self._tasks.values()), "task": list(self._tasks)})
        # Read by pandas, with the tasks as index.
        column = {"name": "task", "field_name": "task", "metadata": None}
        column |= {"pandas_type": "unicode", "numpy_type": "object"}
        about = {"index_columns": ["task"], "columns": [column], "column_indexes": []}
        tables = {
            _DATA.format(**first): pa.table(arrays),
            _EPISODES.format(**first): pa.Table.from_pylist(self._episodes),
            "meta/tasks.parquet": tasks.replace_schema_metadata({"pandas": json.dumps(about)}),
        }
        for name, table in tables.items():
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with parquet.ParquetWriter(path, table.schema) as writer:
                # A row group per episode, since training reads episodes at random.
                lengths = [len(part) for part in self._frames["index"]]
                for rows in lengths if name.startswith("data/") else [table.num_rows]:
                    writer.write_table(table.slice(length=rows), rows)
                    table = table.slice(rows)
        stats = {key: _of_rows(values) for key, values in columns.items()}
        stats |= {key: _of_pixels(each, self._images) for key, each in self._pixels.items()}
        listed = {k: {n: v.tolist() for n, v in each.items()} for k, each in stats.items()}
        self._json("meta/stats.json", listed)
        self._json("meta/info.json", self._info())

    def _json(self, name: str, content: Mapping[str, Any]) -> None:
        text = json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False)
        (self._folder / name).write_text(text, encoding="utf-8")

    def _info(self) -> dict[str, Any]:
        count = len(self._episodes)
        codec, pixel_format, _ = _CODEC
        features: dict[str, Any] = {
            key: {"dtype": "float32", "shape": [len(names)], "names": names}
            for key, names in self._names.items()
        }
        for key, (height, width) in self._sizes.items():
            height, width = height // 2 * 2, width // 2 * 2
            features[key] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": height,
                    "video.width": width,
                    "video.codec": codec.removeprefix("lib").replace("x", "h"),
                    "video.pix_fmt": pixel_format,
                    "video.is_depth_map": False,
                    "video.fps": self._fps,
                    "video.channels": 3,
                    "has_audio": False,
                },
            }
        for key in ("timestamp", *_COUNTERS):
            kind = "float32" if key == "timestamp" else "int64"
            features[key] = {"dtype": kind, "shape": [1], "names": None}
        return {
            "codebase_version": "v3.0",
            "robot_type": _ROBOT,
            "total_episodes": count,
            "total_frames": self._index,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{count}"},
            "data_path": _DATA,
            "video_path": _VIDEO if self._cameras else None,
            "features": features,
        }


def _of_rows(values: NDArray[Any]) -> Stats:
    """Return the statistics of each column of values ``(k, n)``."""
    numbers = values.astype(np.float64)
    found = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
    }
    quantiles = np.quantile(numbers, _QUANTILES, axis=0)
    return found | _named(quantiles)


def _of_pixels(counts: NDArray[np.float64], images: int) -> Stats:
    """Return the statistics of colours, from histograms: ``(3, 1, 1)``, 0 to 1."""
    levels = np.arange(256) / 255.0
    shares = counts / counts.sum(axis=1, keepdims=True)
    mean = shares @ levels
    below = np.cumsum(shares, axis=1)
    # The lowest level that a share q of the values does not exceed; 1e-9 for rounding.
    quantiles = [levels[np.argmax(below >= q - 1e-9, axis=1)] for q in _QUANTILES]
    found = {
        "min": levels[np.argmax(counts > 0, axis=1)],
        "max": levels[255 - np.argmax(counts[:, ::-1] > 0, axis=1)],
        "mean": mean,
        "std": np.sqrt(shares @ levels**2 - mean**2),
        **_named(quantiles),
    }
    return {n: v.reshape(3, 1, 1) for n, v in found.items()} | {"count": np.array([images])}


def _named(quantiles: Iterable[NDArray[Any]]) -> Stats:
    return {f"q{100 * q:02.0f}": v for q, v in zip(_QUANTILES, quantiles, strict=True)}
