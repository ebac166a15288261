import contextlib
import os
import signal
import socket
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
from lyceum_warp.viewer.protocol import latest
from lyceum_warp.viewer.session.window_process import Window
from lyceum_warp.viewer.window.proxy import SCRIPT

MODEL = robot()
DATA = mujoco.MjData(MODEL)


@pytest.fixture(scope="module")
def shared_window() -> Iterator[Window]:
    with Window(scene_of(MODEL)) as window:
        yield window


@pytest.fixture
def window() -> Iterator[Window]:
    with Window(scene_of(MODEL)) as window:
        yield window


def page(window: Window, path: str = "") -> bytes:
    """What a browser gets that was opened with the address."""
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with browser.open(window.address, timeout=10) as response:
        content: bytes = response.read()
        address = response.url
    if path:
        with browser.open(urllib.parse.urljoin(address, path), timeout=10) as response:
            content = response.read()
    return content


def port_of(window: Window) -> int:
    return urllib.parse.urlsplit(window.address).port or 0


def process_of(window: Window) -> int:
    return window._process.pid


def wait_until(done: object, seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if done():  # type: ignore[operator]
            return True
        time.sleep(0.02)
    return False


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that ended and is not waited for does not."""
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


# a window that runs


def test_page_and_model_are_served(shared_window: Window) -> None:
    assert shared_window.is_open()
    assert b"canvas" in page(shared_window)
    assert SCRIPT.encode() in page(shared_window)
    assert wait_until(lambda: len(page(shared_window, "model")) > 1000)


def test_process_listens_on_the_loopback_address_only(shared_window: Window) -> None:
    own = {os.readlink(link) for link in Path(f"/proc/{process_of(shared_window)}/fd").iterdir()}
    listening = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in own:
                listening.add(fields[1].partition(":")[0])
    assert listening == {"0100007F", "00000000000000000000000001000000"}  # 127.0.0.1, ::1


def test_process_does_not_load_torch_or_warp(shared_window: Window) -> None:
    maps = Path(f"/proc/{process_of(shared_window)}/maps").read_text()
    assert "mujoco" in maps
    assert "torch" not in maps
    assert "/warp/" not in maps


def test_frames_are_taken_without_a_browser(shared_window: Window) -> None:
    assert shared_window.commands() == []
    assert wait_until(lambda: shared_window.wants_frame)
    shared_window.show(frame_of(MODEL, DATA))
    assert not shared_window.wants_frame
    assert wait_until(lambda: shared_window.wants_frame)


def test_studio_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with Window(scene_of(MODEL)) as window:
        assert page(window)
    assert capfd.readouterr() == ("", "")


# frames that wait


def test_show_never_waits_for_a_window_that_hangs(window: Window) -> None:
    os.kill(process_of(window), signal.SIGSTOP)
    try:
        frame = frame_of(MODEL, DATA, samples=np.ones((1, 3)), messages=("end",))
        began = time.monotonic()
        for _ in range(2000):
            window.show(frame)
        assert time.monotonic() - began < 20  # a pipe that is full would not be emptied
    finally:
        os.kill(process_of(window), signal.SIGCONT)


def test_latest_frame_has_the_points_and_messages_of_those_before() -> None:
    frames = [
        frame_of(MODEL, DATA, samples=np.array([[0.0, 1, 2]]), messages=("one",)),
        frame_of(MODEL, DATA),
        frame_of(MODEL, DATA, samples=np.array([[0.1, 3, 4]]), messages=("two", "three")),
    ]
    merged = None
    for frame in frames:
        merged = latest(merged, frame)
    assert merged is not None
    np.testing.assert_array_equal(merged.samples, [[0.0, 1, 2], [0.1, 3, 4]])
    assert merged.messages == ("one", "two", "three")
    assert merged.pose is frames[-1].pose


def test_frames_that_wait_for_hours_keep_a_limited_number_of_points() -> None:
    merged = frame_of(MODEL, DATA)
    for i in range(30):
        merged = latest(merged, frame_of(MODEL, DATA, samples=np.full((1000, 3), i), messages=("m",) * 10))
    assert len(merged.samples) == 20_000 and len(merged.messages) == 200


# ends


def test_close_ends_the_process_and_may_be_called_twice() -> None:
    window = Window(scene_of(MODEL))
    pid = process_of(window)
    window.close()
    window.close()
    assert window._process.returncode != -signal.SIGKILL
    assert not is_alive(pid)
    assert not window.is_open()
    window.show(frame_of(MODEL, DATA))  # without effect


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM])
def test_process_that_ends_while_it_is_sent_frames_is_an_error(number: signal.Signals) -> None:
    """The thread that sends notices it first."""
    with Window(scene_of(MODEL)) as window:
        os.kill(process_of(window), signal.SIGSTOP)
        frame = frame_of(MODEL, DATA, samples=np.zeros((20_000, 3)))
        for _ in range(5):  # fills the connection
            window.show(frame)
            time.sleep(0.02)
        os.kill(process_of(window), number)
        os.kill(process_of(window), signal.SIGCONT)
        assert wait_until(lambda: not window.is_open())
        assert window.error == f"its process was ended by {number.name}"


def test_killed_window_ends_the_view_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    env = lyceum_warp.Env("point_mass", nworld=1)

    def kill(window: Window) -> None:
        time.sleep(1.0)
        os.kill(process_of(window), signal.SIGKILL)

    class Killed(Window):
        def __init__(self, *args: object, **options: object) -> None:
            super().__init__(*args, **options)  # type: ignore[arg-type]
            threading.Thread(target=kill, args=(self,), daemon=True).start()

    monkeypatch.setattr(show, "Window", Killed)
    with pytest.raises(show.NoWindowError, match="ended: its process was ended by SIGKILL"):
        lyceum_warp.view(env, gfx="web")


def test_close_leaves_no_descriptor_open() -> None:
    def opened() -> int:
        return len(os.listdir("/proc/self/fd"))

    with Window(scene_of(MODEL)):
        pass
    before, threads = opened(), threading.active_count()
    for _ in range(2):
        with Window(scene_of(MODEL)):
            pass
    assert opened() == before
    assert threading.active_count() == threads


def test_ctrl_c_does_not_end_the_window(window: Window) -> None:
    os.kill(process_of(window), signal.SIGINT)
    time.sleep(0.3)
    assert window.is_open()
    assert page(window)
    assert os.getpgid(process_of(window)) != os.getpgid(0)  # the terminal's Ctrl-C does not reach it


PROGRAM = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
sys.path[:0] = [{tests!r}]
from headless_screen import robot, scene_of
from lyceum_warp.viewer.session.window_process import Window

window = Window(scene_of(robot()))  # without a guard of __main__
print(window._process.pid, flush=True)
if {fork}:
    if os.fork() == 0:
        time.sleep(5)
        os._exit(0)
time.sleep(60)
"""


@pytest.mark.parametrize(("number", "fork"), [(signal.SIGKILL, True), (signal.SIGINT, False)])
def test_window_ends_with_the_session(number: int, fork: bool, tmp_path: Path) -> None:
    """A fork of the session holds the connection open."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(tests=str(Path(__file__).parents[2]), fork=fork))
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as session:
        assert session.stdout is not None
        pid = int(session.stdout.readline())
        assert is_alive(pid)
        session.send_signal(number)
        assert wait_until(lambda: not is_alive(pid))


# windows that cannot be opened


def test_port_in_use_is_one_line(window: Window) -> None:
    with pytest.raises(ValueError, match=str(port_of(window))) as caught:
        Window(scene_of(MODEL), port=port_of(window))
    assert "\n" not in str(caught.value)


def test_windows_that_cannot_be_opened_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="cannot be opened: there is no display"):
        Window(scene_of(MODEL), gfx="native")
    with pytest.raises(ValueError, match="'web' or 'native', not 'opengl'"):
        Window(scene_of(MODEL), gfx="opengl")  # type: ignore[arg-type]


def test_given_port_is_taken() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with Window(scene_of(MODEL), port=port) as window:
        assert port_of(window) == port
        assert page(window)
