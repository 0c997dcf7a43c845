"""The Gymnasium environments; importing this package registers `lavt/LaneKeeping-v0` (`docs/gym.md`)."""

from lavt.errors import UserError

try:
    from gymnasium import register
except ImportError as error:
    raise UserError(f"lavt.gym needs the package gymnasium ({error}): pip install -e '.[gym]' in the clone") from error

LANE_KEEPING = "lavt/LaneKeeping-v0"

register(LANE_KEEPING, entry_point="lavt.gym.lane_keeping:LaneKeepingEnv")
