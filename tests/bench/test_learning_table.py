"""The table of NPG's results: the setting that a search chooses for a task."""

import json
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[2] / "bench"


def test_a_search_never_chooses_another_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCH))
    import learning_table

    runs = {"default": 1000.0, "less noise": 1200.0, "2,000 samples, gamma 0.99, no contact forces": 4000.0}
    search = tmp_path / "search.jsonl"
    lines = [json.dumps({"task": "ant", "setting": setting, "final": final}) for setting, final in runs.items()]
    search.write_text("\n".join(lines) + "\n")
    assert learning_table.chosen(search, ("ant",)) == {"ant": "less noise"}
