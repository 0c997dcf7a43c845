"""Tests of the shipped profiles, and of the errors in profiles that are found before anything is sent."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from lavt.assembly.dbw import load_profile, shipped_profiles
from lavt.config.dbw import DbwConfig
from lavt.config_file import parse_config
from lavt.errors import UserError
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.reports import NewestReports
from lavt.vehicle.dbw.sending import FrameSender

NAMES = ("dataspeed_gen1", "dataspeed_gen2", "dataspeed_gen2:user", "dataspeed_gen2:remote")


def write_changed_profile(folder: Path, name: str, **changes: Any) -> Path:
    """Write a profile with other values; a key is a path with `__` between its parts."""
    shipped = shipped_profiles()[name]
    data = yaml.safe_load(shipped.read_text())
    data["dbc"] = str(shipped.with_suffix(".dbc"))
    for key, value in changes.items():
        *parts, last = key.split("__")
        section = data
        for part in parts:
            section = section[part]
        section[last] = value
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def rejection_message(name_or_path: str | Path, **keys: Any) -> str:
    with pytest.raises(UserError) as error:
        load_profile(str(name_or_path), **keys)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_shipped() -> None:
    """The two shipped profiles agree with their DBC files."""
    assert list(shipped_profiles()) == ["dataspeed_gen1", "dataspeed_gen2"]
    profiles = {name: load_profile(name) for name in NAMES}
    assert {profile.kit for name, profile in profiles.items() if "gen2" in name} == {"dataspeed_2"}
    assert profiles["dataspeed_gen1"].kit == "dataspeed_1"
    assert [profiles[name].commands for name in NAMES] == [None, "remote", "user", "remote"]


def test_angles_in_radians(tmp_path: Path) -> None:
    """With the wheel's angle in radians in the DBC, 90 degrees are 1.571 rad in commands and in reports."""
    text = shipped_profiles()["dataspeed_gen1"].with_suffix(".dbc").read_text()
    for before in ('(0.1,0) [-550|550] "deg"', '(0.1,0) [-3276.8|3276.7] "deg"'):
        assert text.count(before) == 1
        text = text.replace(before, '(0.001,0) [-10|10] "rad"')
    (tmp_path / "radians.dbc").write_text(text)
    profile = load_profile(str(write_changed_profile(tmp_path, "dataspeed_gen1", dbc=str(tmp_path / "radians.dbc"))))
    command = FrameSender(profile, 0).axis_frame("steering", 90.0, is_enabled=True)
    assert int.from_bytes(command.data[:2], "little", signed=True) == 1571
    reports = NewestReports(profile, 0)
    reports.receive(CanFrame(0x065, command.data[:2] + bytes(6)), 0)
    assert reports.wheel_deg == pytest.approx(90.0, abs=0.06)


def test_unverified() -> None:
    """Generation 1 uses no unverified signal; generation 2 uses many, and equally many in both command sets."""
    assert load_profile("dataspeed_gen1").unverified == ()
    remote, user = (load_profile(f"dataspeed_gen2:{name}").unverified for name in ("remote", "user"))
    assert len(remote) == len(user)
    assert {"RemoteSteerCmd.CMD_ANGLE", "RemoteSteerCmd.TYPE", "SteerReport1.ANGLE", "RemoteReport.STATE"} <= set(
        remote
    )
    assert "RemoteSteerCmd.CRC" not in remote
    assert {name.replace("User", "Remote") for name in user} == set(remote)


def test_steering_sign() -> None:
    """The config's steering sign is used if the profile has none, and must not contradict the profile's sign."""
    assert load_profile("dataspeed_gen1").car.steering_sign is None
    assert load_profile("dataspeed_gen1", steering_sign=-1).car.steering_sign == -1
    assert load_profile("dataspeed_gen2").car.steering_sign == 1
    assert load_profile("dataspeed_gen2", steering_sign=1).car.steering_sign == 1
    assert "steering_sign 1, not -1" in rejection_message("dataspeed_gen2", steering_sign=-1)


def test_units() -> None:
    """The steering wheel's angle is the road wheels' angle times the ratio and the sign, in degrees."""
    loaded_profile = load_profile("dataspeed_gen1", steering_sign=-1)
    assert loaded_profile.wheel_deg(0.1) == pytest.approx(-math.degrees(0.1) * 14.8)
    assert loaded_profile.road_rad(loaded_profile.wheel_deg(0.123)) == pytest.approx(0.123)


@pytest.mark.parametrize("name", ["dataspeed_gen3", "dataspeed_gen2:usr", ":user"])
def test_no_such_profile(name: str) -> None:
    """A profile that does not exist is rejected with the known names."""
    assert repr(name) in rejection_message(name)
    assert "dataspeed_gen1, dataspeed_gen2" in rejection_message(name)


def test_a_single_set_of_commands() -> None:
    """A command set cannot be chosen if the profile has only one."""
    assert ":user" in rejection_message("dataspeed_gen1:user")


def test_own_file(tmp_path: Path) -> None:
    """A profile can be named by the path of its file, with or without a command set."""
    path = write_changed_profile(tmp_path, "dataspeed_gen2", limits__steering_wheel_deg=100.0)
    assert load_profile(str(path)).limits.steering_wheel_deg == 100.0
    assert load_profile(f"{path}:user").commands == "user"


def test_other_dbc(tmp_path: Path) -> None:
    """The vendor's DBC replaces the profile's, and must contain all messages and signals that the profile names."""
    vendors = tmp_path / "vendor.dbc"
    vendors.write_text(shipped_profiles()["dataspeed_gen2"].with_suffix(".dbc").read_text().replace('" 1;', '" 0;'))
    text = vendors.read_text()
    vendors.write_text("\n".join(line for line in text.splitlines() if not line.startswith('BA_ "Unverified"')))
    assert load_profile("dataspeed_gen2", str(vendors)).unverified == ()
    vendors.write_text(text.replace("RemoteSteerCmd", "SteerCmdRemote"))
    assert "has no message 'RemoteSteerCmd': change the profile" in rejection_message(
        "dataspeed_gen2", dbc=str(vendors)
    )


def test_a_pedal_without_its_scale(tmp_path: Path) -> None:
    """A DBC without a pedal's scale is rejected, because a full brake would be the raw number 1: hardly any brake."""
    text = shipped_profiles()["dataspeed_gen1"].with_suffix(".dbc").read_text()
    bare = tmp_path / "bare.dbc"
    bare.write_text(text.replace("m2 : 0|16@1+ (0.000015259021896696421,0) [0|1]", "m2 : 0|16@1+ (1,0) [0|65535]"))
    error = rejection_message("dataspeed_gen1", dbc=str(bare))
    assert "PCMD_PERCENT of BrakeCmd is 100% of a pedal" in error


SPEED_SIGNALS = {
    "speed": ("dataspeed_gen1", "SG_ VEH_VEL : 32|16@1- (0.01,0)", "VEH_VEL"),
    "a second speed": ("dataspeed_gen2", "SG_ BY_PROPULSION : 16|16@1- (0.01,0)", "BY_PROPULSION"),
    "a wheel": ("dataspeed_gen1", "SG_ WHEEL_3 : 32|16@1- (0.01,0)", "WHEEL_3"),
}


@pytest.mark.parametrize(
    ("speed", "step", "is_fine_enough"),
    [
        ("speed", 0.018, True),
        ("speed", 0.0181, False),
        ("speed", 0.1, False),
        ("speed", -0.1, False),
        ("speed", 1.0, False),
        ("a second speed", 0.36, True),
        ("a second speed", 0.37, False),
        ("a wheel", 0.3, True),
        ("a wheel", 0.31, False),
    ],
)
def test_the_step_of_a_speed(tmp_path: Path, speed: str, step: float, is_fine_enough: bool) -> None:
    """A speed with steps over 0.005 m/s is rejected, because it would seem frozen in normal driving. A second speed,
    which is only compared with the first, can have steps of 0.1 m/s.
    """
    name, signal, signal_name = SPEED_SIGNALS[speed]
    text = shipped_profiles()[name].with_suffix(".dbc").read_text()
    assert text.count(signal) == 1
    dbc = tmp_path / "coarse.dbc"
    dbc.write_text(text.replace(signal, signal.replace("0.01", str(step))))
    if is_fine_enough:
        load_profile(name, str(dbc))
    else:
        assert signal_name in rejection_message(name, dbc=str(dbc))


REJECTED: list[tuple[str, dict[str, Any], str]] = [
    ("dataspeed_gen1", {"sent__brake__value": "PCMD_PRECENT"}, "BrakeCmd of its DBC has no signal 'PCMD_PRECENT'"),
    ("dataspeed_gen1", {"sent__brake__message": "BreakCmd"}, "its DBC has no message 'BreakCmd'"),
    ("dataspeed_gen1", {"sent__brake__value": "PCMD_TORQUE"}, "PCMD_TORQUE of BrakeCmd is in 'Nm': name a signal in"),
    ("dataspeed_gen1", {"sent__steering__value": "SCMD_TORQUE"}, "is in 'Nm': name a signal in 'deg' or 'rad'"),
    ("dataspeed_gen1", {"limits__steering_wheel_deg": 600.0}, "600 is out of the range of SCMD_ANGLE of SteeringCmd"),
    (
        "dataspeed_gen1",
        {"limits__steering_wheel_rate_degps": 3.0},
        "limits.steering_wheel_rate_degps is less than one step of SVEL",
    ),
    ("dataspeed_gen1", {"sent__gears": {"park": 1}}, "sent.gears has no drive"),
    ("dataspeed_gen1", {"sent__gears": {"park": 1, "drive": 9}}, "9 is out of the range of GCMD of GearCmd"),
    ("dataspeed_gen1", {"sent__brake__checksum": "CLEAR"}, "CLEAR of BrakeCmd is not its last byte"),
    ("dataspeed_gen1", {"reports__brake__values": {}}, "reports.brake.values has no enabled: name its signal"),
    ("dataspeed_gen1", {"reports__gear__values": {}}, "reports.gear.values has no gear: name its signal"),
    ("dataspeed_gen2", {"reports__speed__values": {}}, "no report has a speed: name its signal"),
    ("dataspeed_gen2", {"reports__system__trip": {"STATE=x": "no"}}, "'STATE=x' of SystemReport"),
    ("dataspeed_gen2", {"commands": None}, "is for remote or user"),
    ("dataspeed_gen2", {"sent__system__value": ""}, "SystemCmd of its DBC has no signal ''"),
    ("dataspeed_gen2", {"sent__stearing": {}}, "unknown key 'sent.stearing': did you mean 'steering'?"),
    ("dataspeed_gen2", {"limits__brake": 2.0}, "'limits.brake': Input should be less than or equal to 1"),
    ("dataspeed_gen2", {"vehicle__steering_sign": 0}, "'vehicle.steering_sign': Input should be 1 or -1"),
    ("dataspeed_gen2", {"kit": "dataspeed_3"}, "'kit': Input should be 'dataspeed_1' or 'dataspeed_2'"),
    ("dataspeed_gen2", {"dbc": "nowhere.dbc"}, "nowhere.dbc cannot be read"),
]


@pytest.mark.parametrize(("name", "changes", "message"), REJECTED, ids=[message for _, _, message in REJECTED])
def test_rejected(tmp_path: Path, name: str, changes: dict[str, Any], message: str) -> None:
    """The error for a wrong profile has one line and names the key or the signal."""
    assert message in rejection_message(write_changed_profile(tmp_path, name, **changes))


def test_section() -> None:
    """The section of a server's config has defaults, and unknown keys are rejected with the nearest known key."""
    section = parse_config(DbwConfig, {}, "server.yaml")
    assert (section.profile, section.interface, section.channel) == ("dataspeed_gen2", "socketcan", "can0")
    assert (section.dbc, section.options, section.truth, section.watchdog_proof) == ("", {}, "", "")
    assert section.steering_sign is None
    with pytest.raises(UserError, match="unknown key 'chanel': did you mean 'channel'"):
        parse_config(DbwConfig, {"chanel": "can1"}, "server.yaml")
