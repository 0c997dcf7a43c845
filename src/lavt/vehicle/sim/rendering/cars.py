"""Named cars: the parameters of simulated cars, each number with its source."""

from __future__ import annotations

from lavt.errors import UserError
from lavt.vehicle.sim.dynamics import CarParameters

LINCOLN_MKZ = CarParameters(
    # ApolloAuto/apollo, modules/common/data/vehicle_param.pb.txt, brand LINCOLN_MKZ (its width, 2.11 m, has mirrors).
    wheelbase_m=2.8448,
    rear_axle_to_front_m=3.89,
    rear_axle_to_rear_m=1.043,
    max_steering_rad=0.513,  # steering wheel to 8.203 rad, ratio 16
    max_steering_rate_radps=0.534,  # steering wheel at 8.552 rad/s
    max_acceleration_mps2=2.0,
    max_braking_mps2=6.0,
    # Apollo's lateral controller for the same car (lat_controller_conf): four times 520 kg, an axle's stiffness.
    mass_kg=2080.0,
    front_stiffness_nprad=155_495.0,
    rear_stiffness_nprad=155_495.0,
    # Our estimates for a car of this class.
    body_width_m=1.86,
    front_axle_to_gravity_m=1.40,
    yaw_inertia_kgm2=3300.0,
    friction=0.9,  # dry asphalt
    steering_dead_time_s=0.0,
    steering_lag_s=0.12,  # between 0.05 and 0.27 s in published models of by-wire cars
    pedal_dead_time_s=0.0,
    throttle_lag_s=0.2,
    brake_lag_s=0.2,
    rolling_resistance_mps2=0.1,  # 1 % of the weight
    drag_per_m=0.0002,  # half of 1.2 kg/m3 x 0.3 x 2.3 m2 over the mass
    kinematic_below_mps=3.0,  # the dynamic model is stiff at 2 m/s and singular at rest
)

CARS = {"lincoln_mkz": LINCOLN_MKZ}


def named_car(name: str) -> CarParameters:
    """Return the car with this name; raise a `UserError` that lists the known cars if there is none."""
    if name not in CARS:
        raise UserError(f"there is no car {name!r}: the known ones are {', '.join(CARS)}")
    return CARS[name]
