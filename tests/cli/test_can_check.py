"""`lavt can check`: whether a profile and its DBC agree, and what is unverified."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from lavt.build.dbw import shipped_profiles
from lavt.cli import console
from lavt.cli.main import app

Run = Callable[..., tuple[int, str, str]]
Edit = Callable[[dict[str, Any]], Any]
PROFILES = sorted(shipped_profiles())


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Give a function that runs `lavt can check` in this process: exit code, standard output, standard error."""

    def run_here(*arguments: str) -> tuple[int, str, str]:
        code = 0
        try:
            console.run_command(lambda: app(["can", "check", *arguments], standalone_mode=False))
        except SystemExit as ended:
            code = int(ended.code or 0)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run_here


def edited(folder: Path, name: str, edit: Edit = lambda _: None, bits: tuple[str, str] = ("", "")) -> str:
    """A copy of a shipped profile with something changed in it, or in its DBC; returns its path."""
    source = shipped_profiles()[name]
    profile = yaml.safe_load(source.read_text())
    edit(profile)
    dbc = source.with_suffix(".dbc").read_text()
    assert bits[0] in dbc
    (folder / profile["dbc"]).write_text(dbc.replace(*bits, 1))
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(profile))
    return str(path)


@pytest.mark.parametrize("name", [*PROFILES, "dataspeed_gen2:user"])
def test_shipped(run: Run, name: str) -> None:
    """Each profile that comes with LAVT agrees with its DBC."""
    code, out, err = run(name)
    assert (code, err) == (0, "")
    assert out.startswith(f"{name} and {name.partition(':')[0]}.dbc agree\n")


def test_unverified(run: Run) -> None:
    """Unverified signals are listed, are no disagreement, and keep a profile from arming on a real bus."""
    code, out, _ = run("dataspeed_gen2", "--json")
    told = json.loads(out)
    assert code == 0
    assert told["agree"]
    assert "RemoteSteerCmd.CMD_ANGLE" in told["unverified"]
    assert "RemoteSteerCmd.CRC" not in told["unverified"]
    assert told["may_arm_on_a_real_bus"] is False
    assert "name the vendor's DBC" in told["hindrances_on_a_real_bus"][0]
    _, out, _ = run("dataspeed_gen2")
    assert "  RemoteSteerCmd.CMD_ANGLE\n" in out
    assert "on a real bus: may not arm: " in out


def test_sign_unknown(run: Run, tmp_path: Path) -> None:
    """A verified profile may arm on a real bus once the sign of its steering is known."""
    _, out, _ = run("dataspeed_gen1")
    assert "unverified: nothing\non a real bus: may not arm: which sign of the steering is left is not known" in out
    code, out, _ = run(edited(tmp_path, "dataspeed_gen1", lambda it: it["vehicle"].update(steering_sign=1)))
    assert code == 0
    assert out.endswith("on a real bus: may arm, once `lavt can prove` has seen its watchdog brake\n")


def test_vendors_dbc(run: Run, tmp_path: Path) -> None:
    """With the vendor's DBC, which has no marks, nothing is unverified."""
    vendors = tmp_path / "vendor.dbc"
    vendors.write_text(
        "\n".join(
            line
            for line in shipped_profiles()["dataspeed_gen2"].with_suffix(".dbc").read_text().splitlines()
            if not line.startswith('BA_ "Unverified"')
        )
    )
    code, out, _ = run("dataspeed_gen2", "--dbc", str(vendors), "--json")
    assert code == 0
    assert json.loads(out) == {
        "profile": "dataspeed_gen2",
        "dbc": str(vendors),
        "agree": True,
        "disagreements": [],
        "unverified": [],
        "may_arm_on_a_real_bus": True,
        "hindrances_on_a_real_bus": [],
    }


def steering(**changes: Any) -> Edit:
    return lambda profile: profile["sent"]["steering"].update(changes)


def reported(part: str, **changes: Any) -> Edit:
    return lambda profile: profile["reports"][part].update(changes)


def same(_: dict[str, Any]) -> None:
    """Nothing is changed in the profile."""


AS_IT_IS = ("", "")
DISAGREEMENTS: list[tuple[str, Edit, tuple[str, str], str]] = [
    (
        "dataspeed_gen1",
        steering(message="SteerCmd"),
        AS_IT_IS,
        "sent.steering: the DBC has no message SteerCmd; the nearest is SteeringCmd",
    ),
    (
        "dataspeed_gen1",
        steering(value="SCMD_ANGEL"),
        AS_IT_IS,
        "sent.steering.value: SteeringCmd has no signal SCMD_ANGEL; the nearest is SCMD_ANGLE",
    ),
    (
        "dataspeed_gen1",
        steering(enable="SVEL", rate=""),
        AS_IT_IS,
        "sent.steering.enable: SVEL of SteeringCmd is no single bit, as a switch has to be",
    ),
    (
        "dataspeed_gen1",
        steering(count="RES2"),
        AS_IT_IS,
        "sent.steering.count: RES2 of SteeringCmd is no unsigned number of several bits, as a counter has to be",
    ),
    (
        "dataspeed_gen2",
        steering(checksum="RC", count=""),
        AS_IT_IS,
        "sent.steering.checksum: RC of RemoteSteerCmd is not the last byte, as a checksum here must be",
    ),
    (
        "dataspeed_gen1",
        steering(clear="EN"),
        AS_IT_IS,
        "sent.steering: EN is both enable and clear",
    ),
    (
        "dataspeed_gen1",
        lambda it: it["limits"].update(steering_wheel_deg=551.0),
        AS_IT_IS,
        "sent.steering.value: the limit 551 is not in the range of SCMD_ANGLE, -550 to 550",
    ),
    (
        "dataspeed_gen1",
        lambda it: it["sent"]["gears"].update(drive=3),
        AS_IT_IS,
        "sent.gear.value: drive is 3, but the DBC calls 3 of GCMD NEUTRAL",
    ),
    (
        "dataspeed_gen1",
        lambda it: it["sent"]["gears"].update(drive=8),
        AS_IT_IS,
        "sent.gear.value: drive is 8 does not fit GCMD, which ends at 7",
    ),
    (
        "dataspeed_gen2",
        lambda it: it["sent"]["system"].update(enable=2),
        AS_IT_IS,
        "sent.system.value: enable is 2, but the DBC calls 2 of CMD DISABLE",
    ),
    (
        "dataspeed_gen2",
        reported("remote", needs={"STATE": [9]}),
        AS_IT_IS,
        "reports.remote.needs.STATE: 9 is needed, for which STATE has no name in the DBC",
    ),
    (
        "dataspeed_gen2",
        reported("system", trip={"STATE=6": "tripped"}),
        AS_IT_IS,
        "reports.system.trip.STATE=6: 6 is looked for, for which STATE has no name in the DBC",
    ),
    (
        "dataspeed_gen2",
        reported("steering", timeout_ms=101),
        AS_IT_IS,
        "reports.steering.timeout_ms: 101 ms is longer than the DBC's 100 ms",
    ),
    (
        "dataspeed_gen2",
        reported("gear", timeout_ms=199),
        AS_IT_IS,
        "reports.gear.timeout_ms: 199 ms is too short for GearReport1, which comes each 100 ms",
    ),
    (
        "dataspeed_gen1",
        same,
        ('BA_ "TimeoutMs" BO_ 96 100;', 'BA_ "TimeoutMs" BO_ 96 39;'),
        "sent.brake: BrakeCmd has to come each 39 ms, and comes each 20 ms",
    ),
    (
        "dataspeed_gen1",
        lambda it: it["sent"].update(clearing_bytes=2),
        AS_IT_IS,
        "sent.steering.clear: CLEAR is not in the first 2 bytes (sent.clearing_bytes)",
    ),
    (
        "dataspeed_gen1",
        same,
        ("BO_ 121 DriverAssist: 3 KIT", "BO_ 96 DriverAssist: 3 KIT"),
        "the DBC has two messages of identifier 0x060: BrakeCmd and DriverAssist",
    ),
    (
        "dataspeed_gen1",
        steering(rate="SCMD_TORQUE"),
        AS_IT_IS,
        "sent.steering.rate: SCMD_TORQUE is in no frame with SCMD_ANGLE",
    ),
    (
        "dataspeed_gen2",
        lambda it: it.update(commands=None),
        AS_IT_IS,
        "sent.steering: the DBC has no message of this set of commands",
    ),
]


@pytest.mark.parametrize(
    ("planted", "sentence"),
    [pytest.param(each[:3], each[3], id=each[3].partition(":")[0]) for each in DISAGREEMENTS],
)
def test_disagreement(run: Run, tmp_path: Path, planted: tuple[str, Edit, tuple[str, str]], sentence: str) -> None:
    """Each disagreement is said in one sentence that names the profile's key, and ends the check with 2."""
    code, out, err = run(edited(tmp_path, *planted))
    assert (code, out) == (2, "")
    assert sentence in err.splitlines()


def test_all_of_them(run: Run, tmp_path: Path) -> None:
    """All disagreements are said, and how many they are."""
    path = edited(tmp_path, "dataspeed_gen1", lambda it: (steering(count="A")(it), reported("gear", message="B")(it)))
    code, out, err = run(path, "--json")
    assert code == 2
    assert err.splitlines()[:2] == [
        "sent.steering.count: SteeringCmd has no signal A",
        "reports.gear: the DBC has no message B",
    ]
    assert err.splitlines()[2].endswith("disagree 2 times: change the profile, or name another DBC")
    assert json.loads(out)["disagreements"] == err.splitlines()[:2]


def test_of_the_reader(run: Run, tmp_path: Path) -> None:
    """What is found only when the profile is read for driving is a disagreement as well."""
    code, _, err = run(edited(tmp_path, "dataspeed_gen1", lambda it: it["sent"]["brake"].update(value="PCMD_TORQUE")))
    assert code == 2
    assert "PCMD_TORQUE of BrakeCmd is in 'Nm'" in err


def test_bad_input(run: Run, tmp_path: Path) -> None:
    """A profile that is none, and a DBC that is missing, are said in one sentence."""
    shutil.copy(shipped_profiles()["dataspeed_gen1"], tmp_path / "alone.yaml")
    for arguments, because in (
        (["nosuch"], "there is no profile 'nosuch'"),
        ([str(tmp_path / "alone.yaml")], "dataspeed_gen1.dbc cannot be read"),
        (["dataspeed_gen1", "--dbc", "nosuch.dbc"], "nosuch.dbc cannot be read"),
        (["dataspeed_gen1:user"], "has one set of commands only"),
    ):
        code, out, err = run(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert because in err
