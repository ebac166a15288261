import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from headless_screen import frame_of, robot, scene_of

import lyceum_warp
from lyceum_warp.viewer import show
from lyceum_warp.viewer.session.window_process import Window

MODEL = robot()
DATA = mujoco.MjData(MODEL)


@pytest.fixture(scope="module")
def shared_window() -> Iterator[Window]:
    with contextlib.closing(Window(scene_of(MODEL))) as window:
        yield window


def page(window: Window, path: str = "") -> bytes:
    with urllib.request.urlopen(window.address + path, timeout=10) as response:
        content: bytes = response.read()
    return content


def process_of(window: Window) -> int:
    return window._process.pid


def wait_until(done: object) -> bool:
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        if done():  # type: ignore[operator]
            return True
        time.sleep(0.02)
    return False


def is_alive(pid: int) -> bool:
    """Return whether a process is running and not a zombie."""
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


# a running window


def test_two_windows_serve_page_and_model_at_different_ports(shared_window: Window) -> None:
    assert shared_window.is_open()
    assert b"canvas" in page(shared_window)
    assert wait_until(lambda: len(page(shared_window, "model")) > 1000)
    port = urllib.parse.urlsplit(shared_window.address).port
    with pytest.raises(ValueError, match=f"port {port}"):
        Window(scene_of(MODEL), port=port)


def test_process_listens_on_the_loopback_address_only(shared_window: Window) -> None:
    own = {os.readlink(link) for link in Path(f"/proc/{process_of(shared_window)}/fd").iterdir()}
    listening = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in own:
                listening.add(fields[1].partition(":")[0])
    assert listening == {"0100007F"}  # 127.0.0.1


def test_ctrl_c_does_not_end_the_window(shared_window: Window) -> None:
    os.kill(process_of(shared_window), signal.SIGINT)
    time.sleep(0.3)
    assert shared_window.is_open() and page(shared_window)
    assert os.getpgid(process_of(shared_window)) != os.getpgid(0)  # a terminal sends Ctrl-C to one process group


# ends


def test_close_ends_the_process_and_closes_all_file_descriptors(capfd: pytest.CaptureFixture[str]) -> None:
    threads, descriptors = threading.active_count(), None
    for _ in range(2):
        with contextlib.closing(Window(scene_of(MODEL))) as window:
            pid = process_of(window)
            assert page(window)
        window.close()
        assert window._process.returncode != -signal.SIGKILL and not is_alive(pid) and not window.is_open()
        window.show(frame_of(MODEL, DATA))  # has no effect
        assert threading.active_count() <= threads
        before, descriptors = descriptors, len(os.listdir("/proc/self/fd"))
        assert before in (None, descriptors)
    assert capfd.readouterr() == ("", "")  # studio prints nothing


def test_frames_for_a_hanging_window_do_not_block() -> None:
    with contextlib.closing(Window(scene_of(MODEL))) as window:
        os.kill(process_of(window), signal.SIGSTOP)
        frame = frame_of(MODEL, DATA, points=np.zeros((20_000, 3)))
        for _ in range(5):  # fills the pipe
            window.show(frame)
            time.sleep(0.02)
        os.kill(process_of(window), signal.SIGSEGV)
        os.kill(process_of(window), signal.SIGCONT)
        assert wait_until(lambda: not window.is_open())
        assert window.error == "its process was ended by SIGSEGV"


def test_killed_window_ends_the_view_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Killed(Window):
        def show(self, frame: object) -> None:
            os.kill(process_of(self), signal.SIGKILL)

    monkeypatch.setattr(show, "Window", Killed)
    with pytest.raises(show.NoWindowError, match="ended: its process was ended by SIGKILL"):
        lyceum_warp.view(lyceum_warp.make("point_mass"))


PROGRAM = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
sys.path[:0] = [{tests!r}]
from headless_screen import robot, scene_of
from lyceum_warp.viewer.session.window_process import Window

window = Window(scene_of(robot()))  # without a guard of __main__
print(window._process.pid, flush=True)
if {fork} and os.fork() == 0:
    time.sleep(5)
    os._exit(0)
time.sleep(60)
"""


@pytest.mark.long
@pytest.mark.parametrize(("number", "fork"), [(signal.SIGKILL, True), (signal.SIGINT, False)])
def test_window_ends_with_the_session(number: int, fork: bool, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(tests=str(Path(__file__).parents[2]), fork=fork))
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as session:
        assert session.stdout is not None
        pid = int(session.stdout.readline())
        session.send_signal(number)
        assert wait_until(lambda: not is_alive(pid))
