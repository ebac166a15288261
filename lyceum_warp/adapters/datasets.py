"""Write saved episodes as datasets for LeRobot and Minari."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.controllers import Trajectory
from lyceum_warp.core import Done
from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.images import png

_DATA, _EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


def write_minari(episodes: Sequence[Trajectory], dataset_id: str, **options: Any) -> Any:
    """Write episodes as a Minari dataset, with the extra ``minari``.

    ``minari.load_dataset(dataset_id)`` loads it. An episode that a limit or a fault has ended is truncated. With
    pictures, observations are dicts of ``policy`` and the cameras' groups.

    Args:
        episodes: Episodes of one task, such as ``list(load_episodes(folder).values())``.
        dataset_id: The dataset's name, such as "hopper/npg-v0".
        options: More arguments of ``minari.create_dataset_from_buffers``, such as ``description``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        ValueError: There is no episode, or the dataset exists.
        ImportError: Minari is not installed.
    """
    check_extra("writing a Minari dataset", "minari")
    import minari
    from gymnasium.spaces import Box, Dict
    from minari.data_collector import EpisodeBuffer

    first = _first(episodes)
    spaces: list[Any] = [Box(-np.inf, np.inf, (rows.shape[1],)) for rows in (first.obs, first.actions)]
    if first.pictures:
        limits = {np.dtype("uint8"): (0, 255), np.dtype("float32"): (0, np.inf), np.dtype("int32"): (-1, 2**31 - 1)}
        types = {group: rows.numpy().dtype for group, rows in first.pictures.items()}
        seen = {g: Box(*limits[kind], first.pictures[g].shape[1:], kind.type) for g, kind in types.items()}
        spaces[0] = Dict({"policy": spaces[0], **seen})
    buffers = []
    for number, episode in enumerate(episodes):
        observations: Any = episode.obs.numpy()
        if first.pictures:
            observations = {"policy": observations, **{g: rows.numpy() for g, rows in episode.pictures.items()}}
        last = np.arange(episode.steps) == episode.steps - 1
        terminated = bool(episode.done_reason & Done.TERMINATED)
        buffers.append(
            EpisodeBuffer(
                id=number, seed=episode.seed, observations=observations, actions=episode.actions.numpy(),
                rewards=episode.rewards.tolist(), terminations=(last & terminated).tolist(),
                truncations=(last & (not terminated)).tolist(),
            )
        )  # fmt: skip
    return minari.create_dataset_from_buffers(
        dataset_id, buffers, observation_space=spaces[0], action_space=spaces[1], **options
    )


def write_lerobot(episodes: Sequence[Trajectory], folder: str | Path, *, instruction: str | None = None) -> Path:
    """Write episodes as a dataset of LeRobot, format v3.0, without videos, with the extra ``lerobot``.

    ``LeRobotDataset(repo_id, root=folder)`` loads it. A frame has the observation before a step, the action, and the
    reward, the end and the success after it. Colours are images, ``observation.images.GROUP``.

    Args:
        episodes: Episodes of one task, such as ``list(load_episodes(folder).values())``.
        folder: A new folder.
        instruction: The task in words; by default the task's name.

    Raises:
        ValueError: There is no episode, or the format cannot hold its pictures.
        FileExistsError: The folder exists.
        ImportError: pandas or pyarrow is not installed.
    """
    first, folder = _first(episodes), Path(folder)
    for group, pictures in first.pictures.items():
        if pictures.dtype != torch.uint8:
            raise ValueError(
                f"LeRobot's images are colours, unlike the pictures {group!r}: omit them, as in "
                "[dataclasses.replace(episode, pictures={}) for episode in episodes]"
            )
    check_extra("writing a LeRobot dataset", "lerobot", "pandas", "pyarrow")
    import pandas

    lengths = np.array([episode.steps for episode in episodes])
    ends, number = np.cumsum(lengths), np.repeat(np.arange(len(episodes)), lengths)
    frame = np.concatenate([np.arange(length) for length in lengths])
    rate = 1 / first.timestep
    columns: dict[str, np.ndarray] = {
        "observation.state": np.concatenate([episode.obs[:-1].numpy() for episode in episodes]),
        "action": np.concatenate([episode.actions.numpy() for episode in episodes]),
        "next.reward": np.concatenate([episode.rewards.numpy() for episode in episodes]),
        "next.done": frame == lengths[number] - 1,
        "next.success": np.concatenate([episode.success.numpy() for episode in episodes]),
        "timestamp": (frame / rate).astype(np.float32), "frame_index": frame, "episode_index": number,
        "index": np.arange(len(frame)), "task_index": np.zeros(len(frame), np.int64),
    }  # fmt: skip
    observed = [f"{part}_{k}" for part, (start, stop) in first.obs_parts.items() for k in range(stop - start)]
    names = {"observation.state": observed, "action": list(first.action_names)}
    for group in first.pictures:
        columns[name := f"observation.images.{group}"] = np.concatenate([e.pictures[group][:-1] for e in episodes])
        names[name] = ["height", "width", "channels"]
    features, stats, frames = {}, {}, {}
    for name, rows in columns.items():
        picture = rows.ndim == 4
        kind, axes, shape = ("image", (0, 1, 2), (3, 1, 1)) if picture else (str(rows.dtype), 0, (-1,))
        features[name] = {"dtype": kind, "shape": [*rows.shape[1:]] or [1], "names": names.get(name)}
        stats[name] = {
            key: (getattr(rows, key)(axis=axes) / (255 if picture else 1)).reshape(shape).tolist()
            for key in ("min", "max", "mean", "std")
        } | {"count": [len(rows)]}
        # LeRobot reads columns of the shape [1] as numbers
        cells = [{"bytes": png(each), "path": None} for each in rows] if picture else rows
        frames[name] = list(rows[:, 0] if rows.shape[1:] == (1,) else cells)
    info = {
        "codebase_version": "v3.0", "robot_type": first.task, "total_episodes": len(episodes),
        "total_frames": len(frame), "total_tasks": 1, "chunks_size": 1000, "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200, "fps": round(rate) if abs(rate - round(rate)) < 1e-6 else rate,
        "splits": {"train": f"0:{len(episodes)}"}, "features": features, "video_path": None,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    }  # fmt: skip
    task = instruction or first.task
    table = pandas.DataFrame({
        "episode_index": range(len(episodes)), "tasks": [[task]] * len(episodes), "length": lengths,
        "data/chunk_index": 0, "data/file_index": 0, "dataset_from_index": ends - lengths, "dataset_to_index": ends,
        "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
    })  # fmt: skip
    folder.mkdir(parents=True)
    tasks = pandas.DataFrame({"task_index": [0]}, index=[task])
    for file, content in ((_DATA, pandas.DataFrame(frames)), (_EPISODES, table), ("meta/tasks.parquet", tasks)):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        content.to_parquet(folder / file)
    for file, content in (("info.json", info), ("stats.json", stats)):
        (folder / "meta" / file).write_text(json.dumps(content, indent=2))
    return folder


def _first(episodes: Sequence[Trajectory]) -> Trajectory:
    if not episodes:
        raise ValueError("there is no episode to write: pass at least one lw.Trajectory")
    return episodes[0]
