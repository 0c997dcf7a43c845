"""The environment `lavt/LaneKeeping-v0`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.control.drive_controller import LaneKeeper
from lavt.errors import UserError, WorkError
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once
from lavt.gym import LANE_KEEPING
from lavt.gym.agent_drive import AgentDrive
from lavt.gym.lane_keeping import LaneKeepingEnv
from lavt.nodes.agent_driver import AgentView
from lavt.recording.record import read_record

SHORT = ("vehicle.time_limit_s=1",)
"""An episode of about a second."""
Make = Callable[..., Any]


@pytest.fixture
def make() -> Iterator[Make]:
    """Return a function that makes an environment without wrappers; each is closed at the end."""
    made = []

    def make_one(**settings: Any) -> Any:
        made.append(gymnasium.make(LANE_KEEPING, **settings).unwrapped)
        return made[-1]

    yield make_one
    for env in made:
        env.close()


def pursue(observation: np.ndarray[Any, Any], distance_m: float = 9.0) -> list[float]:
    """Return the action of pure pursuit."""
    c0, c1, c2 = observation[:3].tolist()
    left_m = c0 + (c1 + c2 * distance_m) * distance_m
    return [float(np.arctan(2.8448 * 2 * left_m / distance_m**2)) / 0.2]


def drive(env: Any, action: Callable[[Any], list[float]], steps: int = 10_000, **reset: Any) -> list[tuple[Any, ...]]:
    """Return what `reset` and each step returned, until the end of the episode or for so many steps."""
    results: list[tuple[Any, ...]] = [env.reset(**reset)]
    while len(results) <= steps:
        results.append(env.step(np.array(action(results[-1][0]), np.float32)))
        if results[-1][2] or results[-1][3]:
            break
    return results


def test_make_registers_and_describes_the_spaces(make: Make) -> None:
    """The environment is made by its name, and its spaces follow its settings."""
    assert make().observation_space.shape == (7,)
    assert make().action_space.shape == (1,)
    env = make(controls_speed=True, action_history=3)
    assert (env.action_space.shape, env.observation_space.shape) == ((2,), (13,))
    spaces = make(observation="pixels", action_history=2).observation_space
    assert (spaces["picture"].shape, spaces["picture"].dtype) == ((480, 640, 3), np.uint8)
    assert spaces["vehicle"].shape == (5,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation": "sound"}, "no observation 'sound'"),
        ({"observation": "pixels", "fidelity": "geometry"}, "no pictures"),
        ({"steering_scale_rad": 0}, "steering_scale_rad"),
        ({"max_cross_track_m": -1}, "max_cross_track_m"),
        ({"action_history": -1}, "action_history"),
        ({"reward": {"speed": 1}}, "'speed'"),
        ({"reward": 3}, "reward is 3"),
        ({"steering_scale_rad": 10**400}, "steering_scale_rad"),
        ({"records": "src"}, "not an empty directory"),
        ({"records": 3}, "records is 3: give the path"),
    ],
)
def test_wrong_settings_are_one_sentence(settings: dict[str, Any], message: str) -> None:
    """A wrong setting raises a `UserError` that names it, when the environment is made."""
    with pytest.raises(UserError, match=message):
        gymnasium.make(LANE_KEEPING, **settings)


def test_an_unknown_render_mode_is_rejected() -> None:
    """The only render mode is rgb_array."""
    with pytest.raises(UserError, match="rgb_array"):
        LaneKeepingEnv(render_mode="human")


def test_calls_in_the_wrong_order_are_errors(make: Make) -> None:
    """A step before the first reset or after the end, and any call after closing, is an error; closing twice is not."""
    env = make(changes=SHORT, render_mode="rgb_array")
    for call in (lambda: env.step([0.0]), env.render):
        with pytest.raises(ResetNeeded):
            call()
    last = drive(env, lambda _: [0.0])[-1]
    assert (last[2], last[3], last[4]["ending"]) == (False, True, "timeout")
    with pytest.raises(ResetNeeded):
        env.step([0.0])
    env.close()
    env.close()
    for call in (lambda: env.step([0.0]), env.reset):
        with pytest.raises(ClosedEnvironmentError):
            call()


@pytest.mark.parametrize("action", [0.0, [], [0.0, 0.0], [np.nan], [np.inf], ["left"], [10**400], None])
def test_invalid_actions_are_errors(make: Make, action: Any) -> None:
    """An action of another shape, or one that is not finite, is an error and drives nothing."""
    env = make()
    env.reset(seed=1)
    with pytest.raises(InvalidAction):
        env.step(action)
    assert env.step([0.0])[4]["time_s"] < 0.05


def test_an_action_beyond_the_space_is_clipped(make: Make) -> None:
    """An action of 5 is the action 1, also in the history that the agent observes."""
    env = make(action_history=1)
    at_limit = drive(env, lambda _: [1.0], 3, seed=1)[-1][0]
    beyond = drive(env, lambda _: [5.0], 3, seed=1)[-1][0]
    assert at_limit.tobytes() == beyond.tobytes()
    assert beyond[-1] == 1.0


def test_the_history_has_the_newest_action_first(make: Make) -> None:
    """The observation ends with the earlier actions, the newest first, and begins with zeros."""
    env = make(action_history=3)
    env.reset(seed=1)
    env.step([0.25])
    assert env.step([-0.5])[0][-3:].tolist() == [-0.5, 0.25, 0.0]
    assert env.reset()[0][-3:].tolist() == [0.0, 0.0, 0.0]


def test_info_has_the_truth_and_the_delays(make: Make) -> None:
    """The latencies in `info` are the injected ones plus some ms, and the reward is the sum of its terms."""
    env = make(video_ms=80, control_ms=40)
    *_, (observation, reward, _, _, info) = drive(env, pursue, 25, seed=2)
    assert 0.08 < info["video_s"] < 0.09
    assert 0.04 < info["control_s"] < 0.05
    assert info["video_s"] < info["picture_age_s"]
    assert 0.12 < info["loop_s"] < 0.14
    assert observation[6] == pytest.approx(info["loop_s"], abs=0.025)
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert (info["safety"], info["ending"]) == ("driving", "")
    assert (info["injected_video_ms"], info["injected_control_ms"]) == (80, 40)
    assert info["applied_sequence"] > 50


def test_a_reset_amid_an_episode_begins_another_one(make: Make) -> None:
    """A reset begins the next episode with another seed, and the same seed begins the same episode."""
    env = make()
    first = drive(env, pursue, 5, seed=4)
    second = drive(env, pursue, 5)
    third = drive(env, pursue, 5, seed=4)
    assert first[-1][0].tobytes() == third[-1][0].tobytes() != second[-1][0].tobytes()


@pytest.mark.full
@pytest.mark.parametrize("settings", [{}, {"controls_speed": True, "action_history": 4, "video_ms": (0, 100)}])
def test_gymnasium_accepts_the_environment(make: Make, settings: dict[str, Any]) -> None:
    """`check_env` has no complaint about the environment with lane geometry."""
    check_env(make(render_mode="rgb_array", **settings))


@pytest.mark.full
def test_gymnasium_accepts_the_environment_with_pictures(make: Make) -> None:
    """`check_env` has no complaint about the environment with pictures."""
    changes = ("vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240")
    check_env(make(observation="pixels", changes=changes))


@pytest.mark.full
@pytest.mark.parametrize("settings", [{"condition": ("L0", "L3")}, {"observation": "pixels", "changes": SHORT}])
def test_the_same_seed_gives_the_same_bytes(make: Make, settings: dict[str, Any]) -> None:
    """Two environments with the same seed return the same observations, rewards and latencies, byte for byte."""

    def trace() -> list[Any]:
        env, traced = make(**settings), []
        for episode in range(2):
            for result in drive(env, lambda _: [0.02], 60, seed=7 if episode == 0 else None):
                parts = result[0].values() if isinstance(result[0], dict) else [result[0]]
                traced.append(([part.tobytes() for part in parts], repr(result[1:])))
        return traced

    assert trace() == trace()


def planned(changes: tuple[str, ...], driver: str) -> PlannedRun:
    kind = driver or "lane_keeper"
    vehicle = {"scenery": "none", "time_limit_s": 4}
    data = {"vehicle": vehicle, "controller": {"kind": kind}, "seed": 3}
    return plan_run(build_config(RunConfig, data, changes, "the test"), driver=driver)


@pytest.mark.full
@pytest.mark.parametrize(
    "changes",
    [
        ("fidelity=geometry", "network.condition=L3"),
        ("fidelity=geometry", "network.condition=L1", "network.video.jitter_ms=15", "camera.rate_hz=60"),
        ("fidelity=pixels", "network.condition=L1"),
    ],
)
def test_an_agent_that_decides_as_the_lane_keeper_drives_as_it(tmp_path: Path, changes: tuple[str, ...]) -> None:
    """With the lane keeper as agent, the ground truth and the latencies are those of `lavt run`, bit for bit."""
    run = planned(changes, "")
    expected = run_once(run, tmp_path / "run")
    preset, wheelbase_m = run.config.controller.effective_preset(), run.config.controller.wheelbase_m
    keeper = LaneKeeper(preset, wheelbase_m=wheelbase_m)

    def decide(view: AgentView) -> tuple[float, float]:
        return keeper.decide(view.lane, view.speed_mps, 0).steering_rad, preset.speed_mps

    episode = AgentDrive(planned(changes, "agent"), tmp_path / "agent", waiting=decide)
    while episode.ending is None:
        episode.act(*decide(episode.view))
    episode.close()
    truths = [read_record(tmp_path / name / "server.mcap").table("truth") for name in ("run", "agent")]
    assert truths[0].ints("mono_ns").tolist() == truths[1].ints("mono_ns").tolist()
    for key in ("x_m", "y_m", "heading_rad", "speed_mps", "steering_rad"):
        assert truths[0].floats(key).tolist() == truths[1].floats(key).tolist()
    result = json.loads((tmp_path / "agent" / "result.json").read_text())
    assert (result["valid"], result["controller"], result["ending"]) == (expected["valid"], "agent", "timeout")
    for key in ("loop_ms", "tau_v_ms", "tau_c_ms", "p95_m", "commands"):
        assert result.get(key) == expected.get(key)


@pytest.mark.full
def test_pure_pursuit_completes_the_route(make: Make) -> None:
    """Pure pursuit drives the route to its end, and gets a reward near the largest possible one."""
    results = drive(make(), pursue, seed=1)
    *_, terminated, truncated, info = results[-1]
    assert (terminated, truncated, info["ending"]) == (True, False, "completed")
    assert 0.1 * 115 < sum(result[1] for result in results[1:]) < 0.1 * 123
    speeds = [result[0][4] for result in drive(make(controls_speed=True), lambda o: [*pursue(o), 0.0], 300, seed=1)]
    assert max(speeds) == pytest.approx(30 / 3.6 / 2, rel=0.05), "the action 0 is half of the speed"


@pytest.mark.full
@pytest.mark.parametrize(
    ("settings", "action", "ending"),
    [
        ({}, 0.3, "lane_left"),
        ({"max_cross_track_m": 100}, -0.5, "collision"),
    ],
)
def test_failures_end_an_episode_with_a_penalty(
    make: Make, settings: dict[str, Any], action: float, ending: str
) -> None:
    """An episode in which the car leaves the lane or hits something ends with the penalty."""
    *_, terminated, truncated, info = drive(make(**settings), lambda _: [action], seed=1)[-1]
    assert (terminated, truncated, info["ending"]) == (True, False, ending)
    assert info["reward_terms"]["failure"] == -10


@pytest.mark.full
def test_an_outage_ends_an_episode_by_a_safe_stop(make: Make) -> None:
    """Without pictures, the vehicle stops by itself in a single long step, which ends the episode with the penalty."""
    env = make()
    before = drive(env, pursue, 100, seed=1)[-1][4]
    env._drive._loop.runtime.links["rtp"].open = False
    _, _, terminated, truncated, info = env.step([0.0])
    assert (terminated, truncated, info["ending"]) == (True, False, "safe_stop")
    assert info["speed_mps"] < 0.1
    assert info["time_s"] - before["time_s"] > 1.5
    assert info["reward_terms"]["failure"] == -10


@pytest.mark.full
def test_a_vehicle_that_is_never_armed_is_an_error(make: Make) -> None:
    """With pictures that are older than the gate allows, the reset raises the reason."""
    with pytest.raises(WorkError, match="a picture that is too old"):
        make(video_ms=700).reset(seed=1)


@pytest.mark.full
def test_episodes_are_recorded(make: Make, tmp_path: Path) -> None:
    """Each episode has a run directory with a result, also one that a reset or `close` ended."""
    env = make(records=tmp_path / "records", changes=SHORT)
    drive(env, pursue, seed=1)
    drive(env, pursue, 5)
    env.close()
    results = {path.parent.name: json.loads(path.read_text()) for path in tmp_path.rglob("result.json")}
    assert {name: result["ending"] for name, result in results.items()} == {
        "episode-000001": "timeout",
        "episode-000002": None,
    }
    assert (tmp_path / "records" / "episode-000002" / "client.mcap").is_file()


@pytest.mark.full
def test_a_vector_of_environments_runs(tmp_path: Path) -> None:
    """Gymnasium's vector of processes drives two environments at the same time."""
    del tmp_path
    vector = gymnasium.make_vec(f"lavt.gym:{LANE_KEEPING}", num_envs=2, vectorization_mode="async")
    try:
        observations, _ = vector.reset(seed=3)
        assert observations.shape == (2, 7)
        observations, rewards, *_ = vector.step(np.zeros((2, 1), np.float32))
        assert np.isfinite(observations).all()
        assert rewards.shape == (2,)
    finally:
        vector.close()
