"""Log a run to Weights & Biases, with the extra ``wandb``."""

import math
import uuid
from typing import Any

from lyceum_warp.algos import Iteration, Learner
from lyceum_warp.support.extras import check_extra
from lyceum_warp.training.callbacks import Callback
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.training.tensorboard import tag


class WandB(Callback):
    """Logs a run's settings, curves and videos to Weights & Biases. A resumed run continues its page.

    The curves have the names that ``TensorBoard`` gives them. Pass this callback after ``Videos``.

    Args:
        project: The project.
        options: More arguments of ``wandb.init``, such as ``mode="offline"`` or ``group="five seeds"``.

    Raises:
        ImportError: The package wandb is not installed.
    """

    def __init__(self, project: str = "lyceum_warp", **options: Any) -> None:
        check_extra("Weights & Biases", "wandb")
        self._options = {"project": project, **options}
        self._run: Any = None
        self.settings: dict[str, Any] = {"wandb": project}

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Open the run's page."""
        import wandb

        self._videos = run.folder / "videos"
        self.settings = {**self.settings, "wandb_id": run.config.get("wandb_id", uuid.uuid4().hex[:12])}
        run.amend(**self.settings)
        config = {name: value for name, value in run.config.items() if name != "kept"}
        options = {"name": run.folder.name, "id": self.settings["wandb_id"], "resume": "allow", **self._options}
        self._run = wandb.init(dir=run.folder, config=config, **options)

    def __call__(self, iteration: Iteration) -> None:
        """Log an iteration without its non-finite numbers."""
        import wandb

        numbers = {tag(name): x for name, x in iteration.row().items() if x is not None and math.isfinite(x)}
        if (video := self._videos / f"{iteration.iteration:06d}.mp4").is_file():
            numbers["video"] = wandb.Video(str(video), format="mp4")
        self._run.log(numbers, step=iteration.iteration)

    def close(self) -> None:
        """Close the run's page."""
        if self._run is not None:
            self._run.finish()
