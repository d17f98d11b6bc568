"""What a single effect that the description does not know does to the estimates.

    python -m studies.effects RESULTS.jsonl

The described Land Rover drives over a road of class D with one thing about it, its instruments or
its surroundings changed, at 14.5 km/h in ride and at 54 km/h in mixed states. Estimators are given
the description. A row is appended to the results for each drive and estimator; those that stand
there are not computed again. Masses on springs of their own (passengers, a load), dampers that lag
and shapes of the body's modes other than the simulator's cannot be simulated here.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
from scipy.signal import bilinear, lfilter

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import (
    BendingMode,
    TorsionalFrame,
    VehicleParameters,
    load_vehicle,
)
from road_envs.vehicle.struts import Strut
from road_envs.vehicle.tolerances import scale_parameters
from studies.study import Row, run_study, study_parser

ROAD, SEED, LENGTH = "iso_d", 9050, 100.0
CONDITIONS: dict[float, Any] = {14.5: "ride", 54.0: {"front": "ride", "rear": "handling"}}
COMPARED: dict[str, tuple[str, dict[str, Any]]] = {
    "map_smoother": ("map_smoother", {}),
    "unfitted": ("map_smoother", {"adapt": False}),
    "kalman_lag": ("kalman_lag", {}),
    "wiener": ("wiener", {}),
    "tcn": ("tcn", {}),
}
"""Estimator and settings of each column: `unfitted` is `map_smoother` with the car as described."""

WORSE = 1.1
"""Error of a fitted estimate over that of the unfitted one from which on the fit has harmed."""

Car = Callable[[VehicleParameters], VehicleParameters]
Readings = Callable[[Record], Record]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Changes of the vehicle, of its instruments before and of the record after a drive."""

    car: Car = lambda car: car
    instruments: Callable[[Instruments], Instruments] = lambda instruments: instruments
    record: Readings = lambda record: record


def _scaled(**factors: float) -> Effect:
    """Return the effect of parameters times `factors`; __ stands for a dot of their paths."""
    paths = {name.replace("__", "."): factor for name, factor in factors.items()}
    return Effect(car=lambda car: scale_parameters(car, paths))


def _varied(**values: Any) -> Effect:
    """Return the effect of other `values` of the vehicle's variation."""
    return Effect(car=lambda car: replace(car, variation=replace(car.variation, **values)))


def _body(twist: float | None = None, bend: float | None = None, length: float = 4.4) -> Effect:
    """Return the effect of a body that twists and bends at these frequencies [Hz]."""
    frame = TorsionalFrame(f=twist, zeta=0.06) if twist else None
    bending = BendingMode(f=bend, zeta=0.04, length=length) if bend else None
    return _varied(frame=frame, bending=bending)


def _with_dampers(compression: float, rebound: float) -> Effect:
    """Return the effect of dampers with forces times these factors."""

    def of_curve(curve: Curve) -> Curve:
        pairs = zip(curve.x, curve.F, strict=True)
        return replace(curve, F=tuple(F * (compression if x < 0.0 else rebound) for x, F in pairs))

    def changed(car: VehicleParameters) -> VehicleParameters:
        assert isinstance(car.strut, Strut)
        law = car.strut.damper
        damper = replace(law, ride=of_curve(law.ride), handling=of_curve(law.handling))
        return replace(car, strut=replace(car.strut, damper=damper))

    return Effect(car=changed)


def _longer(share: float) -> Effect:
    """Return the effect of a wheelbase that is longer by a `share`."""
    return Effect(
        car=lambda car: replace(
            car, rear=replace(car.rear, x=car.rear.x - share * (car.front.x - car.rear.x))
        )
    )


def _moved(**metres: tuple[float, float]) -> Effect:
    """Return the effect of sensors that are ahead and to the left of where they are said to be."""

    def changed(instruments: Instruments) -> Instruments:
        places = dict(instruments.accelerometers)
        for name, (ahead, left) in metres.items():
            at: Any = places[name]
            places[name] = replace(at, ahead=at.ahead + ahead, y=at.y + left)
        return replace(instruments, accelerometers=places)

    return Effect(instruments=changed)


def _read(change: Callable[[Record], np.ndarray]) -> Effect:
    """Return the effect of other accelerations (k, N)."""
    return Effect(record=lambda record: replace(record, a=change(record)))


def _on_brackets(*f: float) -> Effect:
    """Return the effect of sensors on brackets that resonate at `f` [Hz], 0 for a stiff one."""

    def of_sensor(a: np.ndarray, f: float, fs: float) -> np.ndarray:
        if not f:
            return a
        w, zeta = 2.0 * np.pi * f, 0.03
        return np.asarray(lfilter(*bilinear([2 * zeta * w, w**2], [1, 2 * zeta * w, w**2], fs), a))

    return _read(lambda r: np.array([of_sensor(*x, r.fs) for x in zip(r.a, f, strict=True)]))


def _engine(level: float) -> Effect:
    """Return the effect of an engine of 27 and 54 Hz of this amplitude [m/s²] at each sensor."""
    orders = ((27.0, 1.0), (54.0, 0.5))
    return _read(
        lambda r: r.a + level * sum(part * np.sin(2.0 * np.pi * f * r.t) for f, part in orders)
    )


def _with_speed(share: float) -> Effect:
    """Return the effect of a speed signal that reads too much by a `share`."""
    return Effect(record=lambda r: replace(r, v=r.v * (1.0 + share), s=r.s * (1.0 + share)))


EFFECTS: dict[str, Effect] = {
    "none": Effect(),
    "body mass +10 %": _scaled(m_b=1.1),
    "body mass -10 %": _scaled(m_b=0.9),
    "roll inertia +15 %": _scaled(I_xx=1.15),
    "pitch inertia +15 %": _scaled(I_yy=1.15),
    "axle masses +15 %": _scaled(front__m=1.15, rear__m=1.15),
    "gas pressure +5 %": _varied(gas=(1.05,) * 4),
    "gas pressure FL +5 %": _varied(gas=(1.05, 1.0, 1.0, 1.0)),
    "polytropic exponent 1.35": _scaled(strut__n_p=1.35),
    "dampers +15 %": _varied(damper=(1.15,) * 4),
    "dampers -30 %": _varied(damper=(0.7,) * 4),
    "dampers left +15, right -15 %": _varied(damper=(1.15, 0.85, 1.15, 0.85)),
    "compression x 1.3, rebound x 0.8": _with_dampers(1.3, 0.8),
    "compression x 0.8, rebound x 1.3": _with_dampers(0.8, 1.3),
    "friction x 1.5": _varied(friction=(1.5,) * 4),
    "friction x 0.6": _varied(friction=(0.6,) * 4),
    "bushings +30 %": _varied(bushing=(1.3,) * 4),
    "roll stiffness 10 kN m/rad": _varied(roll_stiffness=(10e3, 10e3)),
    "tyre stiffness +10 %": _varied(tyre=(1.1,) * 4),
    "tyre stiffness -10 %": _varied(tyre=(0.9,) * 4),
    "tyre stiffness left +10 %": _varied(tyre=(1.1, 1.0, 1.1, 1.0)),
    "tyre damping x 2": _scaled(front__c_t=2.0, rear__c_t=2.0),
    "tyre progression 8/m": _varied(tyre_progression=8.0),
    "contact of 0.15 m": _varied(contact_length=0.15),
    "wheelbase +1 %": _longer(0.01),
    "wheelbase -1 %": _longer(-0.01),
    "twist at 8 Hz": _body(twist=8.0),
    "twist at 12 Hz": _body(twist=12.0),
    "twist at 20 Hz": _body(twist=20.0),
    "bending at 15 Hz": _body(bend=15.0),
    "bending at 25 Hz": _body(bend=25.0),
    "bending at 25 Hz, body of 3.6 m": _body(bend=25.0, length=3.6),
    "twist at 10, bending at 18 Hz": _body(10.0, 18.0),
    "sensors 0.1 m too far ahead": _moved(RF=(0.1, 0.0), LR=(0.1, 0.0), RR=(0.1, 0.0)),
    "sensors 0.1 m too far apart": _moved(RF=(0.0, -0.1), LR=(0.0, 0.1), RR=(0.0, -0.1)),
    "rear sensors ahead of their axle": _moved(LR=(1.24, 0.0), RR=(1.24, 0.0)),
    "gains +5, -5, +5 %": _read(lambda r: r.a * np.array([[1.05], [0.95], [1.05]])),
    "offsets of 0.3 m/s²": _read(lambda r: r.a + np.array([[0.3], [-0.3], [0.3]])),
    "brackets at 40 Hz": _on_brackets(40.0, 40.0, 40.0),
    "bracket of RF at 60 Hz": _on_brackets(60.0, 0.0, 0.0),
    "engine of 0.3 m/s²": _engine(0.3),
    "engine of 0.9 m/s²": _engine(0.9),
    "speed +1 %": _with_speed(0.01),
}


def compute(effect: str, kmh: float, name: str) -> Row:
    """Return error, share of the errors inside 90 %, and whether a note names the vehicle."""
    change, car = EFFECTS[effect], load_vehicle("land_rover_defender_110")
    instruments = load_instruments("paper")
    record, truth = simulate_record(
        ROAD,
        speed_kmh=kmh,
        mode=CONDITIONS[kmh],
        seed=SEED,
        vehicle=change.car(car),
        instruments=change.instruments(instruments),
        length=LENGTH,
    )
    told = change.record(replace(record, sensors=instruments.layout))
    estimator, settings = COMPARED[name]
    found = estimate(estimator, told, car, **settings)
    scores = score(found, truth, speed_kmh=kmh)
    return {
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "noted": any("vehicle" in note or "frame" in note for note in found.notes),
    }


def summary(rows: list[Row]) -> str:
    """Return a table for each speed, a row for each effect, and a line for each estimator."""
    parts = []
    for kmh in CONDITIONS:
        found = {(r["effect"], r["name"]): r for r in rows if r["kmh"] == kmh}
        lines = [
            f"{kmh:g} km/h: in-band NRMSE, share of the errors inside the intervals of 90 % in",
            "percent; !: less than 80 %, and no note on the vehicle",
            f"{'':<34}" + "".join(f"{name:>14}" for name in COMPARED),
        ]
        for effect in EFFECTS:
            cells = (_cell(found[effect, name]) for name in COMPARED)
            lines.append(f"{effect:<34}" + "".join(f"{cell:>14}" for cell in cells))
        parts.append("\n".join([*lines, *_findings(found)]))
    return "\n\n".join(parts)


def _is_silent(row: Row) -> bool:
    return row["inside"] < 0.8 and not row["noted"]


def _cell(row: Row) -> str:
    return f"{row['error']:.2f} {100 * row['inside']:>3.0f}{'!' if _is_silent(row) else ' '}"


def _findings(found: dict[tuple[str, str], Row]) -> list[str]:
    lines = []
    for name in COMPARED:
        own = {effect: row for (effect, other), row in found.items() if other == name}
        worst = max(own, key=lambda effect: own[effect]["error"])
        lines.append(
            f"{name}: median {median(row['error'] for row in own.values()):.2f}, worst "
            f"{own[worst]['error']:.2f} ({worst}); {sum(map(_is_silent, own.values()))} of "
            f"{len(own)} silent"
        )
    harmed = [
        f"{effect} ({found[effect, 'map_smoother']['error']:.2f})"
        for effect in EFFECTS
        if found[effect, "map_smoother"]["error"] > WORSE * found[effect, "unfitted"]["error"]
    ]
    return [*lines, f"worse by more than 10 % than unfitted: {', '.join(harmed) or 'none'}"]


def main() -> None:
    """Compute what is missing and print the tables."""
    chosen = study_parser("Single effects that the description does not know.").parse_args()
    cases = [
        {"effect": effect, "kmh": kmh, "name": name}
        for effect in EFFECTS
        for kmh in CONDITIONS
        for name in COMPARED
    ]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
