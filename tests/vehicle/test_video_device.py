from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from tests.vehicle.moving_video import MODEL, PICTURE_COUNT, number_of, write_video

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel
from lavt.errors import UserError
from lavt.vehicle import video_device
from lavt.vehicle.camera import CapturedFrame, FrameTimes
from lavt.vehicle.video_device import RETRY_S, VideoDevice, buffer_time_ns

TIMEOUT_S = 20.0
"""Timeout of every wait."""
OpenCamera = Callable[..., VideoDevice]


@pytest.fixture
def open_camera() -> Iterator[OpenCamera]:
    opened: list[VideoDevice] = []

    def device(
        path: Path | str, *, rate_hz: float = 30.0, model: CameraModel = MODEL, pixel_format: str = ""
    ) -> VideoDevice:
        clock = MachineClock()
        opened.append(VideoDevice(str(path), model=model, rate_hz=rate_hz, clock=clock, pixel_format=pixel_format))
        return opened[-1]

    yield device
    for camera in opened:
        camera.close()


def now_ns() -> int:
    return MachineClock().now().mono_ns


def next_frame(camera: VideoDevice) -> CapturedFrame:
    """Return the next frame that is not too old; on a busy machine some frames are too old."""
    end_ns = now_ns() + round(TIMEOUT_S * NS_PER_S)
    while now_ns() < end_ns:
        assert camera.wait(TIMEOUT_S)
        frame = camera.capture(0, now_ns(), None)
        if frame is not None:
            return frame
    raise AssertionError("every frame was too old")


def wait_until(camera: VideoDevice, name: str, count: int) -> None:
    """Capture frames until a counter reaches a value."""
    end_ns = now_ns() + round(TIMEOUT_S * NS_PER_S)
    while camera.counts.get(name, 0) < count and now_ns() < end_ns:
        if camera.wait(0.02):
            camera.capture(0, now_ns(), None)
    assert camera.counts.get(name, 0) >= count


def test_a_picture_is_returned_once(tmp_path: Path, open_camera: OpenCamera) -> None:
    """The first picture is available immediately; a request before the next picture arrives returns no frame."""
    camera = open_camera(write_video(tmp_path / "slow.avi", rate_hz=0.5), rate_hz=0.5)

    first = camera.capture(7, now_ns(), None)
    assert first is not None
    assert (first.number, first.capture_ns, number_of(first.picture)) == (7, None, 0)
    assert camera.capture(8, now_ns(), None) is None


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_slightly_late_picture_is_waited_for(tmp_path: Path, open_camera: OpenCamera) -> None:
    """Each request waits up to a quarter of the period, so one of several in a row receives the next picture."""
    camera = open_camera(write_video(tmp_path / "slow.avi", rate_hz=2.0), rate_hz=2.0)

    assert number_of(next_frame(camera).picture) == 0
    requested = [camera.capture(number, now_ns(), None) for number in range(7)]
    frames = [frame for frame in requested if frame is not None]
    assert [number_of(frame.picture) for frame in frames] in ([1], [1, 2])


@pytest.mark.realtime
@pytest.mark.judges_times(share=0.05)
def test_pictures_that_arrive_just_when_requested_are_not_missed(tmp_path: Path, open_camera: OpenCamera) -> None:
    """If each request is made just when a picture arrives, nearly every request receives a picture."""
    camera = open_camera(write_video(tmp_path / "fast.avi", rate_hz=50.0), rate_hz=50.0)

    next_frame(camera)
    assert camera.wait(TIMEOUT_S)
    due = FrameTimes(now_ns(), 50.0)
    frames = 0
    for number in range(150):
        pause(due.due_ns(number) - now_ns())
        frames += camera.capture(number, due.due_ns(number), None) is not None
    assert frames >= 145


@pytest.mark.realtime
@pytest.mark.judges_times
def test_the_newest_picture_is_returned(tmp_path: Path, open_camera: OpenCamera) -> None:
    """After several pictures a request returns the newest; the pictures before the newest are counted as replaced."""
    camera = open_camera(write_video(tmp_path / "fast.avi", rate_hz=60.0), rate_hz=60.0)

    assert number_of(next_frame(camera).picture) == 0
    second = number_of(next_frame(camera).picture)
    end_ns = now_ns() + round(TIMEOUT_S * NS_PER_S)
    while camera.counts["pictures_read"] < second + 4 and now_ns() < end_ns:
        threading.Event().wait(0.005)
    newest = number_of(next_frame(camera).picture)
    counts = camera.counts
    assert newest >= second + 3
    assert counts["pictures_read"] - counts["pictures_replaced"] in {
        3,
        4,
    }  # the three returned pictures, and perhaps one that waits


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_file_is_played_at_its_own_rate_in_a_loop(tmp_path: Path, open_camera: OpenCamera) -> None:
    """A file's pictures are one period apart (median), the first follows the last, and the file is never lost."""
    camera = open_camera(write_video(tmp_path / "fast.avi", rate_hz=50.0), rate_hz=50.0)

    arrivals = []
    for _ in range(2 * PICTURE_COUNT):
        frame = next_frame(camera)
        arrivals.append((now_ns(), number_of(frame.picture)))
    periods_ms = [(after_ns - before_ns) / NS_PER_MS for (before_ns, _), (after_ns, _) in pairwise(arrivals)]
    assert 18 < median(periods_ms) < 22
    assert [number for _, number in arrivals].count(0) >= 2
    assert camera.counts["times_opened_again"] >= 1
    assert camera.counts["times_lost"] == 0


def test_a_files_pictures_have_no_capture_time(tmp_path: Path, open_camera: OpenCamera) -> None:
    """Only V4L2 reports capture times; a file's pictures have a position but no capture time, and are counted."""
    camera = open_camera(write_video(tmp_path / "fast.avi", rate_hz=60.0), rate_hz=60.0)

    assert {next_frame(camera).capture_ns for _ in range(5)} == {None}
    assert camera.counts["pictures_without_a_time"] == camera.counts["pictures_read"] >= 5


@pytest.mark.parametrize(
    ("position_ms", "captured_ns"),
    [
        (5000.0, 5_000_000_000),
        (4999.123, 4_999_123_000),
        (4000.0, 4_000_000_000),
        (3999.999, None),
        (5000.001, None),
        (0.0, None),
        (1.8e12, None),
        (-1.0, None),
        (float("nan"), None),
        (float("inf"), None),
    ],
)
def test_a_buffer_time_must_lie_within_the_second_before_arrival(position_ms: float, captured_ns: int | None) -> None:
    """A V4L2 buffer time of another clock, in the future, or over a second old is unknown."""
    assert buffer_time_ns(position_ms, 5 * NS_PER_S) == captured_ns


def test_a_buffer_time_keeps_its_microseconds_after_years() -> None:
    """After ten years of uptime OpenCV's time in milliseconds is still accurate to a microsecond."""
    captured_ns = 10 * 365 * 86_400 * NS_PER_S + 123_456_000
    assert buffer_time_ns(captured_ns / NS_PER_MS, captured_ns + 5) is not None
    assert abs((buffer_time_ns(captured_ns / NS_PER_MS, captured_ns + 500) or 0) - captured_ns) <= 500


def test_an_old_picture_is_not_returned(tmp_path: Path, open_camera: OpenCamera) -> None:
    """A picture older than two periods is counted and not returned."""
    camera = open_camera(write_video(tmp_path / "slow.avi", rate_hz=1.0), rate_hz=1.0)

    assert camera.capture(0, now_ns() + 3 * NS_PER_S, None) is None
    assert camera.counts["pictures_too_old"] == 1
    assert number_of(next_frame(camera).picture) >= 1


def test_pictures_share_no_memory(tmp_path: Path, open_camera: OpenCamera) -> None:
    """Two pictures share no memory and are writeable, because a stamp is written into each picture."""
    camera = open_camera(write_video(tmp_path / "fast.avi", rate_hz=60.0), rate_hz=60.0)

    first, second = next_frame(camera).picture, next_frame(camera).picture
    assert first.flags.writeable
    assert second.flags.writeable
    assert not np.shares_memory(first, second)


@pytest.mark.parametrize(
    ("requested", "rate_hz"),
    [(CameraModel(640, 480), 30.0), (MODEL, 25.0), (CameraModel(240, 320), 30.0)],
)
def test_another_size_or_rate_is_rejected(
    tmp_path: Path, open_camera: OpenCamera, requested: CameraModel, rate_hz: float
) -> None:
    """A device without the requested size and rate is rejected; the error has the device's and the requested size."""
    path = write_video(tmp_path / "video.avi", rate_hz=30.0)
    with pytest.raises(UserError, match=f"320x240 at 30 Hz.*{requested.width_px}x{requested.height_px}"):
        open_camera(path, model=requested, rate_hz=rate_hz)


def test_another_format_is_rejected(tmp_path: Path, open_camera: OpenCamera) -> None:
    """A device without the requested format is rejected; a device with this format is accepted."""
    path = write_video(tmp_path / "video.avi", rate_hz=30.0)
    assert open_camera(path, pixel_format="MJPG").wait(TIMEOUT_S)
    with pytest.raises(UserError, match="YUYV"):
        open_camera(path, pixel_format="YUYV")


def test_a_rate_within_a_thousandth_is_accepted(tmp_path: Path, open_camera: OpenCamera) -> None:
    """A camera of 29.97 Hz is accepted where 30 Hz are requested."""
    assert open_camera(write_video(tmp_path / "video.avi", rate_hz=30000 / 1001)).wait(TIMEOUT_S)


@pytest.mark.parametrize("device", ["/dev/video97", "97", "/dev/null", "nowhere.avi", "no_video.avi"])
def test_a_device_that_cannot_be_opened_is_rejected(
    tmp_path: Path, open_camera: OpenCamera, device: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """A missing device, or a file that is no camera, is an error of one line, and OpenCV prints nothing."""
    (tmp_path / "no_video.avi").write_bytes(bytes(5000))
    device_or_path = str(tmp_path / device) if device.endswith(".avi") else device
    with pytest.raises(UserError, match="cannot be opened as a camera") as rejected:
        open_camera(device_or_path)
    assert "\n" not in str(rejected.value)
    assert capfd.readouterr().err == ""


def test_an_address_without_an_answer_is_rejected(open_camera: OpenCamera) -> None:
    """A network camera that does not answer is rejected."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UserError, match=f"{address} cannot be opened as a camera"):
        open_camera(address)


def test_a_video_without_pictures_is_rejected(tmp_path: Path, open_camera: OpenCamera) -> None:
    """A video file without any picture is rejected."""
    whole = write_video(tmp_path / "whole.avi", rate_hz=30.0).read_bytes()
    path = tmp_path / "cut.avi"
    path.write_bytes(whole[: whole.index(b"movi") + 4])
    with pytest.raises(UserError, match=r"cut.avi (opens, but has no pictures|cannot be opened)"):
        open_camera(path)


def test_a_lost_file_is_reopened(tmp_path: Path, open_camera: OpenCamera, caplog: pytest.LogCaptureFixture) -> None:
    """A camera whose file is missing has no pictures, logs the loss once, and retries until the file is back."""
    path = write_video(tmp_path / "short.avi", rate_hz=50.0, pictures=5)
    camera = open_camera(path, rate_hz=50.0)
    hidden = path.rename(tmp_path / "elsewhere.avi")

    wait_until(camera, "times_lost", 1)
    lost_ns, opened_times = now_ns(), camera.counts["times_opened_again"]
    wait_until(camera, "times_opened_again", opened_times + 2)
    assert now_ns() - lost_ns > RETRY_S * NS_PER_S
    assert camera.capture(0, now_ns(), None) is None
    assert (camera.counts["times_lost"], camera.counts["times_back"]) == (1, 0)
    hidden.rename(path)
    assert camera.wait(TIMEOUT_S)
    assert (camera.counts["times_lost"], camera.counts["times_back"]) == (1, 1)
    camera.close()
    assert [("no more" in record.getMessage(), "again" in record.getMessage()) for record in caplog.records] == [
        (True, False),
        (False, True),
    ]


def test_a_broken_stream_is_reconnected(tmp_path: Path, open_camera: OpenCamera) -> None:
    """When the connection to a network camera ends, the camera is counted as lost until it answers again."""
    video = write_video(tmp_path / "video.avi", rate_hz=30.0).read_bytes()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            for _ in range(2):
                connection, _ = server.accept()
                with connection:
                    connection.sendall(video)

        sender = threading.Thread(target=serve, daemon=True)
        sender.start()
        camera = open_camera(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        wait_until(camera, "times_back", 1)
        sender.join(TIMEOUT_S)
    wait_until(camera, "times_lost", 2)
    assert camera.counts["pictures_read"] == 2 * PICTURE_COUNT
    assert camera.counts["times_back"] == 1


def test_pictures_of_another_size_are_dropped(tmp_path: Path, open_camera: OpenCamera) -> None:
    """Pictures of another size, from a camera that replaced the first one, are not returned."""
    path = write_video(tmp_path / "short.avi", rate_hz=50.0, pictures=5)
    other = write_video(tmp_path / "other.avi", rate_hz=50.0, model=CameraModel(160, 120))
    camera = open_camera(path, rate_hz=50.0)
    other.replace(path)

    wait_until(camera, "pictures_of_another_size", 3)
    pictures_read = camera.counts["pictures_read"]
    wait_until(camera, "pictures_of_another_size", 6)
    assert camera.counts["pictures_read"] == pictures_read


def test_closing_a_camera_ends_its_thread(
    tmp_path: Path, open_camera: OpenCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closing a camera ends its thread, even while the thread waits to reopen the device."""
    monkeypatch.setattr(video_device, "RETRY_S", 1000.0)
    path = write_video(tmp_path / "short.avi", rate_hz=50.0, pictures=2)
    camera = open_camera(path, rate_hz=50.0)
    path.unlink()
    wait_until(camera, "times_lost", 1)
    camera.close()
    assert "camera device" not in {thread.name for thread in threading.enumerate()}
