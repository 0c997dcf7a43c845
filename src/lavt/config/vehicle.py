"""The schema of the config sections `vehicle` and `safety`."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from lavt.config.carla import CarlaConfig
from lavt.config.dbw import DbwConfig
from lavt.config.governor import GovernorConfig
from lavt.config.section import Section

MAX_SIMULATED_MPS: Final = 22.3
"""The largest speed that can be configured, a little above 80 km/h."""


class VehicleConfig(Section):
    """The vehicle and its route; most keys are for the built-in simulator or a software car only."""

    kind: str = "simulator"
    """simulator: the built-in car; dbw: a by-wire kit; carla: a car in a CARLA server (`docs/carla.md`); or the name of
    your own vehicle (`docs/vehicles.md`)."""
    route: str = "a_key"
    """The name of a shipped road, or the path of a road's YAML file (`docs/roads.md`)."""
    scenery: Literal["full", "light", "none"] = "full"
    """light: without trees, lamp posts, buildings and clouds; none: also without rails and shadows."""
    light: Literal["noon", "low_sun", "overcast"] = "noon"
    """The position of the sun and the state of the sky, see `docs/camera.md`."""
    weather: Literal["clear", "wet", "rain", "fog", "night", "worn"] = "clear"
    """The weather and the state of the road, see `docs/camera.md`. It changes pictures only."""
    car: str = "lincoln_mkz"
    """The name of a car of the simulator (`docs/roads.md`)."""
    steering_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    """The time from a command until the wheels begin to follow. Null, here and for the four keys below: the value of
    `car`."""
    steering_lag_ms: float | None = Field(None, ge=0, le=2000)
    """The time constant with which the wheels follow."""
    pedal_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    """The time from a command until throttle and brake begin to follow."""
    throttle_lag_ms: float | None = Field(None, ge=0, le=5000)
    """The time constant with which the throttle follows."""
    brake_lag_ms: float | None = Field(None, ge=0, le=5000)
    """The time constant with which the brake follows."""
    front_stiffness_nprad: float | None = Field(None, ge=50_000, le=500_000)
    """The side force of the front axle per radian of slip; a smaller value makes the car understeer more. Null: the
    value of `car`."""
    speed_report_factor: float = Field(1.0, ge=0.5, le=2)
    """The reported speed divided by the true speed, as with tyres of another size. The vehicle's own safety limits use
    the reported speed, too."""
    lane_noise_m: float = Field(0.0, ge=0, le=1)
    """For fidelity `geometry`: standard deviation of the noise of the seen lane's lateral position, independent between
    frames."""
    lane_noise_rad: float = Field(0.0, ge=0, le=0.2)
    """The same for the direction of the lane at the rear axle."""
    after_collision: Literal["end", "continue"] = "end"
    """Whether a collision ends the drive, or the car slides along the obstacle and continues."""
    time_limit_s: float | None = Field(None, gt=0, le=86_400)
    """The maximum duration of a drive from the first movement; null: the route's time at 10 km/h plus 30 s."""
    dbw: DbwConfig = DbwConfig()
    """The by-wire kit of a vehicle of kind `dbw`. The other keys then apply to the software car, if there is one."""
    carla: CarlaConfig = CarlaConfig()
    """The server of a vehicle of kind `carla`. Of the other keys, `route`, `car`, `after_collision` and `time_limit_s`
    then apply."""


class SafetyConfig(Section):
    """The safety limits that a study may widen, for a simulated vehicle only."""

    lateral_acceleration_mps2: float = Field(3.0, gt=0, le=6.0)
    """The largest lateral acceleration that steering may cause."""
    picture_age_limit_ms: float = Field(500.0, gt=0, le=2000)
    """The largest age of the frame from which a command was made; older commands are rejected."""
    stopping_distance_limit_m: float = Field(20.0, gt=0, le=200)
    """The distance in which the car must be able to stop; above 20 m, the car can drive faster than it was tested."""
    speed_limit_mps: float = Field(40 / 3.6, gt=0, le=MAX_SIMULATED_MPS)
    """Above this speed the vehicle allows no throttle."""
    governor: GovernorConfig = GovernorConfig()
    """The speed governor (`docs/governor.md`). It only lowers limits, so every vehicle can have any of its values."""
