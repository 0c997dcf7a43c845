"""The three fidelities of a virtual run: what must not differ between them, and what may by how much."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from lavt.assembly.fidelity import FIDELITIES
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.experiment.report.tables import FIDELITY_DESCRIPTIONS
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once
from lavt.experiment.runs.virtual_run import build_loop, drive
from lavt.recording.record import read_record

P95_WITHIN_M = 0.05
"""The detector counts paint in cells of 0.05 m, and sees the lane up to that much beside the truth; largest difference
measured between geometry and video, L0 and L2, both presets, two seeds: 0.027 m. Pixels against video: 0.008 m."""


def planned(*changes: str) -> PlannedRun:
    return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), ("vehicle.scenery=none", *changes)))


@cache
def result(fidelity: str, condition: str) -> dict[str, Any]:
    """Drive once for all tests of this file."""
    with TemporaryDirectory() as folder:
        return run_once(planned(f"fidelity={fidelity}", f"network.condition={condition}"), Path(folder) / "run")


@pytest.mark.full
@pytest.mark.parametrize("condition", ["L0", "L2"])
@pytest.mark.parametrize("fidelity", ["pixels", "geometry"])
def test_latency_is_the_same_in_all(fidelity: str, condition: str) -> None:
    """With the same seed every latency is that of video within 1 ms: costs, links and order act on all alike."""
    video, other = result("video", condition), result(fidelity, condition)
    for name in ("loop_ms", "tau_v_ms", "tau_c_ms"):
        for share in ("p5", "p50", "p95"):
            assert other[name][share] == pytest.approx(video[name][share], abs=1), (name, share)
    assert other["picture_age_ms"] == pytest.approx(video["picture_age_ms"], abs=1)
    assert (other["frames_sent"], other["frames_unreadable"]) == (pytest.approx(video["frames_sent"], abs=2), 0)


@pytest.mark.full
@pytest.mark.parametrize("condition", ["L0", "L2"])
@pytest.mark.parametrize("fidelity", ["pixels", "geometry"])
def test_driving_is_similar_in_all(fidelity: str, condition: str) -> None:
    """With the same seed the drive ends alike, as long, and with a cross-track P95 that a cell of the grid explains."""
    video, other = result("video", condition), result(fidelity, condition)
    assert (other["fidelity"], other["ending"], other["valid"]) == (fidelity, video["ending"], True)
    assert other["duration_s"] == pytest.approx(video["duration_s"], abs=0.1)
    assert other["p95_m"] == pytest.approx(video["p95_m"], abs=P95_WITHIN_M)


def test_what_fails_by_delay_fails_without_pixels_too(tmp_path: Path) -> None:
    """At L5 the calibrated preset leaves its lane at fidelity geometry: it is the loop's dynamics, not the pixels'."""
    changes = ("fidelity=geometry", "network.inherent=paper_wifi5", "network.condition=L5")
    entry = run_once(planned(*changes), tmp_path / "run")
    assert entry["ending"] != "completed"
    assert entry["lane_invasions"] > 0


@pytest.mark.parametrize("fidelity", ["pixels", "geometry"])
def test_the_digest_repeats(fidelity: str, tmp_path: Path) -> None:
    """Equal runs have equal digests at every fidelity, and another seed has another."""
    digests = []
    for number, seed in enumerate((1, 1, 2)):
        loop = build_loop(planned(f"fidelity={fidelity}", f"seed={seed}"), tmp_path / str(number))
        drive(loop, limit_ns=3 * NS_PER_S)
        digests.append(loop.digest.hexdigest())
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.parametrize("fidelity", ["pixels", "geometry"])
def test_what_is_no_video_is_not_recorded_as_one(fidelity: str, tmp_path: Path) -> None:
    """Only at video there are access units in the record, and at geometry nothing that another channel says as well."""
    loop = build_loop(planned(f"fidelity={fidelity}"), tmp_path / "run")
    drive(loop, limit_ns=3 * NS_PER_S)
    server, client = (read_record(tmp_path / "run" / name) for name in ("server.mcap", "client.mcap"))
    assert server.video() == client.video() == []
    said_twice = {"rtp", "control", "state"}
    assert {"frame", "truth", "admission", "timeline"} <= set(server.tables)
    assert {"picture", "lane", "timeline"} <= set(client.tables)
    expected = said_twice if fidelity == "pixels" else set()
    assert said_twice & set(server.tables) == said_twice & set(client.tables) == expected


def test_lost_frames_are_survived_and_counted(tmp_path: Path) -> None:
    """Packets that get lost are lost pictures at fidelity geometry as well, and no other picture suffers."""
    loop = build_loop(planned("fidelity=geometry"), tmp_path / "run")
    link = loop.runtime.links["rtp"]
    for at_ns, opened in ((1_500_000_000, False), (1_560_000_000, True)):
        loop.runtime.at(at_ns, setattr, link, "open", opened)
    drive(loop, limit_ns=3 * NS_PER_S)
    counts = loop.client.receiver.counts
    assert 1 <= counts["packets_lost"] <= 2
    assert loop.client.driver.counts["frames_unreadable"] == 0
    assert loop.server.camera.counts["frames_sent"] - loop.client.driver.counts["frames_decoded"] <= 4


def test_every_fidelity_is_named_in_the_report() -> None:
    """The report can say of each fidelity what was modelled."""
    assert set(FIDELITY_DESCRIPTIONS) == set(FIDELITIES)


def test_geometry_needs_a_known_road(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A vehicle that does not tell its road is refused in a sentence at fidelity geometry."""
    monkeypatch.setattr("lavt.assembly.vehicles.VEHICLES", {"simulator": None, "boat": None})
    with pytest.raises(UserError, match=r"choose vehicle.kind simulator instead of 'boat'"):
        build_loop(planned("vehicle.kind=boat", "fidelity=geometry"), tmp_path / "run")


ORDERED = ("L0", "L1", "L2", "L3", "L4", "L5")


def badness(fidelity: str, condition: str) -> tuple[bool, float]:
    """How badly a drive went: one that was not completed is worse the earlier it ended, else its P95 decides."""
    with TemporaryDirectory() as folder:
        changes = (f"fidelity={fidelity}", f"network.condition={condition}", "network.inherent=paper_wifi5", "seed=3")
        entry = run_once(planned(*changes), Path(folder) / "run")
    return entry["ending"] != "completed", entry["p95_m"] if entry["ending"] == "completed" else -entry["distance_m"]


@pytest.mark.full
def test_pixels_and_geometry_order_the_conditions_alike() -> None:
    """From L0 to L5 drives get worse with total delay, with pixels as without them; L3 and L4, of equal delay, tie."""
    orders = {}
    for fidelity in ("pixels", "geometry"):
        bad = {name: badness(fidelity, name) for name in ORDERED}
        assert bad["L0"] < bad["L1"] < bad["L2"] < min(bad["L3"], bad["L4"]) <= max(bad["L3"], bad["L4"]) < bad["L5"], (
            bad
        )
        orders[fidelity] = {name: failed for name, (failed, _) in bad.items()}
    assert orders["pixels"] == orders["geometry"]
