"""Test whether a robot follows every clip."""

from collections.abc import Callable, Iterator

import torch

import lyceum_warp as lw


class Tracks(lw.Gate):
    """Every clip of the task once from its first frame, without noise, as ``lw.evaluate_clips`` plays them."""

    limits = {
        "failures": lw.Limit("clips that fail", high=0),
        "score": lw.Limit("mean score, 1 for perfect tracking"),
        "mpkpe": lw.Limit("mean error of the bodies' positions in the world, m"),
        "r_mpkpe": lw.Limit("mean error of the bodies' relative positions, m"),
        "worst_r_mpkpe": lw.Limit("the same for the worst clip, m"),
    }

    def measure(
        self, worlds: Callable[..., lw.Env], act: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[dict[str, float]]:
        """Yield the results of all clips."""
        results = lw.evaluate_clips(worlds(1), act)
        errors = results.errors
        yield {
            "failures": results.failures, "score": results.scores.mean().item(), "mpkpe": errors["mpkpe"].mean().item(),
            "r_mpkpe": errors["r_mpkpe"].mean().item(), "worst_r_mpkpe": errors["r_mpkpe"].max().item(),
        }  # fmt: skip
