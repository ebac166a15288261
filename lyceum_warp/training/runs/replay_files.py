"""Save a replay buffer beside a run's checkpoint, in files that are never changed.

The steps are divided into equal parts, each about 1/64 of the buffer, with one file per part. A save writes only the
parts with new steps, each to a new file. Old files are deleted after the checkpoint has been replaced. The files
therefore always contain the checkpoint's steps.
"""

from collections.abc import Iterator
from pathlib import Path

from lyceum_warp.algos import Replay, Team
from lyceum_warp.training.runs.checkpoints import FORMAT, read_checkpoint, write_content
from lyceum_warp.training.runs.folder import Run

_PARTS = 64


def write_replay(run: Run | None, replay: Replay, team: Team, since: int) -> None:
    """Write the parts of the replay buffer that have grown since the last save.

    ``since`` is the number of stored steps at the last save. All ranks must call this function. Ranks without a run do
    not write.
    """
    oldest = replay.stored - replay.count
    for start, end in _parts(replay, max(since, oldest), replay.stored):
        first = max(start, oldest)
        rows = {  # the worlds must be the first axis, because gather concatenates along it
            name: team.gather(part.transpose(0, 1).contiguous()).transpose(0, 1).cpu().contiguous()
            for name, part in replay.rows(first, end).items()
        }
        with team.together():
            if run is not None:
                run.check()
                run.replay.mkdir(exist_ok=True)
                content = {"lyceum_warp": FORMAT, "first": first, "rows": rows}
                write_content(run.replay / _name(start, end), content, durable=True)


def clean_replay(folder: Path, replay: Replay) -> None:
    """Delete the files that the newest checkpoint does not need."""
    needed = {_name(*part) for part in _parts(replay, replay.stored - replay.count, replay.stored)}
    for path in folder.glob("*-*.pt"):
        if path.name not in needed:
            path.unlink(missing_ok=True)


def read_replay(folder: Path, replay: Replay, stored: int, worlds: slice) -> None:
    """Restore the buffer of a checkpoint."""
    oldest = max(0, stored - replay.steps)
    for start, end in _parts(replay, oldest, stored):
        # an interrupted save may have left a longer file: ignore its additional steps
        longer = sorted(path for path in folder.glob(f"{start:012d}-*.pt") if path.name >= _name(start, end))
        if not longer:
            raise ValueError(f"{folder} lacks steps {start} to {end} of the replay buffer")
        content = read_checkpoint(longer[0], parts=("first", "rows"))
        if content["first"] > max(start, oldest):
            raise ValueError(f"{longer[0]} lacks the replay buffer's steps before {content['first']}")
        steps = end - content["first"]
        replay.set_rows(content["first"], {name: part[:steps, worlds] for name, part in content["rows"].items()})
    replay.restore(stored)


def _parts(replay: Replay, first: int, stored: int) -> Iterator[tuple[int, int]]:
    """Yield (first step, end) of each part that contains a step between ``first`` and ``stored``."""
    each = -(-replay.steps // _PARTS)
    for start in range(first // each * each, stored, each):
        yield start, min(start + each, stored)


def _name(start: int, end: int) -> str:
    return f"{start:012d}-{end:012d}.pt"
