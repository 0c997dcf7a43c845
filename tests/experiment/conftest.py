"""A synthetic run with known latencies: two records with the channels and fields that the nodes write."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S, GroundTruth, Now
from lavt.nodes.payloads import VideoUnit
from lavt.recording.record import RecordWriter
from lavt.transport.clock_sync.probe import ClockProbe

WALL_NS = 1_700_000_000_000_000_000
SERVER_MONO_NS = 1_000 * NS_PER_S
CLIENT_MONO_NS = 77 * NS_PER_S
FRAME_NS = 33_333_333


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntheticDrive:
    """The parameters of a synthetic drive. Times count from the start of the drive."""

    seconds: float = 12.0
    tau_v_ms: float = 62.0
    spread_ms: float = 2.0
    client_ms: float = 3.0
    slow_frame_ms: float = 0.0
    """How much longer the client takes for every tenth frame."""
    tau_c_ms: float = 9.0
    actuator_ms: float = 2.0
    offset_s: float = 0.25
    """Delta at the start: server's wall clock minus the client's."""
    drift: float = 20e-6
    bound_s: float | None = 0.0002
    corrected: bool = True
    """False: the client's time source reports a correction of 0, as if the offset were 0."""
    server_host: str = "vehicle"
    client_host: str = "desk"
    ending: str | None = "completed"
    wave_amplitude_m: float = 0.5
    step_s: float = 0.0
    """The step of the client's wall clock."""
    stepped_s: float = 6.0
    """The time of the step; the default is the middle of a drive of default length."""
    sampled_before_s: int = 1
    """The time before the drive in which both sides sampled their clocks."""
    server_counts: tuple[tuple[str, int], ...] = ()
    skipped: int = 0
    """The number of frames that the camera missed during the drive."""
    undecoded: int | None = 0
    """The number of undecoded frames from number 60 on; None: the record has no field `decoded`."""
    server_unsampled_s: tuple[int, int] = (0, 0)
    """The interval (end excluded) in which the server did not sample its clocks."""
    client_unsampled_s: tuple[int, int] = (0, 0)
    capture_ms: float | None = None
    """The time from a frame's exposure to its stamp; None: the camera does not report it."""
    server_clock: Callable[[int], dict[str, Any]] = lambda _second: {}
    """Further or changed fields of the server's clock sample in a second."""
    client_clock: Callable[[int], dict[str, Any]] = lambda _second: {}
    probes: bool = True
    """True if the client's probe was answered, twice per second."""
    to_server_ms: float = 0.3
    """The delay of a probe from the client to the server."""
    to_client_ms: float = 0.3
    late: int = 0
    """The number of events `late`, which report late physics."""
    began_s: float = 0.0
    """The start of the drive on the true time scale."""

    def server(self, at_ns: int) -> Now:
        """Return the server's clocks at a time of the drive; its wall clock is the reference."""
        return Now(SERVER_MONO_NS + at_ns, WALL_NS + round(self.began_s * NS_PER_S) + at_ns)

    def client(self, at_ns: int) -> Now:
        """Return the client's clocks at a time of the drive: behind by the offset, and losing `drift` per second."""
        elapsed_ns = at_ns - round(at_ns * self.drift)
        step_ns = round(self.step_s * NS_PER_S) if at_ns > self.stepped_s * NS_PER_S else 0
        wall_ns = WALL_NS + round((self.began_s - self.offset_s) * NS_PER_S)
        return Now(CLIENT_MONO_NS + elapsed_ns, wall_ns + elapsed_ns + step_ns)

    def client_correction_s(self, at_ns: int) -> float:
        """Return the correction by a perfect time source of the client, except that it misses a step in the drive."""
        step_s = self.step_s if at_ns > self.stepped_s * NS_PER_S and self.stepped_s < 0 else 0.0
        return self.offset_s - step_s + self.drift * at_ns / NS_PER_S if self.corrected else 0.0

    def tau_v_of_frame_ns(self, number: int) -> int:
        """Return the video latency of a frame: five values in turn, evenly spread about the median."""
        return round((self.tau_v_ms + self.spread_ms * (number % 5 - 2) / 2) * NS_PER_MS)


RADIUS_M = 120.0
"""The route is a left curve of this radius."""


def on_route(progress_m: float, left_m: float) -> tuple[float, float]:
    """Return x and y (m) of a point `left_m` to the left of the route."""
    angle_rad = progress_m / RADIUS_M
    return (RADIUS_M - left_m) * math.sin(angle_rad), RADIUS_M - (RADIUS_M - left_m) * math.cos(angle_rad)


def write_server(drive: SyntheticDrive, path: Path) -> None:
    writer = RecordWriter(path, "server")
    writer.annotate("versions", {"lavt": "0.1.0"})
    writer.annotate("machine", {"cores": "2"})
    points = [on_route(index / 2, 0.0) for index in range(201)]
    writer.write("route", {"name": "A key", "length_m": 100.0, "points": points}, drive.server(0))
    end_ns = round(drive.seconds * NS_PER_S)
    for second in range(-drive.sampled_before_s, math.ceil(drive.seconds) + 2):
        if second in range(*drive.server_unsampled_s):
            continue
        now = drive.server(second * NS_PER_S)
        clock = {"host": drive.server_host, "source": "chrony", "correction_s": 0.0, "bound_s": drive.bound_s}
        sample = {"mono_ns": now.mono_ns, "wall_ns": now.wall_ns, **clock, **drive.server_clock(second)}
        writer.write("clock", sample, now)
    writer.write("event", {"mono_ns": drive.server(0).mono_ns, "kind": "drive_began", "detail": ""}, drive.server(0))
    writer.write(
        "event", {"mono_ns": drive.server(5).mono_ns, "kind": "lane_invasion", "detail": "left"}, drive.server(5)
    )
    for _ in range(drive.late):
        writer.write("event", {"mono_ns": drive.server(6).mono_ns, "kind": "late", "detail": "60 ms"}, drive.server(6))
    sequence = 0
    for number in range(-3, end_ns // FRAME_NS + 1):
        at_ns = number * FRAME_NS
        if 100 <= number < 100 + drive.skipped:
            continue
        write_frame(writer, drive, number)
        for repeat in range(2):
            sequence += 1
            write_admission(writer, drive, sequence, number, repeat * 15 * NS_PER_MS)
        if number % 30 == 0:
            writer.write("video", VideoUnit(drive.server(at_ns).wall_ns, b"\0\0\0\1\x65"), drive.server(at_ns))
    for index in range(round(drive.seconds * 60) + 1):
        at_ns = index * NS_PER_S // 60
        progress_m = 8.0 * at_ns / NS_PER_S
        error_m = drive.wave_amplitude_m * math.sin(progress_m / 5)
        slope_rad = math.atan(drive.wave_amplitude_m / 5 * math.cos(progress_m / 5))
        mono_ns = drive.server(at_ns).mono_ns
        steering_rad = -0.05 * math.sin(progress_m / 5)
        x_m, y_m = on_route(progress_m, error_m)
        truth = GroundTruth(mono_ns, x_m, y_m, slope_rad, 8.0, steering_rad, error_m, slope_rad, progress_m)
        writer.write("truth", truth, drive.server(at_ns))
    if drive.server_counts:
        writer.write("counts", dict(drive.server_counts), drive.server(end_ns))
    if drive.ending is not None:
        ending = {"mono_ns": drive.server(end_ns).mono_ns, "kind": "ending", "detail": drive.ending}
        writer.write("event", ending, drive.server(end_ns))
    writer.close()


def write_frame(writer: RecordWriter, drive: SyntheticDrive, number: int) -> None:
    now = drive.server(number * FRAME_NS)
    frame = {
        "number": number,
        "stamp_ns": now.wall_ns,
        "stamped_mono_ns": now.mono_ns,
        "capture_ns": None if drive.capture_ms is None else now.mono_ns - round(drive.capture_ms * NS_PER_MS),
        "pixel_crc": number,
        "size_bytes": 4000,
        "keyframe": number % 30 == 0,
    }
    writer.write("frame", frame, now)
    stage_ends_ms = (("capture", -1), ("stamp", 0), ("encode", 4), ("packetize", 5))
    stages = [[name, now.mono_ns + end_ms * NS_PER_MS] for name, end_ms in stage_ends_ms]
    timeline = {
        "node": "camera",
        "stamp_ns": now.wall_ns,
        "channel": "wake",
        "arrived_mono_ns": now.mono_ns - 3 * NS_PER_MS,
    }
    writer.write("timeline", {**timeline, "stages": stages}, now)


def slowness_ms(drive: SyntheticDrive, number: int) -> float:
    return drive.slow_frame_ms if number % 10 == 0 else 0.0


def write_admission(writer: RecordWriter, drive: SyntheticDrive, sequence: int, number: int, delay_ns: int) -> None:
    read_ns = number * FRAME_NS + drive.tau_v_of_frame_ns(number)
    client_ms = drive.client_ms + slowness_ms(drive, number)
    sent_ns = read_ns + round(client_ms * NS_PER_MS) + delay_ns
    received_ns = sent_ns + round(drive.tau_c_ms * NS_PER_MS)
    applied_ns = received_ns + round(drive.actuator_ms * NS_PER_MS)
    rejected = sequence % 100 == 98  # an even number: a repeated command, so its rejection changes no loop latency
    admission: dict[str, Any] = {
        "epoch": 1,
        "sequence": sequence,
        "stamp_ns": drive.server(number * FRAME_NS).wall_ns,
        "sent_wall_ns": drive.client(sent_ns).wall_ns,
        "stamp_received_wall_ns": drive.client(read_ns).wall_ns,
        "received_mono_ns": drive.server(received_ns).mono_ns,
        "received_wall_ns": drive.server(received_ns).wall_ns,
        "applied_mono_ns": None if rejected else drive.server(applied_ns).mono_ns,
        "verdict": "rejected" if rejected else "accepted",
        "reason": "sequence" if rejected else "",
        "limited": "",
        "steering_rad": 0.05 * math.sin(sequence / 20),
        "throttle": 0.2,
        "brake": 0.0,
    }
    writer.write("admission", admission, drive.server(applied_ns))


def write_client(drive: SyntheticDrive, path: Path) -> None:
    writer = RecordWriter(path, "client")
    for second in range(-drive.sampled_before_s, math.ceil(drive.seconds) + 2):
        if second in range(*drive.client_unsampled_s):
            continue
        at_ns = second * NS_PER_S
        now = drive.client(at_ns)
        correction_s = drive.client_correction_s(at_ns)
        clock = {"host": drive.client_host, "source": "chrony", "correction_s": correction_s, "bound_s": drive.bound_s}
        sample = {"mono_ns": now.mono_ns, "wall_ns": now.wall_ns, **clock, **drive.client_clock(second)}
        writer.write("clock", sample, now)
    for index in range(
        -2 * drive.sampled_before_s, round(drive.seconds * 2) + 3 if drive.probes else -2 * drive.sampled_before_s
    ):
        write_probe(writer, drive, index)
    for number in range(-3, round(drive.seconds * NS_PER_S) // FRAME_NS + 1):
        stamp_ns = drive.server(number * FRAME_NS).wall_ns
        read_at = drive.client(number * FRAME_NS + drive.tau_v_of_frame_ns(number))
        decoded = not 60 <= number < 60 + (drive.undecoded or 0)
        readable = decoded and number % 50 != 49
        picture: dict[str, Any] = {
            "stamp_ns": stamp_ns if readable else None,
            "readable": readable,
            "reason": "" if readable else "checksum" if decoded else "no picture",
            **({} if drive.undecoded is None else {"decoded": decoded}),
            "rtp_timestamp": stamp_ns * 9 // 100_000 % 2**32,
            "packet_mono_ns": read_at.mono_ns - 10 * NS_PER_MS,
            "decoded_mono_ns": read_at.mono_ns - 1 * NS_PER_MS,
            "read_mono_ns": read_at.mono_ns,
            "read_wall_ns": read_at.wall_ns,
        }
        writer.write("picture", picture, read_at)
        arrived_ns = read_at.mono_ns - 4 * NS_PER_MS
        stage_ends_ms = (
            ("reorder", 1),
            ("decode", 3),
            ("read_stamp", 4),
            ("lane", 6),
            ("control", 7 + slowness_ms(drive, number)),
        )
        stages = [[name, arrived_ns + round(end_ms * NS_PER_MS)] for name, end_ms in stage_ends_ms]
        timeline = {"node": "driver", "stamp_ns": stamp_ns, "channel": "access_unit", "arrived_mono_ns": arrived_ns}
        writer.write("timeline", {**timeline, "stages": stages}, read_at)
    writer.close()


def write_probe(writer: RecordWriter, drive: SyntheticDrive, index: int) -> None:
    sent_ns = index * NS_PER_S // 2
    received_ns = sent_ns + round(drive.to_server_ms * NS_PER_MS)
    answered_ns = received_ns + NS_PER_MS // 10
    arrived_ns = answered_ns + round(drive.to_client_ms * NS_PER_MS)
    probe = ClockProbe(
        index % 2**32,
        drive.client(sent_ns).wall_ns,
        drive.server(received_ns).wall_ns,
        drive.server(answered_ns).wall_ns,
        drive.client(arrived_ns).wall_ns,
    )
    writer.write("clock_probe", probe, drive.client(arrived_ns))


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Path]:
    """Return a function that writes both records of a synthetic drive; its keywords are the fields of the drive."""

    def make(directory: Path, **settings: Any) -> Path:
        directory.mkdir(parents=True, exist_ok=True)
        drive = SyntheticDrive(**settings)
        write_server(drive, directory / "server.mcap")
        write_client(drive, directory / "client.mcap")
        return directory

    return make
