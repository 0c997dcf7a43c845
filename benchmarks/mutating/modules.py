"""The modules that are mutated, and the tests that are about them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES: Final = "src/lavt"

_DBW = "vehicle/dbw"
_SAFETY = (
    "control/test_safety_machine.py", "control/test_safety_commands.py", "control/test_safety_arming.py",
    "control/test_safety_session.py", "control/test_safety_vehicle.py", "control/test_safety_path.py",
    "control/test_safety_page.py", "nodes/test_actuator_node.py",
)  # fmt: skip
_ADAPTER = tuple(
    f"{_DBW}/test_adapter_{name}.py" for name in ("engaging", "faults", "limits", "vectors", "and_gate", "properties")
)

MODULES: Final[dict[str, tuple[str, ...]]] = {
    "control/safety.py": _SAFETY,
    "control/claims.py": ("control/test_safety_session.py",),
    "control/limits.py": (*_SAFETY, "control/test_limiter.py", "nodes/test_driver_node.py"),
    "control/limiter.py": ("control/test_limiter.py", "control/test_safety_path.py", "nodes/test_actuator_node.py"),
    "control/written.py": ("control/test_written.py", "nodes/test_camera_node.py"),
    "nodes/client_session.py": ("nodes/test_client_session.py", "nodes/test_driver_node.py"),
    "transport/signing.py": ("transport/test_signing.py", "transport/test_sealing.py", "transport/test_door.py"),
    "transport/sealing.py": ("transport/test_sealing.py", "transport/test_sealing_wire.py", "transport/test_door.py"),
    "transport/door.py": ("transport/test_door.py",),
    "transport/screen.py": ("transport/test_screen.py", "transport/test_door.py"),
    "transport/fec.py": ("transport/test_fec.py", "transport/test_rtp_stream.py", "nodes/test_receiver_node.py"),
    "transport/erasure.py": ("transport/test_erasure.py", "transport/test_fec.py"),
    "transport/reorder.py": ("transport/test_reorder.py", "transport/test_loss.py", "transport/test_reception.py"),
    "transport/hold.py": ("transport/test_hold.py", "transport/test_reorder.py"),
    "transport/rtp.py": ("transport/test_rtp.py", "transport/test_rtp_stream.py", "transport/test_pictures.py"),
    "transport/rtp_stream.py": ("transport/test_rtp_stream.py", "nodes/test_camera_node.py"),
    "transport/clock_offset.py": (
        "transport/test_clock_offset.py", "transport/test_chrony.py", "transport/test_ptp.py",
        "nodes/test_clock_sync_node.py",
    ),
    "experiment/metrics.py": ("experiment/test_metrics.py", "experiment/test_hops.py", "experiment/test_validity.py"),
    "experiment/tracking.py": ("experiment/test_metrics.py",),
    "experiment/statistics.py": (
        "experiment/test_statistics.py", "experiment/test_survival.py", "experiment/test_summary.py",
    ),
    "experiment/survival.py": ("experiment/test_survival.py", "experiment/test_summary.py"),
    "experiment/contrasts.py": ("experiment/test_contrasts.py",),
    "experiment/offset.py": ("experiment/test_offset.py", "experiment/test_clock_check.py"),
    f"{_DBW}/adapter.py": _ADAPTER,
    f"{_DBW}/bus.py": (f"{_DBW}/test_bus.py",),
    f"{_DBW}/codec.py": (f"{_DBW}/test_codec.py", f"{_DBW}/test_profile_dbc.py", f"{_DBW}/test_adapter_vectors.py"),
    f"{_DBW}/crc8.py": (f"{_DBW}/test_crc8.py",),
    f"{_DBW}/profile.py": (f"{_DBW}/test_profile.py", f"{_DBW}/test_profile_dbc.py", *_ADAPTER),
    f"{_DBW}/proving.py": (f"{_DBW}/test_proving.py",),
    f"{_DBW}/reports.py": (f"{_DBW}/test_reports.py", *_ADAPTER),
    f"{_DBW}/sending.py": _ADAPTER,
    f"{_DBW}/states.py": (*_ADAPTER, f"{_DBW}/test_by_wire_page.py"),
    f"{_DBW}/traffic.py": (f"{_DBW}/test_traffic.py",),
    f"{_DBW}/vehicle.py": (f"{_DBW}/test_vehicle.py", *_ADAPTER, "test_build_by_wire.py"),
}  # fmt: skip
"""Path below `src/lavt` to paths below `tests`, the most special ones first."""

AREAS: Final[dict[str, tuple[str, ...]]] = {
    "control": ("control", "nodes", "test_life_of_a_frame.py"),
    "nodes": ("nodes", "control", "test_life_of_a_frame.py"),
    "transport": ("transport", "nodes", "test_life_of_a_frame.py"),
    "experiment": tuple(
        f"experiment/test_{name}.py"
        for name in (
            "metrics",
            "hops",
            "validity",
            "statistics",
            "survival",
            "summary",
            "swept_summary",
            "contrasts",
            "compared_error",
            "offset",
            "clock_check",
            "virtual_clocks",
            "report",
            "report_parts",
            "report_words",
            "figures",
            "tabular",
            "join",
            "steering",
            "plan",
        )
    ),  # those that make up records; the others drive
    _DBW: (_DBW, "test_build_by_wire.py"),
}
"""Folder of a module to the wider tests: they are run for what its own tests let pass."""


def own_tests(module: str) -> tuple[str, ...]:
    """Return the paths of the tests about a module, from the repository's top."""
    return tuple(f"tests/{path}" for path in MODULES[module])


def area_of(module: str) -> tuple[str, ...]:
    """Return the paths of the wider tests around a module, from the repository's top."""
    return tuple(f"tests/{path}" for path in AREAS[module.rpartition("/")[0]])


def rest_of_area(module: str) -> tuple[str, ...]:
    """Return pytest's arguments for the wider tests without those about the module itself."""
    own = own_tests(module)
    return *(path for path in area_of(module) if path not in own), *(f"--ignore={path}" for path in own)
