import logging
from pathlib import Path

import mujoco
import pytest

from lyceum_warp.support.mujoco_log import quiet

XML = '<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'


def test_mujoco_warning_is_logged_and_not_written_to_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    quiet()
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(XML))
    data.qvel[:] = 1e11
    with caplog.at_level(logging.DEBUG, logger="lyceum_warp.support.mujoco_log"):
        mujoco.mj_step(model, data)
    assert "MuJoCo: " in caplog.text and "QVEL" in caplog.text
    assert not list(tmp_path.iterdir())
