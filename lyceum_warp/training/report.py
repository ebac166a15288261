"""Write a page on a run: settings, curves, verdicts, faults, the machine and an episode."""

import html
import io
import itertools
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.algos import EXACT, evaluation_worlds
from lyceum_warp.controllers import episode_env, load_episodes, policy_episodes
from lyceum_warp.engines import options_on_cores
from lyceum_warp.support.files import replace_text
from lyceum_warp.support.mappings import flat_settings
from lyceum_warp.training.comparison import read_curve
from lyceum_warp.training.curve import RETURNS, Panel, curve_panels, draw_panel
from lyceum_warp.training.runs.configuration import Configuration
from lyceum_warp.training.runs.folder import Run, load, load_curriculum
from lyceum_warp.training.runs.task_copy import run_env
from lyceum_warp.viz import finish_axes, new_figure, one_line, show

_SETTINGS = (
    "task", "algorithm", "network", "seed", "iterations", "nworld", "engine", "device", "threads", "exact_from",
    "target_return", "options", "params", "physics", "planner", "planner_params", "episodes", "steps", "replan_every",
    "real_time",
)  # fmt: skip
"""Entries of config.json on the page. All others, such as those of callbacks, are left out."""


def write_report(folder: str | Path, out: str | Path | None = None) -> Path:
    """Write one self-contained HTML page on a run, or on the episodes of a planner.

    The page needs no network and no other file, and has no absolute paths, user names or host names.

    Args:
        folder: The folder of a run, or one that ``lyceum-warp plan`` has written.
        out: The file; by default ``report.html`` in the folder.

    Raises:
        FileNotFoundError: The folder has no run.
        ValueError: The run cannot be read.
    """
    folder = Path(folder)
    if planned := (folder / "report.json").is_file():
        config = json.loads((folder / "config.json").read_text())
        title = f"{_text(config['task'])}, {config['algorithm']}"
        results, curves = _section("Report", _table(json.loads((folder / "report.json").read_text()))), ""
    else:
        run = Run.open(folder)
        config = run.config
        title = f"{run.task_name}, {config['algorithm']}, seed {config['seed']}"
        results, curves = _results(run), _curves(run)
    settings = {name: config[name] for name in (*_SETTINGS, config["algorithm"]) if name in config}
    parts = [
        results, _episode(folder, planned=planned), curves, _section("Settings", _table(settings)),
        _section("Machine and versions", _table(config.get("versions", {}))),
    ]  # fmt: skip
    return html_page(Path(out or folder / "report.html"), title, parts)


def html_page(out: Path, title: str, parts: Iterable[str]) -> Path:
    """Write parts of HTML as a page in the style of reports."""
    page = Path(__file__).with_suffix(".html").read_text()
    replace_text(out, page.replace("TITLE", html.escape(title)).replace("BODY", "\n".join(parts), 1))
    return out


def _results(run: Run) -> str:
    curve, rows = read_curve(run), run.rows()
    lines = [f"{rows[-1]['iteration']:,.0f} iterations, {rows[-1]['samples'] or 0:,.0f} samples, "
             f"last return {curve.final:.5g}"]  # fmt: skip
    if run.evaluation.is_file():
        lines.append(json.loads(run.evaluation.read_text()).get("line", ""))
    lines += [f"{name}: {text}" for name, text in (("gate", curve.gate), ("transfer", curve.transfer)) if text]
    faults = {name: round(sum(row.get(name) or 0.0 for row in rows)) for name in ("faults", "outliers")}
    lines.append(", ".join(f"{number:,d} {name}" for name, number in faults.items()))
    return "\n".join(f"<p>{_text(line)}</p>" for line in lines)


def _curves(run: Run) -> str:
    parts = []
    for group, panels in itertools.groupby(curve_panels(run), lambda panel: panel.group):
        keys = '<p class="soft"><span class="key">stochastic policy</span><span class="key">mean policy</span></p>'
        title = {RETURNS: "Curves over samples"}.get(group, group.capitalize())
        figures = "\n".join(map(_figure, panels))
        parts.append(_section(title, f'{keys if group == RETURNS else ""}<div class="grid">{figures}</div>'))
    return "\n".join(parts)


def _episode(folder: Path, *, planned: bool) -> str:
    """Play an episode, or load a planner's, and embed its page. A task whose code may not be executed has none."""
    try:
        if planned:
            episodes = load_episodes(folder)
            env, states = episode_env(episodes), next(iter(episodes.values())).states
        else:
            run = Run.open(folder)
            saved = Configuration.of(run)
            options = saved.options.changed({**options_on_cores(), "nworld": 1, "physics": EXACT})
            env = evaluation_worlds(run_env(run, options, saved.params), 1, autoreset=False)
            (played,) = policy_episodes(env, load(run), 1, seed=run.config["seed"] + 1, curriculum=load_curriculum(run))
            states = played.states
        text = show(env, states).content
    except Exception as error:  # a report without an episode is worth having
        return f'<p class="soft">no episode: {_text(one_line(error))}</p>'
    return _section("Episode", f'<iframe title="an episode" srcdoc="{html.escape(text)}"></iframe>')


def _section(title: str, content: str) -> str:
    return f"<h2>{title}</h2>\n{content}"


def _table(entries: Mapping[str, Any]) -> str:
    cells = {name: value for name, value in flat_settings(entries).items() if value not in (None, "")}
    rows = (f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in cells.items())
    return f"<table>{''.join(rows)}</table>"


def _text(value: Any) -> str:
    """Format a value. Of a path, only the file's name remains, because folders may have a user's name."""
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return html.escape(re.sub(r"(?<![\w.])/[^',:]*/", "", text))


def _figure(panel: Panel) -> str:
    """Draw a panel as SVG."""
    figure, file = new_figure("a report", 3.2, 1.6), io.StringIO()
    axes = figure.subplots()
    draw_panel(axes, panel)
    finish_axes([axes])
    axes.locator_params(nbins=4)
    figure.savefig(file, format="svg", transparent=True, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    drawn = file.getvalue().partition("<svg")[2]
    title, unit = _text(panel.title), _text(panel.unit)
    caption = f"<figcaption>{title} <span>{unit}</span></figcaption>"
    return f"<figure>{caption}<svg role='img' aria-label='{title} over samples'{drawn}</figure>"
