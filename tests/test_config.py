from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.assembly.nodes import limits_of
from lavt.config import (
    BoundaryConfig,
    ClientConfig,
    ClockConfig,
    ClocksConfig,
    Costs,
    DelayConfig,
    FlowChanges,
    ImpairmentConfig,
    NetworkConfig,
    RelayConfig,
    RendezvousConfig,
    RunConfig,
    SafetyConfig,
    Section,
    ServerConfig,
    StudyConfig,
    SweepConfig,
)
from lavt.config_file import condition, conditions, load_config, parse_config, parse_yaml, shipped
from lavt.errors import UserError
from lavt.experiment.runs.plan import plan_run, plan_sweep
from lavt.safety.limits import LIMITS

SCHEMAS: dict[str, type[Section]] = {
    "boundary.yaml": BoundaryConfig,
    "study.yaml": StudyConfig,
    "client.yaml": ClientConfig,
    "client-secure.yaml": ClientConfig,
    "compensation.yaml": SweepConfig,
    "compensation_mismatch.yaml": SweepConfig,
    "costs.yaml": Costs,
    "demo.yaml": RunConfig,
    "governor.yaml": SweepConfig,
    "loss_and_jitter.yaml": SweepConfig,
    "roads.yaml": SweepConfig,
    "paper.yaml": SweepConfig,
    "paper_carla.yaml": SweepConfig,
    "paper_designed.yaml": SweepConfig,
    "relay.yaml": RelayConfig,
    "rendezvous.yaml": RendezvousConfig,
    "server.yaml": ServerConfig,
    "server-by-wire.yaml": ServerConfig,
    "server-secure.yaml": ServerConfig,
    "speed.yaml": SweepConfig,
    "weather.yaml": SweepConfig,
    "sweep.yaml": SweepConfig,
}
"""The schema of each file in configs/."""


@pytest.mark.parametrize("name", sorted(path.name for path in shipped("configs").iterdir()))
def test_shipped_configs(name: str) -> None:
    """Every file of configs/ is valid for its schema."""
    assert name in SCHEMAS, f"add {name} to SCHEMAS"
    load_config(SCHEMAS[name], shipped("configs") / name)


@pytest.mark.parametrize("name", sorted(set(SCHEMAS) - {"costs.yaml"}))
def test_a_written_config_is_read_back_unchanged(name: str) -> None:
    """A complete config that is written, as into a run directory, is read back unchanged."""
    config = load_config(SCHEMAS[name], shipped("configs") / name)
    assert parse_config(SCHEMAS[name], config.model_dump(mode="json"), name) == config


@pytest.mark.parametrize("name", ["configs/demo.yaml", "netem/conditions.yaml", "zenoh-configs/session.json5"])
def test_shipped_files_have_absolute_paths(name: str) -> None:
    """The path of a shipped file is absolute, so it does not depend on the working directory."""
    assert shipped(name).is_file()
    assert shipped(name).is_absolute()


def test_the_demo_config() -> None:
    """The demo drives route A key with the gains fitted to the paper and the safety limits that these gains need."""
    demo = load_config(RunConfig, shipped("configs/demo.yaml"))
    assert (demo.vehicle.route, demo.controller.preset, demo.network.condition) == ("a_key", "paper_calibrated", "L0")
    assert (demo.safety.lateral_acceleration_mps2, demo.safety.picture_age_limit_ms) == (6.0, 2000.0)


def test_the_paper_config() -> None:
    """The paper's campaign has 180 runs with the fitted gains: six routes under six conditions, five times each."""
    paper = load_config(SweepConfig, shipped("configs/paper.yaml"))
    assert (paper.controller.preset, paper.network.inherent, paper.axes) == ("paper_calibrated", "paper_wifi5", {})
    assert (paper.safety.lateral_acceleration_mps2, paper.safety.picture_age_limit_ms) == (6.0, 2000.0)
    assert (paper.routes, paper.conditions) == (("a", "a_key", "b", "b_key", "c", "c_key"), tuple(PAPER_DELAYS_MS))
    assert len(plan_sweep(paper)) == 180


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("compensation.yaml", 1080),
        ("compensation_mismatch.yaml", 168),
        ("loss_and_jitter.yaml", 36),
        ("roads.yaml", 180),
        ("speed.yaml", 72),
        ("weather.yaml", 18),
    ],
)
def test_sweeps_over_further_axes(name: str, count: int) -> None:
    """The sweeps over further axes can be planned; each axis contains the base config's value."""
    sweep = load_config(SweepConfig, shipped("configs") / name)
    runs = plan_sweep(sweep.model_copy(update={"repetitions": 1}))
    assert len(runs) * sweep.repetitions == count
    base = sweep.model_dump()
    for key, values in sweep.axes.items():
        value = base
        for part in key.split("."):
            value = value[part]
        assert value in values


@pytest.mark.parametrize("name", sorted(conditions()))
def test_every_condition_is_supported(name: str) -> None:
    """Virtual time and the relay accept every shipped condition."""
    for time in ("virtual", "real"):
        assert plan_run(RunConfig(time=time, network=NetworkConfig(condition=name))).requested == condition(name)


PAPER_DELAYS_MS = {"L0": (0, 0), "L1": (75, 0), "L2": (150, 0), "L3": (225, 0), "L4": (150, 75), "L5": (225, 100)}


def test_conditions_have_the_papers_delays() -> None:
    """The conditions L0 to L5 have the paper's delays, in milliseconds of video and control."""
    shipped_conditions = conditions()
    delays_ms = {
        name: (shipped_conditions[name].video_ms, shipped_conditions[name].control_ms) for name in PAPER_DELAYS_MS
    }
    assert delays_ms == PAPER_DELAYS_MS
    assert condition("L5") == shipped_conditions["L5"]


def test_unknown_condition() -> None:
    """An unknown condition is rejected, and the error lists the known conditions."""
    with pytest.raises(UserError, match=r"'L6'.*L0, L1, L2, L3, L4, L5"):
        condition("L6")


def rejection(text: str, tmp_path: Path, kind: type[Section] = RunConfig, changes: tuple[str, ...] = ()) -> str:
    """Check that a config with this text is rejected in one sentence; return this sentence."""
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_config(kind, path, changes)
    sentence = str(error.value)
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize(
    ("text", "key", "suggestion"),
    [
        ("sed: 3", "sed", "seed"),
        ("vehicle: {rute: a_key}", "vehicle.rute", "route"),
        ("camera: {width: 640}", "camera.width", "width_px"),
        ("video:\n  bitrate_bps: 1000000", "video.bitrate_bps", "bit_rate_bps"),
        ("safety: {lateral_acceleration: 3.0}", "safety.lateral_acceleration", "lateral_acceleration_mps2"),
    ],
)
def test_unknown_key(text: str, key: str, suggestion: str, tmp_path: Path) -> None:
    """An unknown key, at the top or in a section, is rejected with its path and the nearest known key."""
    sentence = rejection(text, tmp_path)
    assert repr(key) in sentence
    assert repr(suggestion) in sentence


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("clock: {source: sundial}", "clock.source"),
        ("clock: {source: external}", "correction_ms and bound_ms"),
        ("clock: {source: external, correction_ms: 1.0}", "correction_ms and bound_ms"),
        ("clock: {correction_ms: 1.0, bound_ms: 0.1}", "correction_ms and bound_ms"),
        ("clock: {source: external, correction_ms: 1.0, bound_ms: -0.1}", "clock.bound_ms"),
        ("clock: {probe_port: 70000}", "clock.probe_port"),
    ],
)
@pytest.mark.parametrize("kind", [ServerConfig, ClientConfig])
def test_invalid_time_sources_are_rejected(text: str, reason: str, kind: type[Section], tmp_path: Path) -> None:
    """An unknown time source, a missing value, and a value of another time source are rejected."""
    assert reason in rejection(text, tmp_path, kind)


def test_a_client_must_know_the_port_of_the_probe(tmp_path: Path) -> None:
    """Port 0 (any free port) is valid only for the server, because a client could not know the port."""
    assert "clock.probe_port" in rejection("clock: {probe_port: 0}", tmp_path, ClientConfig)
    assert ServerConfig(clock=ClockConfig(probe_port=0)).clock.probe_port == 0


def test_unknown_key_without_a_near_one(tmp_path: Path) -> None:
    """An unknown key that is similar to no known key is rejected with the list of known keys."""
    sentence = rejection("clocks: {xyzzy: 1}", tmp_path)
    assert "'clocks.xyzzy'" in sentence
    assert "bound_us, drift_ppm, error_us, offset_ms" in sentence


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("camera.width=640", "'width_px'"),
        ("vehicel.route=a_key", "'vehicle'"),
        ("seed=one", "'seed'"),
        ("seed=1.5", "'seed'"),
        ("camera.rate_hz=fast", "'camera.rate_hz'"),
        ("seed", "a.b=value"),
        ("=1", "a.b=value"),
        ("camera.=1", "a.b=value"),
        (".seed=1", "a.b=value"),
        ("seed=[", "not YAML"),
        ("seed=2026-13-45", "not YAML"),
        ("seed=!!int x", "not YAML"),
        ("seed.more=1", "seed is not a section"),
        ("camera=3", "'camera' is a section"),
    ],
)
def test_invalid_changes_are_rejected(change: str, reason: str, tmp_path: Path) -> None:
    """A change by --set is validated like the file; the error names the key or the right form of a change."""
    assert reason in rejection("seed: 1", tmp_path, changes=(change,))


def test_the_advice_for_a_change_below_a_value_has_the_whole_key(tmp_path: Path) -> None:
    """The message for a change below a key that has a value names the whole key, so that the advice can be used."""
    sentence = rejection("network: {condition: L0}", tmp_path, changes=("network.condition.L3=1",))
    assert "network.condition is not a section: write --set network.condition=value" in sentence


def test_changes_reach_nested_keys(tmp_path: Path) -> None:
    """Changes reach nested keys and create missing sections; of several changes of a key, the last one is used."""
    path = tmp_path / "my.yaml"
    path.write_text("camera: {width_px: 320}")
    changes = ["seed=7", "camera.rate_hz=20", "network.condition=L3", "seed=8", "time=real", "study.participant='07'"]
    config = load_config(RunConfig, path, changes)
    assert (config.seed, config.network.condition, config.time, config.study.participant) == (8, "L3", "real", "07")
    assert (config.camera.width_px, config.camera.rate_hz) == (320, 20.0)


def test_changes_can_be_lists_and_mappings(tmp_path: Path) -> None:
    """The value of a change can be a list or a mapping in YAML, and can contain an equals sign."""
    path = tmp_path / "my.yaml"
    path.write_text("{}")
    changes = ["conditions=[L0, L3]", "axes={video.bit_rate_bps: [1000000, 2000000]}", "study.participant=a=b"]
    config = load_config(SweepConfig, path, changes)
    assert config.conditions == ("L0", "L3")
    assert config.axes == {"video.bit_rate_bps": [1_000_000, 2_000_000]}
    assert config.study.participant == "a=b"


BAD_VALUES: list[tuple[type[Section], str, str]] = [
    (RunConfig, "seed: -1", "'seed'"),
    (RunConfig, "seed: true", "'seed'"),
    (RunConfig, "seed: '1'", "'seed'"),
    (RunConfig, "time: soon", "'time'"),
    (RunConfig, "camera: {width_px: 127}", "'camera.width_px'"),
    (RunConfig, "camera: {width_px: 641}", "'camera.width_px'"),
    (RunConfig, "camera: {rate_hz: 0}", "'camera.rate_hz'"),
    (RunConfig, "camera: {rate_hz: .nan}", "'camera.rate_hz'"),
    (RunConfig, "camera: {x_m: .nan}", "'camera.x_m'"),
    (RunConfig, "camera: {z_m: .inf}", "'camera.z_m'"),
    (RunConfig, "camera: {pitch_deg: 90}", "'camera.pitch_deg'"),
    (RunConfig, "camera: null", "'camera'"),
    (RunConfig, "camera: [640, 480]", "'camera' is a section"),
    (
        RunConfig,
        "network: L3",
        "'network' is a section, not a value such as 'L3': set its keys, such as network.condition",
    ),
    (RunConfig, "network: {injection: magic}", "'network.injection'"),
    (RunConfig, "network: {inherent: ether}", "'network.inherent'"),
    (RunConfig, "network: {video: {loss: 1.0}}", "'network.video.loss'"),
    (RunConfig, "network: {video: {queue_packets: 0}}", "'network.video.queue_packets'"),
    (RunConfig, "network: {control: {trace: 3}}", "'network.control.trace'"),
    (RunConfig, "safety: {lateral_acceleration_mps2: 6.1}", "'safety.lateral_acceleration_mps2'"),
    (RunConfig, "safety: {picture_age_limit_ms: 2001}", "'safety.picture_age_limit_ms'"),
    (RunConfig, "safety: {picture_age_limit_ms: -1}", "'safety.picture_age_limit_ms'"),
    (RunConfig, "clocks: {error_us: 200, bound_us: 100}", "'clocks.bound_us'"),
    (RunConfig, "1: 2", "'1'"),
    (SweepConfig, "conditions: L0", "'conditions': write a list, such as [a, b], not 'L0'"),
    (SweepConfig, "conditions: [L0, 3]", "'conditions.1'"),
    (SweepConfig, "repetitions: 0", "'repetitions'"),
    (SweepConfig, "axes: [1]", "'axes'"),
    (SweepConfig, "axes: {seed: 1}", "'axes.seed'"),
    (ServerConfig, "video: {port: 65536}", "'video.port'"),
    (ServerConfig, "video: {gop_frames: 0}", "'video.gop_frames'"),
    (ServerConfig, "rendezvous: {host: a, video_port: 0}", "'rendezvous.video_port'"),
    (ServerConfig, "rendezvous: {probe: 5602}", "did you mean 'probe_port'"),
    (ServerConfig, "{rendezvous: {host: a}, injection: {interface: eth0}}", "rendezvous.host"),
    (RendezvousConfig, "video_port: 65536", "'video_port'"),
    (
        RendezvousConfig,
        "security: {key: a}",
        "'security' is a key of a config for `lavt server`, not for `lavt rendezvous`",
    ),
    (RelayConfig, "video_server: 127.0.0.1:1", "'control_server' is missing"),
    (RelayConfig, "{video_server: a:1, control_server: a:1, video: {constant_ms: -1}}", "'video.constant_ms'"),
    (RelayConfig, "{video_server: a:1, control_server: a:1, video: {jitter_median_ms: .inf}}", "jitter_median_ms"),
    (RelayConfig, "{video_server: a:1, control_server: a:1, video: {link: {los: 0.1}}}", "did you mean 'loss'"),
]


@pytest.mark.parametrize(("kind", "text", "reason"), BAD_VALUES, ids=[text for _, text, _ in BAD_VALUES])
def test_bad_values_are_rejected(kind: type[Section], text: str, reason: str, tmp_path: Path) -> None:
    """A value of a wrong type, out of range or not finite is rejected with its key, and never converted silently."""
    sentence = rejection(text, tmp_path, kind)
    assert reason in sentence
    assert "my.yaml" in sentence


@pytest.mark.parametrize("text", ["1e-2", "2e-5", "1E1"])
def test_suggested_numbers_are_numbers_in_yaml(text: str, tmp_path: Path) -> None:
    """For a number that YAML reads as text, the error suggests the same number as YAML reads it."""
    _, _, suggestion = rejection(f"video: {{buffer_ms: {text}}}", tmp_path).rpartition("write ")
    assert parse_yaml(suggestion, "the suggestion") == float(text)


def test_words_are_not_suggested_as_numbers(tmp_path: Path) -> None:
    """A word that Python would read as a number that is not finite gives the ordinary error."""
    assert "YAML reads" not in rejection("video: {buffer_ms: nan}", tmp_path)


def test_all_errors_are_reported_together(tmp_path: Path) -> None:
    """All errors of a config are reported in one sentence."""
    sentence = rejection("seed: -1\ncamera: {width: 1, rate_hz: 0}", tmp_path)
    assert all(key in sentence for key in ("'seed'", "'camera.width'", "'camera.rate_hz'"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("- 1\n- 2", "not a list"),
        ("just words", "not a str"),
        ("3", "not a int"),
        ("a: [", "is not YAML"),
        ("a: 1\n\tb: 2", "is not YAML"),
        ("when: 2026-13-45", "is not YAML"),
        ("x: !!python/object:os.system {}", "is not YAML"),
        ("[" * 5000, "is not YAML"),
    ],
)
def test_bad_files_are_rejected(text: str, reason: str, tmp_path: Path) -> None:
    """A file that is not YAML, or not a mapping, is rejected in one sentence that names it."""
    sentence = rejection(text, tmp_path)
    assert reason in sentence
    assert "my.yaml" in sentence


def test_config_of_another_command(tmp_path: Path) -> None:
    """An error of a config whose keys are those of another command's config names that command."""
    assert "are keys of a config for `lavt sweep`, not for `lavt run`" in rejection(
        "routes: [a]\nconditions: [L0]", tmp_path
    )
    assert "`lavt" not in rejection("sed: 1", tmp_path)
    assert "`lavt" not in rejection("seed: -1", tmp_path)


def test_many_errors_are_counted(tmp_path: Path) -> None:
    """Of many errors the first five are described, and the others counted."""
    sentence = rejection("\n".join(f"key_{number}: 1" for number in range(9)), tmp_path)
    assert "'key_4'" in sentence
    assert "'key_5'" not in sentence
    assert "and 4 more errors" in sentence


def test_binary_file(tmp_path: Path) -> None:
    """A file that is not text is rejected."""
    path = tmp_path / "my.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(UserError, match=r"my\.yaml is not YAML"):
        load_config(RunConfig, path)


@pytest.mark.parametrize("name", ["nothing.yaml", "."])
def test_missing_file(name: str, tmp_path: Path) -> None:
    """A missing file, or a directory, is rejected, and the error names it."""
    with pytest.raises(UserError, match=re.escape(str(tmp_path / name))):
        load_config(RunConfig, tmp_path / name)


@pytest.mark.parametrize("text", ["", "# nothing\n"])
def test_a_file_without_keys_is_rejected(text: str, tmp_path: Path) -> None:
    """A file without keys, perhaps one that was cut off, does not give the default config."""
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(UserError, match=r"my\.yaml has no keys"):
        load_config(RunConfig, tmp_path / "my.yaml")


@given(st.text(max_size=60))
def test_any_text_raises_only_user_errors(text: str) -> None:
    """Parsing any text as YAML raises only UserError."""
    with suppress(UserError):
        parse_yaml(text, "here")


LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=4))
TREES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(LEAVES, inner, max_size=3))


@given(st.sampled_from([RunConfig, SweepConfig, ServerConfig, ClientConfig, RelayConfig, RendezvousConfig]), st.data())
def test_any_values_raise_only_user_errors(kind: type[Section], data: Any) -> None:
    """Validating any values as a config raises only UserError."""
    keys = st.sampled_from([*kind.model_fields, "other"])
    with suppress(UserError):
        assert isinstance(parse_config(kind, data.draw(st.dictionaries(keys, TREES, max_size=4)), "here"), kind)


def test_configs_are_immutable() -> None:
    """A config cannot be changed."""
    with pytest.raises(ValueError, match="frozen"):
        RunConfig().seed = 2  # type: ignore[misc]


@pytest.mark.parametrize(
    "safety",
    [
        SafetyConfig(lateral_acceleration_mps2=3.1),
        SafetyConfig(picture_age_limit_ms=501.0),
        SafetyConfig(stopping_distance_limit_m=21.0),
        SafetyConfig(speed_limit_mps=80 / 3.6),
    ],
)
def test_wide_limits_are_for_simulators(safety: SafetyConfig) -> None:
    """Limits beyond the defaults are rejected for a real vehicle, with an error that names the keys."""
    with pytest.raises(UserError) as rejected:
        limits_of(safety, simulated=False)
    assert all(f"safety.{key}" in str(rejected.value) for key in SafetyConfig.model_fields if key != "governor")
    wide = limits_of(safety, simulated=True)
    assert wide.lateral_acceleration_mps2 == safety.lateral_acceleration_mps2
    assert wide.picture_age_limit_ns == safety.picture_age_limit_ms * 1e6
    assert wide.stopping_distance_limit_m == safety.stopping_distance_limit_m
    assert wide.speed_limit_mps == safety.speed_limit_mps


@pytest.mark.parametrize("simulated", [True, False])
def test_tighter_limits_are_valid_for_every_vehicle(simulated: bool) -> None:
    """The default and tighter limits are valid for every vehicle, and change no other limit."""
    assert limits_of(SafetyConfig(), simulated=simulated) == LIMITS
    requested = SafetyConfig(lateral_acceleration_mps2=2.0, picture_age_limit_ms=300.0, stopping_distance_limit_m=10.0)
    tight = limits_of(requested, simulated=simulated)
    assert (tight.lateral_acceleration_mps2, tight.picture_age_limit_ns, tight.stopping_distance_limit_m) == (
        2.0,
        300_000_000,
        10.0,
    )
    assert tight.stop_after_ns == LIMITS.stop_after_ns
    assert tight.stamp_memory_ns == LIMITS.stamp_memory_ns


def test_nothing_is_delayed_by_default() -> None:
    """By default the relay delays nothing, and the error of the clocks is within its bound."""
    assert DelayConfig() == DelayConfig(constant_ms=0.0, jitter_median_ms=0.0, jitter_sigma=0.0)
    assert ClocksConfig().error_us <= ClocksConfig().bound_us


def test_every_impairment_can_be_changed_by_a_run() -> None:
    """A run, and so a sweep, can replace every impairment of its condition within the same bounds."""
    changes = FlowChanges.model_json_schema()["properties"]
    for name, schema in ImpairmentConfig.model_json_schema()["properties"].items():
        bounds = {key: value for key, value in schema.items() if key not in ("title", "default", "description")}
        assert bounds in changes[name]["anyOf"], name


COSTS = {"measured_on": "here", "stages_us": {"camera": {"encode": 2000.0}}, "links_us": {"video": 1200.0}}
QUANTILES = {"levels": [0.0, 0.5, 1.0], "link_quantiles_us": {"video": [900.0, 1200.0, 4000.0]}}


def test_costs_with_quantiles() -> None:
    """Costs can have quantiles of some stages and links; their constant version has only the medians."""
    costs = parse_config(
        Costs, {**COSTS, **QUANTILES, "stage_quantiles_us": {"camera": {"encode": [1.0, 2.0, 3.0]}}}, ""
    )
    assert costs.constant == parse_config(Costs, COSTS, "")
    assert costs.constant != costs


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"levels": [0.0, 0.5]}, "levels"),
        ({"levels": [0.0, 1.0, 1.0]}, "levels"),
        ({"levels": []}, "levels"),
        ({"link_quantiles_us": {"state": [1.0, 2.0, 3.0]}}, "state has quantiles but no median"),
        (
            {"stage_quantiles_us": {"camera": {"decode": [1.0, 2.0, 3.0]}}},
            r"camera\.decode has quantiles but no median",
        ),
        ({"link_quantiles_us": {"video": [1.0, 2.0]}}, "video"),
        ({"link_quantiles_us": {"video": [1.0, 3.0, 2.0]}}, "video"),
        ({"link_quantiles_us": {"video": [-1.0, 2.0, 3.0]}}, "video"),
    ],
)
def test_invalid_quantiles_of_costs(change: dict[str, Any], fact: str) -> None:
    """Quantiles that do not belong to a median, do not match the levels or decrease are rejected in one sentence."""
    with pytest.raises(UserError, match=fact):
        parse_config(Costs, {**COSTS, **QUANTILES, **change}, "costs.yaml")
