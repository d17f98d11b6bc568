"""Places of a device in a vehicle by words, or in metres from the middle of the front axle.

The distances are assumed: those of a saloon or hatchback of 2.5 to 2.9 m of wheelbase, to some
0.2 m. At 70 km/h, 0.2 m change the phase of a wave of 3 m by a tenth of a radian at the sensor.
"""

from road_envs.core.config import ConfigError
from road_envs.records.accelerometers import Accelerometer

DEVICE = "PHONE"
"""Name of the one accelerometer of a device at a place."""

PLACES = {
    "dashboard": Accelerometer(axle="front", ahead=-0.5, y=0.0),
    "floor": Accelerometer(axle="front", ahead=-1.3, y=0.0),
    "seat": Accelerometer(axle="front", ahead=-1.6, y=0.35),
    "trunk": Accelerometer(axle="rear", ahead=-0.3, y=0.0),
    "bumper": Accelerometer(axle="front", ahead=0.75, y=0.0),
}
"""Places by name: a mount on the dashboard or the windscreen, the floor between the front seats,
the driver's seat on the left, the floor of the trunk, and the front bumper.
"""

SEAT_NOTE = "a seat swings by itself at 3 to 5 Hz, which no model here has: put it on the floor"


def parse_place(at: str) -> Accelerometer:
    """Return the place of a word of PLACES, or of "AHEAD" or "AHEAD,LEFT" in metres.

    AHEAD counts from the front axle and is negative behind it, LEFT from the centre line. Raises
    ConfigError.
    """
    if at in PLACES:
        return PLACES[at]
    try:
        ahead, *rest = (float(part) for part in at.split(","))
        (left,) = rest or (0.0,)
        return Accelerometer(axle="front", ahead=ahead, y=left)
    except (ValueError, ConfigError):
        raise ConfigError(
            f"the place {at[:40]!r} is none of {', '.join(PLACES)}, nor metres ahead of the front "
            "axle and to the left, as in -0.5,0.2 (half a metre behind it)"
        ) from None
