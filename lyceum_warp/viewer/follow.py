"""Follow a training run: load the weights of its newest policy.

The viewer only reads the run's files, and may run on another machine that shares the folder.
"""

import torch

from lyceum_warp.training import Run, network_of, read_checkpoint


class Follower:
    """Updates a policy's weights from a run's newest policy, at each call.

    Args:
        run: The run.
        policy: A policy that ``lw.load(run)`` has returned.
    """

    def __init__(self, run: Run, policy: torch.nn.Module) -> None:
        self.run, self.policy = run, policy
        self._seen: tuple[int, int, int] | None = None

    def __call__(self) -> list[str]:
        """Load the weights if the file is new, and return messages for the user."""
        path = self.run.policy
        try:
            status = path.stat()
            stamp = status.st_mtime_ns, status.st_ino, status.st_size
            if stamp == self._seen:
                return []
            self._seen = stamp
            content = read_checkpoint(path, parts=("iteration", "policy"))
            network_of(content, path, "policy", self.policy)
        except (OSError, ValueError) as error:  # the training may be writing the file
            return [f"the policy of {self.run.folder} was not read: {str(error).splitlines()[0]}"]
        return [f"policy of iteration {content['iteration']}"]
