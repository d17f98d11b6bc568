"""Tuned constants of the most probable road, of its vehicle and of identification.

Seeds are those of drives of 100 m of grade S1 unless a comment says otherwise; constants without a
comment are from the training drives: the training vehicle over potholes, bumps, classes A to E and
Belgian paving at 14.5 to 110 km/h.
"""

from dataclasses import dataclass
from typing import Annotated

_Stages = tuple[tuple[float, int], ...]
_CG = tuple[int, float]


@dataclass(frozen=True, kw_only=True)
class _Tuning:
    """Constants of `map_smoother`, of vehicles that are fitted to drives, and of `identify`."""

    # preparation of a drive: nodes and block means
    node_spacings: Annotated[tuple[float, float], "m", "least and greatest"] = (0.025, 0.05)
    f_resolved: Annotated[float, "Hz", "that the nodes resolve at any speed"] = 70.0
    # with as many unknowns as readings the noise is overestimated, and a fitted vehicle is biased
    readings_per_unknown: Annotated[float, "", "block means per unknown, at least"] = 2.0
    # the tyre passes on waves that the nodes cannot hold, and longer means keep them out
    axle_readings_per_unknown: Annotated[float, "", "where a sensor is on an axle"] = 1.0
    delay_noise_density: Annotated[
        float, "(m/s²)/sqrt(Hz)", "below which a filter is more than a delay to body sensors"
    ] = 5e-3
    node_margin: Annotated[int, "", "nodes before the first and behind the last under a wheel"] = 4
    min_blocks: Annotated[int, "", "of a pass in a window, if others have more"] = 32
    knot_spacing: Annotated[float, "m", "of the knots of the shifts, about"] = 10.0
    shift_std: Annotated[float, "m", "of a shift beforehand, between aligned passes"] = 0.05
    max_late_start: Annotated[float, "m", "from pass to pass on one level apron"] = 2.0
    speed_difference: Annotated[float, "std", "of the speed's error for its derivative"] = 0.1

    # prior of the road
    # longer waves are hardly observable at a walking pace
    n_flat: Annotated[float, "cycles/m", "below which the prior is no higher than there"] = 0.02
    # log ratio of the means of squared roughness, arithmetic over geometric: 5 to 6 on potholes and
    # bumps after the first steps, 1 to 3 on off-road courses
    level_contrast: Annotated[float, "", "of a road that is level between obstacles"] = 4.0
    # below 0.2 on stationary roads, 0.65 to 0.8 on potholes at 54 km/h in ride, where it is least
    min_contrast: Annotated[float, "", "the same of power, of one uneven in places"] = 0.5
    damping_rate: Annotated[float, "m/s", "at which dampers are linearized"] = 0.3
    least_told: Annotated[float, "", "share of the unknowns that give an octave's density"] = 0.5
    least_count: Annotated[float, "", "number of them"] = 16.0
    min_density_ratio: Annotated[float, "", "least density in an update, over the prior's"] = 1e-4
    # windows in which obstacles are found, and their edges, between which they may be level
    local_length: Annotated[float, "m", "standard deviation of the wide window"] = 0.3
    edge_length: Annotated[float, "m", "of the narrow one"] = 0.05
    level_share: Annotated[float, "", "least variance in the narrow one over the wide"] = 0.1
    prior_count: Annotated[float, "", "increments that are added to those in a window"] = 0.5
    prior_roughness: Annotated[float, "", "their roughness"] = 0.05
    roughness_range: Annotated[tuple[float, float], "", "of the local roughness"] = (0.005, 50.0)
    roughness_steps: Annotated[int, "", "at which tables are computed"] = 20
    max_level_step: Annotated[float, "", "of log roughness in the preconditioner"] = 1.5

    # minimization
    friction_stages: Annotated[_Stages, "m/s", "smoothing of friction, most steps with it"] = (
        (0.3, 2), (0.1, 2), (0.03, 2), (0.0, 12),
    )  # fmt: skip
    # smaller changes hardly lower the error, which is that of the posterior itself
    change_tolerance: Annotated[float, "std", "rms change of the unknowns that ends it"] = 0.4
    # the preconditioner knows an uneven road less well: with one a road of potholes is not reached
    uneven_iterations: Annotated[int, "", "factor on the conjugate gradients there"] = 3
    # a noise that still falls is that of an unfinished road, not of another vehicle
    settled: Annotated[float, "", "noise scale over that before from which on it is settled"] = 0.95
    max_halvings: Annotated[int, "", "of a step in the line search"] = 6
    reweighting_steps: Annotated[int, "", "under frequency-dependent noise"] = 3
    welch_segment: Annotated[int, "blocks", "in a segment of the residual's periodogram"] = 128
    prior_updates: Annotated[int, "", "most between the steps with the true friction"] = 6
    # where a road can explain all readings, a high noise and a smooth road confirm each other
    noise_fall: Annotated[float, "", "of the noise scale that is kept at most in a step"] = 0.35
    # a road that was lowered under a wheel would not be left again
    least_noise: Annotated[float, "", "noise scale over the residual's power"] = 0.03
    # up to 50, once 90, on potholes and growing defects, where a limit of 10 doubles the error; 60
    # to 400 on the sine sweep, 1e5 on the corrugation (seeds 71 and 72)
    max_noise_power: Annotated[float, "", "of the road's noise after an update of its prior"] = 50.0
    # a saloon of grade S2 over two bumps on class B at 100 km/h, three phones: 54 with a hole of
    # 0.55 m, where an even road leaves 3.5 and has no hole (`studies/few_sensors.py`, seed 704)
    even_gain: Annotated[float, "", "share of its noise that an even road leaves at most"] = 0.5
    # from the mean of single estimates on, which is so near that friction needs no smoothing
    joint_stages: Annotated[_Stages, "m/s", "the same of several passes"] = ((0.0, 8),)
    joint_prior_updates: Annotated[int, "", "of several passes"] = 2
    adapted_steps: Annotated[int, "", "of several passes whose vehicles were adapted"] = 4

    # wheels in the air
    # edges of obstacles are found by the steps that follow
    lowering_steps: Annotated[tuple[int, ...], "", "before which the road is lowered"] = (2, 5)
    max_liftoff_retries: Annotated[int, "", "roads under lifted wheels that are tried"] = 2
    liftoff_steps: Annotated[int, "", "after each"] = 5
    liftoff_load_share: Annotated[float, "", "of the mean wheel load of a lifted wheel"] = 0.1
    min_drop: Annotated[float, "m", "least lowering for another try, least depth of a hole"] = 0.01
    # over a short hole the wheel has lifted off, while on a shallow dip instead it is light
    light_on_level: Annotated[float, "", "load share of a light wheel, between obstacles"] = 0.5
    light_elsewhere: Annotated[float, "", "and on other roads"] = 0.3
    # the wheel has hit the far edge of a hole if the road rises behind by a share of its fall
    edge_reach: Annotated[float, "m", "behind a light wheel of that edge"] = 0.15
    edge_share: Annotated[float, "", "that share, at least"] = 0.25
    # 2.1 to 2.8 and all of the nodes behind a bump of 0.9 m on classes B and C at 100 km/h, 3.6 to
    # 4.5 and up to three quarters behind the top of a hump of 3.7 m (seeds 9101 and 9103)
    obstacle_fall: Annotated[float, "std", "of a road's change across a gap, of obstacles"] = 2.0
    flown_share: Annotated[float, "", "of the nodes in such a gap without a load, at least"] = 0.9
    # 1 / sqrt(12) if all of the range were equally probable
    edge_std: Annotated[float, "", "of a road without an edge, over the range it has"] = 0.2
    # a heavier flight is no road: bumps of 0.15 m at 54 km/h have 0.5 to 0.7
    lost_air_share: Annotated[float, "", "distance in the air of a lost vehicle, over all"] = 0.25
    # the noise of good instruments is small beside what another vehicle leaves unexplained
    lost_noise_scale: Annotated[float, "", "of a lost vehicle"] = 300.0
    lost_power_share: Annotated[float, "", "of the signals, which it exceeds, too"] = 0.3

    # posterior samples
    draw_cg: Annotated[_CG, "", "most steps, tolerance: one sample"] = (40, 1e-2)
    # (20, 0.05) take 2 points off the coverage of 90 %
    vehicle_cg: Annotated[_CG, "", "of the vehicle's errors"] = (40, 0.02)
    speed_cg: Annotated[_CG, "", "of the variance of the speed"] = (100, 0.05)
    attainable_cg: Annotated[_CG, "", "of one sample of the attainable error"] = (400, 1e-3)
    attainable_draws: Annotated[int, "", "of each posterior of the attainable error"] = 2
    # about six of its errors are independent, and their mean square is then within a quarter
    vehicle_draws: Annotated[int, "", "of an uncertain vehicle"] = 8
    evidence_length: Annotated[float, "m", "of road for which both are, where it is longer"] = 100.0
    # 7 to 33 of a vehicle as described, 68 to 650 of one of S1 (seed 211)
    quick_evidence: Annotated[float, "", "of the residual below which few samples do"] = 45.0
    quick_draws: Annotated[int, "", "then"] = 4
    quick_draw_cg: Annotated[_CG, "", "of each"] = (9, 0.1)
    road_draws: Annotated[int, "", "that an estimate carries: its deviation is within 13 %"] = 32
    prior_lines: Annotated[float, "", "of an octave for the stationary variance"] = 8.0
    min_state_length: Annotated[float, "m", "in a strut state with a deviation of its own"] = 10.0
    # curvature and unfinished minimization
    std_inflation: Annotated[float, "", "of all standard deviations"] = 1.1
    # the motion is not linear in the tolerances: 1.1 to 2.1 on classes B to D (seed 501)
    tolerance_inflation: Annotated[float, "", "of the errors by tolerances"] = 1.6
    # 93 to 100 % of the errors are then in the intervals of 90 %, each IRI in that of 95 %, on
    # classes B to D and Belgian paving at 14.5 to 54 km/h (seeds 5221 to 5224)
    fit_inflation: Annotated[float, "", "of a vehicle that was fitted to this drive"] = 1.4
    structure_inflation: Annotated[float, "", "of one with elements found on it"] = 2.0
    # 0.03 to 0.16 of S1, 0 to 0.03 of a vehicle as described (seed 211)
    shown_share: Annotated[float, "", "of its power that the vehicle's error shows"] = 0.04
    most_twice: Annotated[float, "", "of the heights that may be their vehicle's errors"] = 0.5
    obstacle_share: Annotated[float, "", "of the mean variance, between obstacles"] = 0.02

    # speed, from the time between the axles: a vehicle that is not quite the one described moves
    # the phase, and a wheelbase is known to millimetres (S2, report trial with seeds 1 to 6)
    speed_std_inflation: Annotated[float, "", "of the speed's deviation"] = 3.0
    least_speed_std: Annotated[float, "", "added to it"] = 0.001
    max_speed_std: Annotated[float, "std", "with which distances are corrected"] = 0.5
    max_speed_error: Annotated[float, "std", "with which they are"] = 4.0

    # fit of a vehicle
    difference: Annotated[float, "tolerances", "of a parameter for its derivative"] = 0.003
    # as wide as the resonances of a vehicle: a longer drive does not tell of another error
    error_bandwidth: Annotated[float, "Hz", "in which the error of the model is one"] = 2.0
    fit_steps: Annotated[int, "", "of the parameters at most, of a described vehicle"] = 6
    road_steps: Annotated[int, "", "of the road after each"] = 2
    # with 2 of 3 steps errors change by less than 1 %, with 1 by up to 8 % (C and D at 36 km/h)
    renewed_steps: Annotated[int, "", "in which terms of second order are computed anew"] = 2
    max_change: Annotated[float, "tolerances", "of a parameter in one step"] = 3.0
    small_change: Annotated[float, "std", "that ends the steps where all roads are known"] = 0.2
    small_on_unmeasured: Annotated[float, "std", "and otherwise"] = 0.7
    # Laplace's approximation where friction hides a road, and differences between the wheels: its
    # deviations are 2 to 4 times too small (studies/identified_parameters.py)
    unmeasured_weight: Annotated[float, "", "of such likelihoods"] = 1.0 / 16.0
    told_share: Annotated[float, "", "of the greatest information that tells a direction"] = 1e-3
    # one for each sensor of three and wheel path, whose turned phases then cancel
    trace_draws: Annotated[int, "", "samples of the posterior for the trace"] = 5
    # a tolerance of 0.01 takes twice as long and changes a step by 0.03 to 0.04 of the posterior
    # deviations, other samples by 0.07 to 0.08 (individual 1501)
    trace_cg: Annotated[_CG, "", "of these samples"] = (40, 0.05)
    tangent_cg: Annotated[_CG, "", "of the road's change"] = (150, 0.01)
    # of systems at whose solution the information is least
    quick_cg: Annotated[_CG, "", "roughly solved systems"] = (30, 0.05)
    adapt_noise_scale: Annotated[float, "", "from which on a vehicle is fitted"] = 1.15
    # 4 to 88 for vehicles as described, 52 to 1600 for S1 (seed 211); on smooth roads the road
    # takes most of what a wrong vehicle leaves; as many times as much where a drive is as many
    # times as long (seeds 9501 to 9503)
    evidence_due: Annotated[float, "", "of the residual from which on it is fitted, too"] = 100.0
    vehicle_share_due: Annotated[float, "", "if it has this share of the variance"] = 0.5
    max_unloaded_share: Annotated[float, "", "of the road without a load, of a fit"] = 0.02
    # 0.95 of a vehicle as described, 0.33 to 0.72 of S1
    believed_gain: Annotated[float, "", "share of the noise that a fit leaves at most"] = 0.85
    structure_power: Annotated[float, "", "of a vehicle with elements not described"] = 10.0
    # 1.4 to 4.2 of field cars on class A at 100 km/h (seeds 9996 to 9999), errors 0.55 to 1.0; with
    # the elements that are found 0.14 to 0.29
    searched_power: Annotated[float, "", "from which on such elements are searched"] = 1.3
    # deviations are then twice those of a known vehicle
    vehicle_share_noted: Annotated[float, "", "of the variance, that is noted"] = 0.75
    # within 2 % of 1 by its data sheet, anywhere alike
    gain_std: Annotated[float, "", "of a gain that was not identified"] = 0.012

    # identification
    fit_share: Annotated[float, "", "of each drive; the rest is held out"] = 2.0 / 3.0
    min_duration: Annotated[float, "s", "of a fitted part"] = 4.0
    min_speed: Annotated[float, "m/s", "mean of a fitted part"] = 1.0
    min_signal: Annotated[float, "noise rms", "of its accelerations"] = 3.0
    known_data_rate: Annotated[float, "Hz", "of block means over a known road"] = 100.0
    settling_steps: Annotated[int, "", "to the first state over a known road, at most"] = 12
    settled_on_known: Annotated[float, "", "ratio of noise scales that ends them"] = 0.97
    identification_steps: Annotated[int, "", "of the parameters at most"] = 14
    # a search reaches about a tenth of a frequency
    frame_starts: Annotated[tuple[float, ...], "Hz", "where searches for twist begin"] = (
        7.0, 8.5, 10.5, 13.0, 16.0, 20.0,
    )  # fmt: skip
    bending_starts: Annotated[tuple[float, ...], "Hz", "and for bending"] = (
        15.0, 18.0, 22.0, 27.0, 33.0, 40.0,
    )  # fmt: skip
    structure_gain: Annotated[float, "", "share that believed elements leave at most"] = 0.5
    refused_share: Annotated[float, "", "of the described one's that is refused"] = 0.5
    wheelbase_margin: Annotated[float, "m", "behind a profile's begin"] = 4.0
    undetermined: Annotated[float, "tolerances", "of a parameter that is not determined"] = 0.9
    far: Annotated[float, "tolerances", "deviation that is flagged"] = 3.0
    # 0.6 to 1.5 where the class is right, 2.8 to 4.3 of solid axles described as independent wheels
    # (seeds 7700 and 7750); up to 10 of the Land Rover in ride, but then nothing is far
    contradiction: Annotated[float, "", "of a vehicle of another kind, if far"] = 2.0
    min_correlation: Annotated[float, "", "of readings on the known road"] = 0.5
    clearly_better: Annotated[float, "", "correlation of another profile, to be believed"] = 0.03
    level_band: Annotated[tuple[float, float], "cycles/m", "of a profile's level"] = (0.2, 1.0)
    unit_ratio: Annotated[float, "", "of accelerations that doubts units"] = 4.0


TUNING = _Tuning()
