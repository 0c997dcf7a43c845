"""Test that `lavt can check` reports mismatches between a profile and its DBC, and unverified signals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.support.command_line import Run

from lavt.assembly.dbw import shipped_profiles

Edit = Callable[[dict[str, Any]], Any]
PROFILES = sorted(shipped_profiles())


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt can check`."""
    return lambda *arguments: run("can", "check", *arguments)


def write_profile(folder: Path, name: str, edit: Edit = lambda _: None, dbc_change: tuple[str, str] = ("", "")) -> str:
    """Write a copy of a shipped profile, changed by `edit` and with a text of its DBC replaced; return its path."""
    source = shipped_profiles()[name]
    profile = yaml.safe_load(source.read_text())
    edit(profile)
    dbc = source.with_suffix(".dbc").read_text()
    assert dbc_change[0] in dbc
    (folder / profile["dbc"]).write_text(dbc.replace(*dbc_change, 1))
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(profile))
    return str(path)


@pytest.mark.parametrize("name", [*PROFILES, "dataspeed_gen2:user"])
def test_shipped_profiles_match(run: Run, name: str) -> None:
    """Each shipped profile matches its DBC."""
    code, out, err = run(name)
    assert (code, err) == (0, "")
    assert out.splitlines()[0].startswith(f"{name} and {name.partition(':')[0]}.dbc ")


def test_unverified_signals(run: Run) -> None:
    """Unverified signals are listed, are not mismatches, and inhibit arming on a real bus."""
    code, out, _ = run("dataspeed_gen2", "--json")
    printed = json.loads(out)
    assert code == 0
    assert printed["agree"]
    assert "RemoteSteerCmd.CMD_ANGLE" in printed["unverified"]
    assert "RemoteSteerCmd.CRC" not in printed["unverified"]
    assert printed["may_arm_on_a_real_bus"] is False
    assert "DBC" in printed["real_bus_inhibit_reasons"][0]
    _, out, _ = run("dataspeed_gen2")
    assert "  RemoteSteerCmd.CMD_ANGLE\n" in out
    assert "may not arm" in out.splitlines()[-1]


def test_unknown_steering_sign(run: Run, tmp_path: Path) -> None:
    """A verified profile may arm on a real bus only if the sign of its steering is known."""
    _, out, _ = run("dataspeed_gen1")
    assert "may not arm" in out.splitlines()[-1]
    assert "steering_sign" in out.splitlines()[-1]
    code, out, _ = run(
        write_profile(tmp_path, "dataspeed_gen1", lambda profile: profile["vehicle"].update(steering_sign=1))
    )
    assert code == 0
    assert "may arm" in out.splitlines()[-1]
    assert "`lavt can test-watchdog`" in out.splitlines()[-1]


def test_vendors_dbc(run: Run, tmp_path: Path) -> None:
    """With the vendor's DBC, which marks no signal as unverified, all signals are verified."""
    vendor_dbc = tmp_path / "vendor.dbc"
    vendor_dbc.write_text(
        "\n".join(
            line
            for line in shipped_profiles()["dataspeed_gen2"].with_suffix(".dbc").read_text().splitlines()
            if not line.startswith('BA_ "Unverified"')
        )
    )
    code, out, _ = run("dataspeed_gen2", "--dbc", str(vendor_dbc), "--json")
    assert code == 0
    assert json.loads(out) == {
        "profile": "dataspeed_gen2",
        "dbc": str(vendor_dbc),
        "agree": True,
        "disagreements": [],
        "unverified": [],
        "may_arm_on_a_real_bus": True,
        "real_bus_inhibit_reasons": [],
    }


def edit_steering(**changes: Any) -> Edit:
    """Return an edit of the steering command."""
    return lambda profile: profile["sent"]["steering"].update(changes)


def edit_report(part: str, **changes: Any) -> Edit:
    """Return an edit of one report."""
    return lambda profile: profile["reports"][part].update(changes)


def edit_nothing(_: dict[str, Any]) -> None:
    """Change nothing in the profile."""


UNCHANGED = ("", "")
MISMATCHES: list[tuple[str, Edit, tuple[str, str], str, tuple[str, ...]]] = [
    (
        "dataspeed_gen1",
        edit_steering(message="SteerCmd"),
        UNCHANGED,
        "sent.steering",
        ("SteerCmd", "SteeringCmd"),
    ),
    (
        "dataspeed_gen1",
        edit_steering(value="SCMD_ANGEL"),
        UNCHANGED,
        "sent.steering.value",
        ("SCMD_ANGEL", "SCMD_ANGLE"),
    ),
    (
        "dataspeed_gen1",
        edit_steering(enable="SVEL", rate=""),
        UNCHANGED,
        "sent.steering.enable",
        ("SVEL", "SteeringCmd"),
    ),
    (
        "dataspeed_gen1",
        edit_steering(count="RES2"),
        UNCHANGED,
        "sent.steering.count",
        ("RES2", "SteeringCmd"),
    ),
    (
        "dataspeed_gen2",
        edit_steering(checksum="RC", count=""),
        UNCHANGED,
        "sent.steering.checksum",
        ("RC", "RemoteSteerCmd"),
    ),
    (
        "dataspeed_gen1",
        edit_steering(clear="EN"),
        UNCHANGED,
        "sent.steering",
        ("EN", "enable", "clear"),
    ),
    (
        "dataspeed_gen1",
        lambda profile: profile["limits"].update(steering_wheel_deg=551.0),
        UNCHANGED,
        "sent.steering.value",
        ("551", "SCMD_ANGLE", "-550", "550"),
    ),
    (
        "dataspeed_gen1",
        lambda profile: profile["sent"]["gears"].update(drive=3),
        UNCHANGED,
        "sent.gear.value",
        ("drive is 3", "GCMD", "NEUTRAL"),
    ),
    (
        "dataspeed_gen1",
        lambda profile: profile["sent"]["gears"].update(drive=8),
        UNCHANGED,
        "sent.gear.value",
        ("drive is 8", "GCMD", "7"),
    ),
    (
        "dataspeed_gen2",
        lambda profile: profile["sent"]["system"].update(enable=2),
        UNCHANGED,
        "sent.system.value",
        ("enable is 2", "CMD", "DISABLE"),
    ),
    (
        "dataspeed_gen2",
        edit_report("remote", needs={"STATE": [9]}),
        UNCHANGED,
        "reports.remote.needs.STATE",
        ("9", "STATE"),
    ),
    (
        "dataspeed_gen2",
        edit_report("system", trip={"STATE=6": "tripped"}),
        UNCHANGED,
        "reports.system.trip.STATE=6",
        ("6", "STATE"),
    ),
    (
        "dataspeed_gen2",
        edit_report("steering", timeout_ms=101),
        UNCHANGED,
        "reports.steering.timeout_ms",
        ("101 ms", "100 ms"),
    ),
    (
        "dataspeed_gen2",
        edit_report("gear", timeout_ms=199),
        UNCHANGED,
        "reports.gear.timeout_ms",
        ("199 ms", "GearReport1", "100 ms"),
    ),
    (
        "dataspeed_gen1",
        edit_nothing,
        ('BA_ "TimeoutMs" BO_ 96 100;', 'BA_ "TimeoutMs" BO_ 96 39;'),
        "sent.brake",
        ("BrakeCmd", "39 ms", "20 ms"),
    ),
    (
        "dataspeed_gen1",
        lambda profile: profile["sent"].update(clearing_bytes=2),
        UNCHANGED,
        "sent.steering.clear",
        ("CLEAR", "2 bytes", "sent.clearing_bytes"),
    ),
    (
        "dataspeed_gen1",
        edit_nothing,
        ("BO_ 121 DriverAssist: 3 KIT", "BO_ 96 DriverAssist: 3 KIT"),
        "the DBC has two messages of identifier 0x060",
        ("BrakeCmd", "DriverAssist"),
    ),
    (
        "dataspeed_gen1",
        edit_steering(rate="SCMD_TORQUE"),
        UNCHANGED,
        "sent.steering.rate",
        ("SCMD_TORQUE", "SCMD_ANGLE"),
    ),
    (
        "dataspeed_gen2",
        lambda profile: profile.update(commands=None),
        UNCHANGED,
        "sent.steering",
        ("no message",),
    ),
]
"""A shipped profile, an edit of it, a replacement in its DBC, and the key and names in the sentence on the mismatch."""


@pytest.mark.parametrize("mismatch", MISMATCHES, ids=[key for _, _, _, key, _ in MISMATCHES])
def test_mismatch(run: Run, tmp_path: Path, mismatch: tuple[str, Edit, tuple[str, str], str, tuple[str, ...]]) -> None:
    """Each mismatch has a sentence that begins with the profile's key and names the signals; the exit code is 2."""
    profile, edit, dbc_change, key, names = mismatch
    code, out, err = run(write_profile(tmp_path, profile, edit, dbc_change))
    assert (code, out) == (2, "")
    sentences = [line for line in err.splitlines() if line.startswith(f"{key}: ")]
    assert any(all(name in sentence for name in names) for sentence in sentences), err


def test_all_mismatches(run: Run, tmp_path: Path) -> None:
    """All mismatches are listed and counted."""
    path = write_profile(
        tmp_path,
        "dataspeed_gen1",
        lambda profile: (edit_steering(count="A")(profile), edit_report("gear", message="B")(profile)),
    )
    code, out, err = run(path, "--json")
    assert code == 2
    assert [line.partition(": ")[0] for line in err.splitlines()[:2]] == ["sent.steering.count", "reports.gear"]
    assert " 2 " in err.splitlines()[2]
    assert json.loads(out)["disagreements"] == err.splitlines()[:2]


def test_mismatch_found_by_loading(run: Run, tmp_path: Path) -> None:
    """An error that is found only when the profile is loaded for driving is reported as a mismatch, too."""
    code, _, err = run(
        write_profile(tmp_path, "dataspeed_gen1", lambda profile: profile["sent"]["brake"].update(value="PCMD_TORQUE"))
    )
    assert code == 2
    assert "PCMD_TORQUE of BrakeCmd" in err


def test_bad_input(run: Run, tmp_path: Path) -> None:
    """An unknown profile, a missing DBC or an unknown set of commands is rejected in one sentence."""
    shutil.copy(shipped_profiles()["dataspeed_gen1"], tmp_path / "alone.yaml")
    for arguments, reason in (
        (["nosuch"], "'nosuch'"),
        ([str(tmp_path / "alone.yaml")], "dataspeed_gen1.dbc"),
        (["dataspeed_gen1", "--dbc", "nosuch.dbc"], "nosuch.dbc"),
        (["dataspeed_gen1:user"], ":user"),
    ):
        assert reason in run(*arguments).rejection()
