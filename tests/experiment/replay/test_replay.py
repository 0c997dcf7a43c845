from __future__ import annotations

from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from lavt.cli.main import build_app
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import Lane, Picture
from lavt.errors import UserError, WorkError
from lavt.experiment.replay.drawing import GAP_PX, WIDTH_PX, ReplayLayout, Seen, draw_scene
from lavt.experiment.replay.drive import read_driver_view, read_replay_drive
from lavt.experiment.replay.replay import replay_pictures
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.perception.detection import TRACK_CONFIDENCE
from lavt.transport.video.stamp import read_stamp


def drive(out: Path, condition: str, limit_s: float, fidelity: str = "video") -> Path:
    changes = (f"network.condition={condition}", f"vehicle.time_limit_s={limit_s}", f"fidelity={fidelity}")
    config = load_config(RunConfig, shipped("configs/demo.yaml"), [*changes, "vehicle.scenery=none"])
    run_once(plan_run(config), out)
    return out


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive for 2 s at L4, with video, and return the run directory."""
    return drive(tmp_path_factory.mktemp("replay") / "delayed", "L4", 2.0)


@pytest.fixture(scope="module")
def longer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive for 3 s at L0, without video, and return the run directory."""
    return drive(tmp_path_factory.mktemp("replay") / "longer", "L0", 3.0, "geometry")


def test_the_picture_is_that_of_the_command_in_force(delayed: Path) -> None:
    """At each moment, the stamp in the pixels of the picture is that of the newest command that has been applied."""
    drive, view = read_replay_drive(delayed), read_driver_view(delayed)
    scenes = [drive.scene(time_s) for time_s in np.arange(0.0, drive.duration_s, 0.05)]
    shown = 0
    for scene, picture in zip(scenes, view.pictures(scene.stamp_ns for scene in scenes), strict=True):
        if scene.stamp_ns is None:
            assert picture is None
            continue
        assert picture is not None
        assert read_stamp(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)) == scene.stamp_ns
        assert scene.stamp_ns in view.lanes
        shown += 1
    assert shown > 0.8 * len(scenes)


def test_the_age_is_the_frame_age(delayed: Path) -> None:
    """The mean age over the moments of a drive is that of its result, and is never below the injected delays."""
    drive = read_replay_drive(delayed)
    ages_ms = [drive.scene(time_s).frame_age_ms for time_s in np.arange(0.0, drive.duration_s, 0.001)]
    known_ms = [age_ms for age_ms in ages_ms if age_ms is not None]
    assert np.mean(known_ms) == pytest.approx(drive.result["picture_age_ms"]["mean"], rel=0.02)
    assert min(known_ms) > drive.result["injected_ms"]["video"] + drive.result["injected_ms"]["control"]


def test_a_drive_that_has_ended_shows_its_ending(delayed: Path, longer: Path) -> None:
    """Two drives are shown from their beginnings; the shorter one then keeps its last moment, with its ending."""
    first, second = read_replay_drive(delayed), read_replay_drive(longer)
    assert first.scene(0.0).state == second.scene(0.0).state == "driving"
    later_s = first.duration_s + 0.5
    assert first.scene(later_s) == first.scene(first.duration_s)
    assert first.scene(later_s).state == "timeout"
    assert second.scene(later_s).state == "driving"
    assert second.scene(later_s).time_s == pytest.approx(later_s)


def test_drives_are_side_by_side(delayed: Path, longer: Path) -> None:
    """Each drive has a column of the same height; the one without video says so."""
    picture = next(replay_pictures([delayed, longer]))
    alone = next(replay_pictures([longer]))
    assert picture.shape[1] == 2 * WIDTH_PX + GAP_PX
    assert alone.shape[0] < picture.shape[0] / 2 + 20, "a drive without video has no panel for it"


def test_a_picture_without_a_lane_says_so(delayed: Path) -> None:
    """The picture says that no lane was detected if the confidence is too low for a lane, and only then."""
    drive = read_replay_drive(delayed)
    layout = ReplayLayout(has_pictures=True, has_truth=False, longest_s=1.0, largest_error_m=1.0)
    picture = np.zeros((480, 640, 3), np.uint8)

    def drawn(confidence: float | None) -> Picture:
        lane = None if confidence is None else Lane((0.0, 0.0, 0.0), 3.5, 4.0, 20.0, confidence)
        return draw_scene(drive, drive.scene(1.0), layout, Seen(picture, lane, None))

    unknown = drawn(None)
    assert np.array_equal(drawn(TRACK_CONFIDENCE), unknown)
    assert not np.array_equal(drawn(TRACK_CONFIDENCE - 0.01), unknown)


def test_the_duration_follows_speed_and_rate(longer: Path) -> None:
    """A replay at twice the speed, with 10 pictures a second, has 5 pictures for a second of the drive."""
    duration_s = read_replay_drive(longer).duration_s
    count = sum(1 for _ in replay_pictures([longer], rate_hz=10, speed=2))
    assert count == int(duration_s * 5) + 1 + 20  # the last moment is shown for 2 s
    assert sum(1 for _ in replay_pictures([longer], rate_hz=10, until_s=1)) == 11 + 20


def test_the_car_moves(longer: Path) -> None:
    """Pictures of different moments differ."""
    pictures = list(islice(replay_pictures([longer], rate_hz=5), 6))
    assert all(np.any(first != second) for first, second in pairwise(pictures))


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".webp"])
def test_the_video_can_be_played(suffix: str, longer: Path, tmp_path: Path) -> None:
    """The command writes a video of the width asked for."""
    file = tmp_path / f"replay{suffix}"
    options = ("--out", str(file), "--until", "0.5", "--width", "320", "--rate", "5")
    build_app(["replay"])(["replay", str(longer), *options], standalone_mode=False)
    if suffix == ".webp":
        assert file.read_bytes()[8:12] == b"WEBP"
        assert b"ANIM" in file.read_bytes()
        return
    video = cv2.VideoCapture(str(file))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 3 + 10
    assert int(video.get(cv2.CAP_PROP_FRAME_WIDTH)) == 320


def test_a_run_that_never_drove_is_rejected(longer: Path, tmp_path: Path) -> None:
    """A run whose record has no drive is rejected in a sentence with its name."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("client.mcap", "result.json"):
        (run / name).write_bytes((longer / name).read_bytes())
    (run / "server.mcap").write_bytes((longer / "client.mcap").read_bytes())
    with pytest.raises(UserError, match="never drove"):
        next(replay_pictures([run]))


@pytest.mark.parametrize("result", ["[]", "1", "{}", '{"condition": "L0"}', "not JSON"])
def test_a_file_that_is_no_result_is_rejected(result: str, longer: Path, tmp_path: Path) -> None:
    """A `result.json` that is not the result of a run is rejected in a sentence that names it."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("client.mcap", "server.mcap"):
        (run / name).write_bytes((longer / name).read_bytes())
    (run / "result.json").write_text(result)
    with pytest.raises(WorkError, match=r"result\.json"):
        next(replay_pictures([run]))
