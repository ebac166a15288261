"""Write a page on a run: settings, curves, verdicts, faults, the machine and an episode."""

import contextlib
import html
import itertools
import json
import math
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.algos import EXACT, evaluation_worlds
from lyceum_warp.controllers import episode_env, load_episodes, policy_episodes
from lyceum_warp.engines import options_on_cores
from lyceum_warp.support.files import replace_text
from lyceum_warp.training.comparison import flat_settings, read_curve
from lyceum_warp.training.curve import RETURNS, Panel, curve_panels
from lyceum_warp.training.runs.configuration import Configuration
from lyceum_warp.training.runs.folder import Run, load, load_curriculum
from lyceum_warp.training.runs.task_copy import run_env
from lyceum_warp.viz import one_line, write_page

_SETTINGS = (
    "task", "algorithm", "network", "seed", "iterations", "nworld", "engine", "device", "threads", "exact_from",
    "target_return", "options", "params", "physics", "planner", "planner_params", "episodes", "steps", "replan_every",
    "real_time",
)  # fmt: skip
"""Entries of config.json on the page. All others, such as those of callbacks, are left out."""

_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 320, 150, 50, 18
_MOST_POINTS = 300


def write_report(folder: str | Path, out: str | Path | None = None, *, episode: bool = True) -> Path:
    """Write one self-contained HTML page on a run, or on the episodes of a planner.

    The page needs no network and no other file, and has no absolute paths, user names or host names.

    Args:
        folder: The folder of a run, or one that ``lyceum-warp plan`` has written.
        out: The file; by default ``report.html`` in the folder.
        episode: Whether to play an episode of the last policy under exact physics on the C engine, and to show it.

    Raises:
        FileNotFoundError: The folder has no run.
        ValueError: The run cannot be read.
    """
    folder = Path(folder)
    if planned := (folder / "report.json").is_file():
        config = json.loads((folder / "config.json").read_text())
        title, body = f"{_short(config['task'])}, {config['algorithm']}", _planner_parts(folder)
    else:
        run = Run.open(folder)
        config = run.config
        title, body = f"{run.task_name}, {config['algorithm']}, seed {config['seed']}", _run_parts(run)
    parts = list(body)
    if episode:
        parts.insert(1, _episode(folder, planned=planned))
    settings = {name: config[name] for name in (*_SETTINGS, config["algorithm"]) if name in config}
    parts += _section("Settings", _table(flat_settings(settings)))
    parts += _section("Machine and versions", _table(config.get("versions", {})))
    return html_page(Path(out or folder / "report.html"), title, parts)


def html_page(out: Path, title: str, parts: Iterable[str]) -> Path:
    """Write parts of HTML as a page in the style of reports."""
    page = Path(__file__).with_suffix(".html").read_text()
    replace_text(out, page.replace("TITLE", html.escape(title)).replace("BODY", "\n".join(parts), 1))
    return out


def _run_parts(run: Run) -> Iterator[str]:
    panels, curve = curve_panels(run), read_curve(run)
    rows = run.rows()
    lines = [f"{rows[-1]['iteration']:,.0f} iterations, {rows[-1]['samples'] or 0:,.0f} samples, "
             f"last return {curve.final:.5g}"]  # fmt: skip
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        stored = json.loads(run.evaluation.read_text())
        lines += [
            f"the {which} policy (iteration {score['iteration']}) returns {score['mean']:.5g} ± {score['std']:.3g} in "
            f"{stored['episodes']} new episodes on the {stored['simulation']}"
            for which, score in stored["policies"].items()
        ]
    lines += [f"gate: {curve.gate}"] * bool(curve.gate) + [f"transfer: {curve.transfer}"] * bool(curve.transfer)
    faults = {name: round(sum(row.get(name) or 0.0 for row in rows)) for name in ("faults", "outliers")}
    lines.append(", ".join(f"{number:,d} {name}" for name, number in faults.items()))
    yield "\n".join(f"<p>{html.escape(line)}</p>" for line in lines)
    for group, members in itertools.groupby(panels, lambda panel: panel.group):
        keys = '<p class="soft"><span class="key">stochastic policy</span><span class="key">mean policy</span></p>'
        figures = "\n".join(map(_figure, members))
        title = {RETURNS: "Curves over samples"}.get(group, group.capitalize())
        yield from _section(title, f'{keys if group == RETURNS else ""}<div class="grid">{figures}</div>')


def _planner_parts(folder: Path) -> Iterator[str]:
    report = json.loads((folder / "report.json").read_text())
    yield "<p>a planner's episodes</p>"
    yield from _section("Report", _table(flat_settings(report if isinstance(report, dict) else {"report": report})))


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
        with tempfile.TemporaryDirectory() as temporary:
            text = write_page(env, states, Path(temporary, "episode.html")).read_text()
    except Exception as error:  # a report without an episode is worth having
        reason = re.sub(r"/\S*/", "", one_line(error))  # without folders
        return f'<p class="soft">no episode: {html.escape(reason)}</p>'
    return "\n".join(_section("Episode", f'<iframe title="an episode" srcdoc="{html.escape(text)}"></iframe>'))


def _section(title: str, content: str) -> list[str]:
    return [f"<h2>{html.escape(title)}</h2>", content]


def _table(entries: Mapping[str, Any]) -> str:
    cells = ((name, _short(value)) for name, value in entries.items() if value not in (None, "", {}))
    names = ((re.sub(r"([._])", r"\1<wbr>", html.escape(name)), text) for name, text in cells)  # where a name may break
    rows = (f"<tr><th>{name}</th><td>{html.escape(text)}</td></tr>" for name, text in names)
    return f"<table>{''.join(rows)}</table>"


def _short(value: Any) -> str:
    """Format a value. Of a path, only the file's name remains, because folders may have a user's name."""
    if isinstance(value, str) and value.startswith("/"):
        return Path(value).name
    if isinstance(value, list):
        return " ".join(map(_short, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _figure(panel: Panel) -> str:
    """Draw a panel as SVG. Its colours follow the page's."""
    points = [point for curve in panel.curves.values() for point in curve]
    (x_low, x_high), (y_low, y_high) = ((min(each), max(each)) for each in zip(*points, strict=True))
    ticks = _ticks(y_low, y_high)
    if y_low == y_high:  # put the line into the middle
        y_low, y_high = y_low - 1.0, y_high + 1.0
    x_scale, y_scale = (_WIDTH - _LEFT - 6) / (x_high - x_low or 1.0), (_HEIGHT - _BOTTOM - 8) / (y_high - y_low)

    def place(x: float, y: float) -> str:
        return f"{_LEFT + (x - x_low) * x_scale:.1f} {_HEIGHT - _BOTTOM - (y - y_low) * y_scale:.1f}"

    parts = []
    for tick in ticks:
        x, y = place(x_low, tick).split()
        parts.append(f'<line x1="{x}" x2="{_WIDTH - 6}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{float(y) + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
    parts.append(f'<text x="{_LEFT}" y="{_HEIGHT - 3}">{_number(x_low)}</text>')
    parts.append(f'<text x="{_WIDTH - 6}" y="{_HEIGHT - 3}" text-anchor="end">{_number(x_high)}</text>')
    for name, curve in panel.curves.items():
        stride = max(1, len(curve) // _MOST_POINTS)
        line = " L".join(place(*point) for point in [*curve[:-1:stride], curve[-1]])
        dot = " h.1" if len(curve) == 1 else ""
        kind = "two" if name == "mean policy" else "one"
        parts.append(f'<path class="{kind}" stroke-linecap="round" d="M{line}{dot}"/>')
    unit = f" <span>{html.escape(panel.unit)}</span>" if panel.unit else ""
    label = html.escape(f"{panel.title} over samples")
    return (
        f'<figure><figcaption>{html.escape(panel.title)}{unit}</figcaption><svg role="img" aria-label="{label}" '
        f'viewBox="0 0 {_WIDTH} {_HEIGHT}">{"".join(parts)}</svg></figure>'
    )


def _ticks(low: float, high: float) -> Sequence[float]:
    """Choose three to six round numbers in a range, or its only value."""
    if low == high:
        return [low]
    power = 10.0 ** math.floor(math.log10(high - low))
    steps = (power * factor for factor in (5, 2, 1, 0.5, 0.2))
    grids = ([step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)] for step in steps)
    return next(grid for grid in grids if len(grid) >= 3)


def _number(value: float) -> str:
    for unit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.4g}{letter}"
    return f"{value:.4g}"
