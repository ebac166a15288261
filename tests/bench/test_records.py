import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import records


@pytest.fixture
def ignored_sigterm() -> Iterator[None]:
    """Let child processes ignore SIGTERM, as a run that finishes its iteration does."""
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.usefixtures("ignored_sigterm")
@pytest.mark.parametrize("content, result", [('{"passed": {"iteration": 7}}', {"iteration": 7}), ("{}", None)])
def test_run_that_passes_while_it_is_stopped_counts(content: str, result: object, tmp_path: Path) -> None:
    script = f"sleep 0.2; echo '{content}' > '{tmp_path / 'config.json'}'"
    assert records.timed(["sh", "-c", script], tmp_path, dict(os.environ), limit=0.0)[0] == result
