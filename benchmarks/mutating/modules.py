"""The modules that are mutated, and their tests."""

from __future__ import annotations

from pathlib import Path
from typing import Final

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES: Final = "src/lavt"

_DBW = "vehicle/dbw"
_SAFETY = (
    "safety/test_safety_machine.py",
    "safety/test_safety_commands.py",
    "safety/test_safety_arming.py",
    "safety/test_safety_session.py",
    "safety/test_safety_vehicle.py",
    "safety/test_safety_path.py",
    "safety/test_safety_page.py",
    "nodes/test_actuator_node.py",
)
_ADAPTER = tuple(
    f"{_DBW}/test_adapter_{name}.py" for name in ("engaging", "faults", "limits", "vectors", "and_gate", "properties")
)

MODULES: Final[dict[str, tuple[str, ...]]] = {
    "safety/gate.py": _SAFETY,
    "safety/session.py": _SAFETY,
    "safety/state_machine.py": _SAFETY,
    "safety/watchdog.py": _SAFETY,
    "safety/takeover_requests.py": ("safety/test_safety_session.py",),
    "safety/limits.py": (*_SAFETY, "safety/test_limiter.py", "nodes/test_driver_node.py"),
    "safety/limiter.py": ("safety/test_limiter.py", "safety/test_safety_path.py", "nodes/test_actuator_node.py"),
    "safety/issued_stamps.py": ("safety/test_issued_stamps.py", "nodes/test_camera_node.py"),
    "nodes/client_session.py": ("nodes/test_client_session.py", "nodes/test_driver_node.py"),
    "transport/security/keys.py": (
        "transport/security/test_signing_keys.py",
        "transport/security/test_envelope.py",
        "transport/security/test_gateway.py",
    ),
    "transport/security/envelope.py": (
        "transport/security/test_envelope.py",
        "transport/security/test_envelope_wire.py",
        "transport/security/test_gateway.py",
    ),
    "transport/security/gateway.py": ("transport/security/test_gateway.py",),
    "transport/security/flood_filter.py": (
        "transport/security/test_flood_filter.py",
        "transport/security/test_gateway.py",
    ),
    "transport/rtp/fec.py": (
        "transport/rtp/test_fec.py",
        "transport/video/test_stream_sender.py",
        "nodes/test_receiver_node.py",
    ),
    "transport/rtp/parity.py": ("transport/rtp/test_parity.py", "transport/rtp/test_fec.py"),
    "transport/rtp/jitter_buffer.py": (
        "transport/rtp/test_jitter_buffer.py",
        "transport/rtp/test_loss.py",
        "transport/rtp/test_reception_stats.py",
    ),
    "transport/rtp/adaptive_hold.py": ("transport/rtp/test_adaptive_hold.py", "transport/rtp/test_jitter_buffer.py"),
    "transport/rtp/rtp.py": (
        "transport/rtp/test_rtp.py",
        "transport/video/test_stream_sender.py",
        "transport/video/test_frame_codec.py",
    ),
    "transport/video/stream_sender.py": ("transport/video/test_stream_sender.py", "nodes/test_camera_node.py"),
    "transport/clock_sync/clock_report.py": (
        "transport/clock_sync/test_clock_report.py",
        "transport/clock_sync/test_chrony.py",
        "transport/clock_sync/test_ptp.py",
        "nodes/test_clock_sync_node.py",
    ),
    "experiment/analysis/metrics.py": (
        "experiment/analysis/test_metrics.py",
        "experiment/analysis/test_stage_latency.py",
        "experiment/analysis/test_validity.py",
    ),
    "experiment/analysis/tracking.py": ("experiment/analysis/test_metrics.py",),
    "experiment/statistics/intervals.py": (
        "experiment/statistics/test_intervals.py",
        "experiment/statistics/test_survival.py",
        "experiment/statistics/test_summary.py",
    ),
    "experiment/statistics/survival.py": (
        "experiment/statistics/test_survival.py",
        "experiment/statistics/test_summary.py",
    ),
    "experiment/statistics/contrasts.py": ("experiment/statistics/test_contrasts.py",),
    "experiment/analysis/clock_offset.py": ("experiment/analysis/test_clock_offset.py", "doctor/test_clock_checks.py"),
    f"{_DBW}/adapter.py": _ADAPTER,
    f"{_DBW}/bus.py": (f"{_DBW}/test_bus.py",),
    f"{_DBW}/codec.py": (f"{_DBW}/test_codec.py", f"{_DBW}/test_profile_dbc.py", f"{_DBW}/test_adapter_vectors.py"),
    f"{_DBW}/crc8.py": (f"{_DBW}/test_crc8.py",),
    f"{_DBW}/profile.py": (f"{_DBW}/test_profile.py", f"{_DBW}/test_profile_dbc.py", *_ADAPTER),
    f"{_DBW}/watchdog_test.py": (f"{_DBW}/test_watchdog_test.py",),
    f"{_DBW}/reports.py": (f"{_DBW}/test_reports.py", *_ADAPTER),
    f"{_DBW}/sending.py": _ADAPTER,
    f"{_DBW}/states.py": (*_ADAPTER, f"{_DBW}/test_by_wire_page.py"),
    f"{_DBW}/traffic.py": (f"{_DBW}/test_traffic.py",),
    f"{_DBW}/vehicle.py": (f"{_DBW}/test_vehicle.py", *_ADAPTER, "assembly/test_assembly_by_wire.py"),
}
"""For each module, its own tests, the most specific ones first; relative paths in `src/lavt` and in `tests`."""

AREAS: Final[dict[str, tuple[str, ...]]] = {
    "safety": ("safety", "nodes", "test_life_of_a_frame.py"),
    "nodes": ("nodes", "safety", "test_life_of_a_frame.py"),
    "transport": ("transport", "nodes", "test_life_of_a_frame.py"),
    "experiment": (
        "experiment/analysis",
        "experiment/statistics",
        "experiment/report",
        "experiment/runs/test_join.py",
        "experiment/runs/test_plan.py",
    ),  # these tests analyse records; the other tests of `experiment` make drives
    _DBW: (_DBW, "assembly/test_assembly_by_wire.py"),
}
"""For each area (a folder of modules), the tests that run if a mutated module's own tests pass; paths in `tests`."""


def own_tests(module: str) -> tuple[str, ...]:
    """Return the paths of a module's own tests, relative to the repository."""
    return tuple(f"tests/{path}" for path in MODULES[module])


def area_of(module: str) -> tuple[str, ...]:
    """Return the paths of the tests of a module's area, relative to the repository."""
    folder = next(folder for folder in sorted(AREAS, key=len, reverse=True) if module.startswith(f"{folder}/"))
    return tuple(f"tests/{path}" for path in AREAS[folder])


def rest_of_area(module: str) -> tuple[str, ...]:
    """Return pytest's arguments for the tests of the module's area without the module's own tests."""
    own = own_tests(module)
    return *(path for path in area_of(module) if path not in own), *(f"--ignore={path}" for path in own)
