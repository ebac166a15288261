import io

from rich.console import Console

from lyceum_warp.support.long_work import LongWork


def test_long_work_prints_its_progress_regularly() -> None:
    console = Console(file=io.StringIO(), width=120)
    with LongWork("drawing the video", "frames", console) as work:
        work(1, 500)
        assert console.file.getvalue() == ""
        began = work.began
        for seconds in (4.0, 4.5, 15.0):
            work.began = began - seconds
            work(int(20 * seconds), 500)
    assert console.file.getvalue().splitlines() == [
        "drawing the video: 80 of 500 frames, 4 s", "drawing the video: 300 of 500 frames, 15 s",
    ]  # fmt: skip
