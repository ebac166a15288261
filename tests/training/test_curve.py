import math
from pathlib import Path

import pytest

from lyceum_warp.training import Run, curve as module, learning_curve


def test_learning_curve_of_a_task_with_metrics_has_a_panel_for_them(tmp_path: Path) -> None:
    sizes = []
    for number, metrics in enumerate(({}, {"metrics/forward": 1.0, "metrics/effort": float("nan")})):
        run = Run.create(tmp_path / str(number), {"task": "point_mass", "seed": 3})
        for i in (1, 2):
            run.append(
                {"iteration": i, "samples": i, "return_mean": 1.0, "return_std": 0.5, "eval_mean": 1.0, **metrics}
            )
        assert learning_curve(run) == run.folder / "curve.png"
        header = (run.folder / "curve.png").read_bytes()[:24]
        assert header[:8] == b"\x89PNG\r\n\x1a\n"
        sizes.append(int.from_bytes(header[20:], "big"))
    assert sizes[1] > sizes[0]
    run.cut(0)
    with pytest.raises(ValueError, match="has no complete iteration to plot: continue its training"):
        learning_curve(run)


def test_learning_curve_shows_rewards_if_no_episode_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = []
    monkeypatch.setattr(module, "save_png", lambda figure, out: figures.append(figure))
    for mean_return in (None, 3.0):
        run = Run.create(tmp_path / str(mean_return), {"task": "half_cheetah", "seed": 3})
        for i in (1, 2):
            row = {"samples": 10 * i, "reward_mean": 0.1 * i, "mean_return": mean_return, "mean_eval": mean_return}
            run.append(row | dict.fromkeys(("return_mean", "return_std", "eval_mean"), math.nan))
        learning_curve(run)
    rewards, returns = (figure.axes[0] for figure in figures)
    assert rewards.get_ylabel() == "reward of a step" and list(rewards.lines[0].get_ydata()) == [0.1, 0.2]
    assert returns.get_ylabel() == "return" and list(returns.lines[-1].get_ydata()) == [3.0, 3.0]
