"""Find the package's pretrained policies, which are run folders with float16 weights and without training state."""

from pathlib import Path

from lyceum_warp.binding import file_name
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.training.runs.folder import PRETRAINED, Run


def pretrained_tasks() -> list[str]:
    """List the tasks that have a pretrained policy."""
    return sorted(path.parent.name.replace("-", "/") for path in PRETRAINED.glob("*/config.json"))


def pretrained_run(task: str) -> Path:
    """Get the run folder of a task's pretrained policy.

    ``lw.load`` and other functions accept this folder as they accept the folder of any run. Its config.json has the
    training settings and, under ``evaluated``, the policy's return.

    Example:
        >>> policy = lw.load(lw.pretrained_run("hopper"))

    Args:
        task: The task's name.

    Raises:
        ValueError: The task has no pretrained policy. The message lists the tasks that have one.
    """
    tasks = pretrained_tasks()
    if task not in tasks:
        hint = did_you_mean(task, tasks, f"the tasks with a policy are {', '.join(tasks)}")
        raise ValueError(f"there is no pretrained policy of {task!r}: {hint}")
    return PRETRAINED / file_name(task)


def pretrained_text(run: Run) -> str:
    """Describe a pretrained policy in one line: its training, and the settings that differ from the task's defaults."""
    config, evaluation = run.config, run.config["evaluated"]
    settings = {**config["params"], **config["physics"], **config["options"]}
    text = ", ".join(f"{name} {value}" for name, value in settings.items()) or "its defaults"
    return (
        f"pretrained by {config['algorithm']} on {config['task']} with {text}: return {evaluation['return']:.4g} ± "
        f"{evaluation['std']:.2g} in {evaluation['episodes']} episodes of lyceum_warp {evaluation['lyceum_warp']}"
    )
