"""Choose between a run's last and its best policy, by new episodes under equal conditions."""

import contextlib
import dataclasses
import json
from collections.abc import Callable

from lyceum_warp.algos import evaluate, simulation
from lyceum_warp.env import Env
from lyceum_warp.support.files import replace_text
from lyceum_warp.training.runs.checkpoints import read_checkpoint
from lyceum_warp.training.runs.folder import Run, load, load_curriculum

EPISODES = 32

AUTO = "auto"
"""Stands for the better of the last and the best policy."""


@dataclasses.dataclass(frozen=True)
class Score:
    """Returns of a policy in new episodes."""

    iteration: int
    mean: float
    std: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Choice:
    """The better of a run's last and best policies: best.pt was the best in an evaluation of other episodes."""

    which: str
    """"last" or "best"."""
    scores: dict[str, Score]
    """Scores by "last" and "best". There is no "best" if it is the policy of the last iteration."""

    @property
    def score(self) -> Score:
        """The score of the chosen policy."""
        return self.scores[self.which]

    @property
    def text(self) -> str:
        """Name the chosen policy, and give the returns of both."""
        names = sorted(self.scores, key=lambda name: name != self.which)
        text = ", ".join(
            f"{name} (iteration {score.iteration}) returns {score.mean:.5g} ± {score.std:.2g}"
            for name, score in ((name, self.scores[name]) for name in names)
        )
        return f"policy: the {self.which} one; in {EPISODES} new episodes, {text}"


def choose_policy(
    run: Run, worlds: Callable[[], Env], *, progress: Callable[[int, int], object] | None = None
) -> Choice:
    """Choose between the last and the best policy by their returns in new episodes.

    The returns are stored in evaluation.json. They are valid as long as the files have the same iterations.

    Args:
        run: The run.
        worlds: Makes an environment of the run, in which the policies play. It is called only if no returns are stored.
        progress: See ``evaluate``.

    Raises:
        FileNotFoundError: The run has no policy.
        ValueError: A policy's file is broken, or needs a custom class.
    """
    iterations = {"last": read_checkpoint(run.policy_file(), parts=("iteration", "policy"))["iteration"]}
    if (best := run.best_score()) is not None and best[0] != iterations["last"]:
        iterations["best"] = best[0]
    scores = stored_scores(run)
    if {which: score.iteration for which, score in scores.items()} != iterations:
        env = worlds()
        curriculum, scores = load_curriculum(run), {}
        for which, iteration in iterations.items():
            policy = load(run, which=which, device=env.obs.device)
            seed = run.config["seed"] + 1
            returns = evaluate(env, policy, EPISODES, seed=seed, curriculum=curriculum, progress=progress).returns
            values = returns.mean(), returns.std(correction=0), returns.min(), returns.max()
            scores[which] = Score(iteration, *(value.item() for value in values))
        entries = {which: dataclasses.asdict(score) for which, score in scores.items()}
        content = {"episodes": EPISODES, "seed": seed, "simulation": simulation(env), "policies": entries}
        content["line"] = f"{_choice(scores).text}, on the {content['simulation']}"
        with contextlib.suppress(OSError):  # the folder may be read-only
            replace_text(run.evaluation, json.dumps(content, indent=2))
    return _choice(scores)


def _choice(scores: dict[str, Score]) -> Choice:
    return Choice(max(scores, key=lambda which: (scores[which].mean, which == "last")), scores)


def stored_scores(run: Run) -> dict[str, Score]:
    """Read the scores in evaluation.json by "last" and "best". Without a valid file, the result is empty."""
    try:
        policies = json.loads(run.evaluation.read_text())["policies"]
        rows = {which: [score[field.name] for field in dataclasses.fields(Score)] for which, score in policies.items()}
        return {which: Score(int(row[0]), *map(float, row[1:])) for which, row in rows.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
