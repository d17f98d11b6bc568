"""Errors of the instruments of a drive, as parameters that are identified with the vehicle."""

from dataclasses import dataclass, replace

import numpy as np

from estimators.map_smoother.one_pass import Pass
from road_envs.vehicle.linear_model import point_rows


@dataclass(frozen=True)
class InstrumentErrors:
    """Errors of the instruments as parameters: gains of the accelerometers `sensors`, their places
    [m] ahead and to the left, displacement of the odometer [m], relative error of the speed, each
    in units of its standard deviation `std`.
    """

    sensors: tuple[str, ...]

    @classmethod
    def of(cls, one: Pass) -> "InstrumentErrors":
        """Those of the sensors of a pass."""
        return cls(tuple(one.model.locations))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (R,)."""
        kinds = ("gain", "x", "y")
        return (*(f"{kind}.{name}" for kind in kinds for name in self.sensors), "odometer", "speed")

    @property
    def std(self) -> np.ndarray:
        """Prior standard deviations (R,)."""
        n = len(self.sensors)
        return np.array([*(0.02,) * n, *(0.012,) * (2 * n), 0.3, 0.01])

    @property
    def n_fixed(self) -> int:
        """Number of the first parameters, which leave the vehicle's motion as it is."""
        return 3 * len(self.sensors)

    def apply(self, one: Pass, x: np.ndarray) -> Pass:
        """The pass of instruments with the errors `x` (0 or R,)."""
        if x.size == 0:
            return one
        *of_sensors, displacement, speed = (self.std * x).tolist()
        gain, ahead, left = np.reshape(of_sensors, (3, -1))
        model, inputs = one.model, one.inputs
        factor, places = np.exp(gain), zip(model.locations.values(), ahead, left, strict=True)
        moved = [place._replace(x=place.x + dx, y=place.y + dy) for place, dx, dy in places]
        rows = point_rows(model.plant, moved)
        rows, bending = factor[:, None] * rows, model.bending
        if bending is not None:
            bending = replace(bending, shape=factor * bending.shape)
        s = inputs.s + displacement + speed * (inputs.s - inputs.s[0])
        inputs = replace(inputs, s=s, v=inputs.v * (1.0 + speed))
        model = replace(model, sensor_rows=rows, bending=bending)
        return replace(one, model=model, inputs=inputs)
