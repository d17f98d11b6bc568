"""A record set out for the filter, filtered to its end, and smoothed in parts of bounded memory."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimators.common.block_means import Readings
from estimators.common.model_inputs import MOVING, REST, Course, at_rest
from estimators.kalman.filter import forward
from estimators.kalman.friction_linearization import SHARPNESS, WIDTHS, blurred_laws
from estimators.kalman.linearization import columns
from estimators.kalman.profile_output import EVERY, WINDOW, Tells, fade, tell
from estimators.kalman.road_process import Ahead, ahead, unknown_nodes
from estimators.kalman.rts_smoother import Later, backward
from estimators.kalman.state import NODES, ZERO, Block, Model, State, Way, empty
from road_envs.analysis.information_bound import F_C, RoadPrior
from road_envs.data.record import Record, grid, scored_band
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.equations import plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import memory_at_rest

DS = 0.05
"""Distance of the road's nodes [m]."""

REACH = 0.5
"""Length [m] of the rises that tell how rough the road is."""

MEMORY = 15.0
"""Length of road [m] over which roughness is taken together."""

PATIENCE = 1.2
"""Seconds over which the noise is found greater than believed."""

PERSISTENCE = 0.005
"""Seconds for which what is left of a strut's force stays the same."""

OFFSET = 0.05
"""Prior deviation [m/s²] of the sensors' zeros."""

FINEST = 5.0
"""Waves [cycles/m] up to which heights are told, if the speed lets 25 Hz through there."""

FARTHEST = 0.5
"""Wheelbases that the car may go in one block of readings."""

PART = 10_000
"""Blocks in one part of a drive that is smoothed. What comes after the next one is not waited for,
and long waves, which are known last, would show at the joints of shorter parts."""


@dataclass(frozen=True, eq=False)
class Journey:
    """A drive as the filter takes it: what does not change (`model`), the `way`, the `state` it is
    in, and the node number of a station s, (s - `start`) / DS; `columns` of a block at most.
    """

    model: Model
    way: Way
    state: State
    start: float
    columns: int

    @property
    def size(self) -> int:
        """Entries of the filter's vector."""
        return int(self.state.x.size)

    @property
    def blocks(self) -> int:
        """Blocks of readings."""
        return int(self.way.y.shape[1])


def journey(
    record: Record,
    car: VehicleParameters,
    instruments: Instruments,
    course: Course,
    readings: Readings,
    noise: float,
    prior: RoadPrior,
    level_ends: bool,
    behind: float,
) -> Journey:
    """Before the first block. `noise` [(m/s²)²] of a sample; stations are told up to `behind` [m]
    behind the front axle; with `level_ends` the road is level before station 0 and after its end.
    Raises ValueError if the odometer jumps.
    """
    per = readings.share.shape[2] * course.every
    moved = float(np.max(course.s[2 * per :] - course.s[: -2 * per]))
    if moved > FARTHEST * car.wheelbase:
        raise ValueError(
            f"the odometer jumps by {moved:.2f} m within {per * course.h:.3g} s: no drive goes so"
        )
    in_block = moved / DS
    reach = max(behind, car.wheelbase) + WINDOW
    K = int(np.ceil(reach / DS) + np.ceil(in_block)) + 8
    start = float(course.s[0]) - K * DS
    ends = np.array([0.0, record.length]) if level_ends else np.array([-np.inf, np.inf])
    way = Way(
        (course.s - start) / DS,
        course.v / DS,
        course.commands,
        readings.y,
        readings.count,
        (ends - start) / DS,
    )
    road = ahead(prior, DS)
    model = _model(car, instruments, course, per, noise, road)
    known = level_ends and record.s[0] <= 0.0
    state = _beginning(car, course, road, NODES + 2 * K, int(way.x[0]) + 2, known)
    return Journey(model, way, state, start, columns(in_block))


def _model(
    car: VehicleParameters,
    instruments: Instruments,
    course: Course,
    per: int,
    noise: float,
    road: Ahead,
) -> Model:
    one = plant(car)
    line = linearise(one, "ride", instruments.places(car))
    push = line.struts / line.M
    tables, left = blurred_laws(one.velocity)
    reach = round(REACH / DS)
    return Model(
        numbers=one.numbers.copy(),
        velocity=tables,
        displacement=one.displacement,
        first=one.numbers["losses"][0].copy(),
        widths=WIDTHS / SHARPNESS,
        left=left * PERSISTENCE / (per * course.h),
        struts=line.struts,
        sensors=line.body,
        push=push,
        felt=line.body @ push.T,
        ahead=road.weights,
        surprise=road.surprise,
        rise=road.rise(reach),
        reach=reach,
        memory=MEMORY / DS,
        h=course.h,
        per=per,
        every=course.every,
        lag=car.valve.lag,
        behind=car.wheelbase / DS,
        fade=fade(DS),
        noise=noise,
        patience=PATIENCE / (per * course.h),
    )


def _beginning(
    car: VehicleParameters, course: Course, road: Ahead, n: int, newest: int, level: bool
) -> State:
    x, P = np.zeros(n), np.zeros((n, n))
    x[: REST.size] = at_rest(car, course) + 1e-7  # at rest to the bit friction has a kink
    zeros = np.full(3, OFFSET)
    known = np.concatenate([REST if level else MOVING, np.zeros(ZERO - REST.size), zeros])
    P[: known.size, : known.size] = np.diag(known**2)
    if not level:
        P[NODES:, NODES:] = unknown_nodes(road, n, newest + 1 - (n - NODES) // 2)
    memory = memory_at_rest(int(course.commands[0]))
    learnt = np.array([1.0, MEMORY / DS, MEMORY / DS, 1.0])
    return State(x, P, memory, np.array([newest]), learnt)


def stations(trip: Journey, record: Record, lag: float, smear: float, about: bool) -> Tells:
    """The stations of a record, to be told once the front axle is `lag` [m] past them and `smear`
    [s] more have been sensed.
    """
    s, h = grid(record.length), trip.model.h
    at = (s - trip.start) / DS
    heard = smear + h * trip.model.per * np.arange(1, trip.blocks + 1)
    passed = np.interp(heard, 0.5 * h * np.arange(trip.way.x.size), trip.way.x)
    v = np.interp(s, record.s, record.v)
    high = np.array([scored_band(x)[1] for x in np.clip(v, 0.1, FASTEST)])
    fine = np.minimum(FINEST, F_C / np.maximum(v, 0.1))
    none = np.zeros((0, 2, trip.size))
    return Tells(
        at=at,
        due=np.searchsorted(passed, at + lag / DS),
        top=DS * np.stack([fine, high], axis=1) if lag > WINDOW else np.full((s.size, 2), 0.5),
        half=WINDOW / DS,
        about=about,
        z=np.zeros((s.size, 2)),
        variance=np.zeros((s.size, 2)),
        next=np.zeros(1, dtype=np.int64),
        rows=none,
        band=none,
    )


FASTEST = 110.0
"""Speed [m/s] above which no band is left to be judged."""


def filtered(trip: Journey, tells: Tells) -> None:
    """Filter a drive to its end, and tell all stations."""
    one = empty(trip.size, trip.columns, 1)
    forward(trip.model, trip.way, trip.state, 0, trip.blocks, tells, one)
    tell(trip.model, trip.state, tells, END)


END = 2**62
"""A block before which everything is told."""


def smoothed(trip: Journey, tells: Tells, part_size: int = PART) -> None:
    """Filter a drive, part by part, and tell each part again with what the next one heard."""
    edges = [*range(0, trip.blocks, part_size), trip.blocks]
    if len(edges) > 2 and edges[-1] - edges[-2] < part_size // 2:
        del edges[-2]
    before: Part | None = None
    for first, last in pairwise(edges):
        part = _ahead(trip, tells, first, last)
        if before is not None:
            _back(trip, [before, part], last == trip.blocks)
            _keep(tells, before)
        before = part
    if before is not None:
        if len(edges) == 2:
            _back(trip, [before], True)
        _keep(tells, before)


@dataclass(frozen=True, eq=False)
class Part:
    """The blocks from `first` to before `last`, the stations told in them from the one `begin` on,
    and the last node after them.
    """

    first: int
    last: int
    begin: int
    newest: int
    tells: Tells
    blocks: Block


def _ahead(trip: Journey, tells: Tells, first: int, last: int) -> Part:
    """Filter one part."""
    n, begin = trip.size, int(tells.next[0])
    end = int(np.searchsorted(tells.due, last)) if last < trip.blocks else tells.at.size
    here, many = slice(begin, end), end - begin
    own = Tells(
        at=tells.at[here],
        due=np.minimum(tells.due[here], last),
        top=tells.top[here],
        half=tells.half,
        about=tells.about,
        z=np.zeros((many, 2)),
        variance=np.zeros((many, 2)),
        next=np.zeros(1, dtype=np.int64),
        rows=np.zeros((many, 2, n)),
        band=np.zeros((many // EVERY + 1, 2, n)),
    )
    blocks = empty(n, trip.columns, last - first)
    forward(trip.model, trip.way, trip.state, first, last, own, blocks)
    if last == trip.blocks:
        tell(trip.model, trip.state, own, END)
    tells.next[0] = end
    return Part(first, last, begin, int(trip.state.newest[0]), own, blocks)


def _back(trip: Journey, parts: list[Part], at_end: bool) -> None:
    """Bring back what the last of the `parts` heard, and tell the first of them again; the last as
    well where the drive is `at_end`.
    """
    n, last = trip.size, parts[-1]
    later = Later(
        np.zeros(n), np.zeros((n, n)), np.array([last.newest]), np.zeros(1, dtype=np.int64)
    )
    for part in reversed(parts):
        again = at_end or part is not last
        later.next[0] = int(np.searchsorted(part.tells.due, part.last)) if again else 0
        backward(trip.model, trip.way, later, part.first, part.last, part.tells, part.blocks)


def _keep(tells: Tells, part: Part) -> None:
    here = slice(part.begin, part.begin + part.tells.at.size)
    tells.z[here], tells.variance[here] = part.tells.z, part.tells.variance
