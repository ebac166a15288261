import re
import sys
import time
from types import SimpleNamespace

import pytest
from conftest import SharedEnv

import lyceum_warp as lw


def test_show_displays_the_page_and_a_link_in_a_notebook_while_the_worlds_run(
    shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    env = shared_env("point_mass", nworld=2)
    shown = lw.view(env, seed=0)
    assert shown is not None
    end = time.monotonic() + 60
    while env.episode_step[0] == 0 and time.monotonic() < end:
        time.sleep(0.01)
    assert shown.is_open and env.episode_step[0] > 0
    link = r'<a id="([\w-]+)" href="http://127\.0\.0\.1:\d+/[\w-]{43}/" target="_blank">.*getElementById\("\1"\)'
    assert re.search(link, shown._repr_html_(), re.DOTALL) and 'createElement("iframe")' in shown._repr_html_()
    shown.close()
    shown.close()
    assert not shown.is_open and shown._repr_html_() == "viewer of point_mass (closed)"
    before = env.episode_step.clone()
    env.step()
    assert (env.episode_step == before + 1).all()
