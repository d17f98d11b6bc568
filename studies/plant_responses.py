"""Responses of the plants and of the model that is told them, and what a part of it is for.

    python -m studies.plant_responses

The plants, with the linear struts of `as_driven`, drive 200 m of class C at 36 km/h. Their
responses of heave and pitch to the mean of the wheel paths and of roll to the difference are
compared with those of the linear model. In each band of frequencies stand the gain of the model
over the plant's and the RMS of the complex difference over that of the plant, both weighted by the
road.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.signal import csd, welch

from road_envs.plants.commonroad_car import CommonRoadCar, as_driven
from road_envs.plants.driving import RUN_IN
from road_envs.plants.mujoco_car import MujocoCar
from road_envs.roads import realise_road
from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

SPEED, STEP, LENGTH, SEED = 10.0, 1e-3, 200.0, 27_011
PLACES = {"centre": (0.0, 0.0), "left": (0.0, 1.0), "behind": (-1.0, 0.0)}
BANDS = ((1.5, 3.0), (3.0, 5.0), (5.0, 9.0), (9.0, 15.0))
SEGMENT = 4000
"""Samples of a spectral estimate; at 0.25 Hz a band has six lines or more."""

MOTIONS = ("heave", "pitch", "roll")
Response = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
"""By motion: frequencies [Hz], response [m/s² or rad/s² per m], and power of its input."""


def response_of(plant: CommonRoadCar | MujocoCar) -> Response:
    """Return the responses of a plant by spectral estimates."""
    surface = realise_road("iso_c", SEED, LENGTH)
    centre, left, behind = plant.drive(surface, -RUN_IN, SPEED, (LENGTH + RUN_IN) / SPEED, STEP)
    z = surface.height(-RUN_IN + SPEED * STEP * np.arange(centre.size))
    mean, difference = 0.5 * (z[0] + z[1]), z[0] - z[1]
    pairs = ((mean, centre), (mean, behind - centre), (difference, left - centre))
    found = {}
    for name, (x, y) in zip(MOTIONS, pairs, strict=True):
        f, power = welch(x, 1.0 / STEP, nperseg=SEGMENT)
        found[name] = f, csd(x, y, 1.0 / STEP, nperseg=SEGMENT)[1] / power, power
    return found


def model_response(car: VehicleParameters, f: np.ndarray) -> dict[str, np.ndarray]:
    """Return the responses (F,) of the linear model at frequencies `f` (F,) [Hz] by motion."""
    H = frequency_response(linearise(car, "passive", PLACES, speed=SPEED), SPEED, f=f)
    both, apart = np.array([1.0, 1.0]), np.array([0.5, -0.5])
    motions = H[:, 0] @ both, (H[:, 2] - H[:, 0]) @ both, (H[:, 1] - H[:, 0]) @ apart
    return dict(zip(MOTIONS, motions, strict=True))


def comparison(plant: Response, car: VehicleParameters, motion: str) -> str:
    """Return gain and error of the model of a `car` in each band."""
    f, H, power = plant[motion]
    G, cells = model_response(car, np.maximum(f, 1e-3))[motion], ""
    for low, high in BANDS:
        i = (f >= low) & (f < high)
        own, gain, error = (np.sum(power[i] * np.abs(x[i]) ** 2) for x in (H, G, G - H))
        cells += f"{np.sqrt(gain / own):>8.2f}{np.sqrt(error / own):>6.2f}"
    return cells


def cases() -> Iterator[tuple[str, str, str, str, Response, VehicleParameters]]:
    """Yield plant, car, change, motion, response of the plant, and vehicle of the model."""
    places = [SensorLocation(*at) for at in PLACES.values()]
    for name in ("bmw_320i", "jeep_cherokee", "defender_110_coils"):
        car = load_vehicle(name)
        plant, told = response_of(CommonRoadCar(car, places)), as_driven(car)
        assert told.side is not None
        rigid = replace(told, side=replace(told.side, joint_stiffness=(0.0, 0.0)))
        for motion in MOTIONS:
            yield "commonroad", name, "told", motion, plant, told
        yield "commonroad", name, "told that the joints are rigid", "roll", plant, rigid
    for name in ("bmw_320i", "defender_110_coils"):
        car = load_vehicle(name)
        assert car.side is not None
        told = replace(as_driven(car), side=car.side)
        plant = response_of(MujocoCar(told, places))
        for motion in MOTIONS:
            yield "mujoco", name, "told", motion, plant, told
        staying = replace(told, side=replace(car.side, fore_and_aft=False))
        yield "mujoco", name, "told that its axles stay as it pitches", "pitch", plant, staying


def main() -> None:
    """Print the table."""
    bands = "".join(f"{f'{low:g}-{high:g} Hz':>14}" for low, high in BANDS)
    print("response of the model over that of the plant: gain, and complex error")
    print(f"{'plant, car, change':<73}motion{bands}")
    for plant, name, change, motion, response, car in cases():
        head = f"{plant:<12}{name:<20}{change:<41}{motion:<6}"
        print(head + comparison(response, car, motion), flush=True)


if __name__ == "__main__":
    main()
