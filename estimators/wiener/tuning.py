"""Tuned constants of the Wiener smoothers, of the drive check and of the search for structure."""

from dataclasses import dataclass
from typing import Annotated

_Rounds = tuple[tuple[int, int], ...]


@dataclass(frozen=True, kw_only=True)
class _Tuning:
    """Constants of `wiener` and `iterated_wiener`."""

    # segments
    segment_length: Annotated[float, "m", "of a segment"] = 150.0
    segment_margin: Annotated[float, "m", "of the record used on either side of it"] = 40.0
    station_rate: Annotated[float, "Hz", "least rate of a segment's stations"] = 100.0
    pass_order: Annotated[int, "", "of the low-pass of the signals"] = 8
    f_pass: Annotated[float, "Hz", "its corner"] = 40.0
    filter_time: Annotated[float, "s", "over which it spreads an invalid sample"] = 0.08
    circle_padding: Annotated[float, "m", "unobserved road before the circle closes"] = 40.0
    longest_filled: Annotated[float, "", "gap over segment whose signals are filled in"] = 0.15
    # fit of road and noise
    f_low: Annotated[float, "Hz", "lowest of the fit: below, offset and drift dominate"] = 0.4
    pseudo_count: Annotated[float, "lines", "that the prior value 1 of a band counts for"] = 12.0
    damping_iterations: Annotated[int, "", "updates of the equivalent dampers at most"] = 4
    em_iterations: Annotated[int, "", "expectation maximisations in each"] = 6
    # the dampers follow the level's root: the estimate's error then changes by a thousandth
    level_tolerance: Annotated[float, "", "change of the road's level that ends them"] = 0.02
    cg_tolerance: Annotated[float, "", "relative residual of the conjugate gradients"] = 1e-3
    cg_steps_max: Annotated[int, "", "their most steps"] = 80
    # iteration, on the training drives
    f_datum: Annotated[float, "Hz", "lowest that is estimated"] = 0.1
    relaxation: Annotated[float, "", "of the update of the force residual"] = 0.7
    # errors of neighbouring samples cancel
    residual_noise_share: Annotated[float, "", "of the residual's unresolved power"] = 0.5
    divergence_threshold: Annotated[float, "", "change of the residual, if less likely"] = 0.8
    # further passes change the error by half a percent
    converged: Annotated[float, "", "change of the residual that ends the passes"] = 0.02
    # adaptation; the noise scale is 0.9 to 1.4 for the vehicle described, 1.3 to 1.9 for vehicles
    # of grade S1 and above 18 for those of grade S2, the gain 3 to 10 and 10 to 160
    adapted_scale: Annotated[float, "", "noise scale from which a vehicle is doubted"] = 1.2
    structure_scale: Annotated[float, "", "noise scale from which it may twist and bend"] = 4.0
    adaptation_gain: Annotated[float, "", "of the log posterior in the first step"] = 12.0
    # up to 0.3 on ISO and Belgian roads, above 0.4 with potholes or bumps
    max_obstacles: Annotated[float, "", "share of samples about obstacles"] = 0.4
    difference: Annotated[float, "tolerances", "step of the differences"] = 0.02
    independent_share: Annotated[float, "", "of the lines under a Hann window"] = 0.5
    max_step: Annotated[float, "tolerances", "greatest change in a step"] = 1.5
    max_deviation: Annotated[float, "tolerances", "greatest deviation"] = 4.0
    rounds: Annotated[_Rounds, "", "most passes, steps of scoring"] = ((1, 2), (15, 1))
    flexible_rounds: Annotated[_Rounds, "", "of one that may bend"] = ((1, 2), (1, 2), (15, 1))
    # check of the description; a test has drives with noise scales below and above `far_scale`
    checked_length: Annotated[float, "m", "of the drive's middle that is checked"] = 150.0
    check_gain: Annotated[float, "", "deviance per line and noise scale"] = 0.15
    far_scale: Annotated[float, "", "noise scale from which twice as much is asked"] = 4.5
    # below on the vehicle described, 9 or more with wrong channels
    doubted_scale: Annotated[float, "", "noise scale from which channels are doubted"] = 3.0
    # below 0.06 on vehicles as described and in MuJoCo, 0.10 to 0.32 in CommonRoad's cars, 0.11 to
    # 0.8 on 20 of 24 drives of a Defender described without side motion; 1 of 32 of S1 has 0.11
    side_gain: Annotated[float, "", "deviance per line for another side motion"] = 0.08
    side_factors: Annotated[tuple[float, ...], "", "of cornering and roll centres"] = (0.5, 2.0)
    far_out: Annotated[float, "", "deviations by the median from which on is an obstacle"] = 4.0
    surroundings: Annotated[float, "s", "on either side of one that is left out"] = 0.4
    most_left_out: Annotated[float, "", "share of a drive above which nothing is"] = 0.6
    least_channels: Annotated[int, "", "that separate noise from two wheel paths"] = 3
    max_exchanged: Annotated[int, "", "channels of which any two are exchanged"] = 4
    # search for structure; 10 of 10 bending bodies of two cars are found (70 and 100 km/h, classes
    # A to C, seeds 101 to 126), 9 within 4 % of their frequency, and none of 10 stiff ones bends
    structure_gain: Annotated[float, "", "least difference of the deviance"] = 15.0
    same_axle: Annotated[float, "m", "along the vehicle up to which sensors pair"] = 0.5
    least_apart: Annotated[float, "m", "across it from which on they tell its roll"] = 0.4
    body_over_wheelbase: Annotated[float, "", "length of a body"] = 1.6
    waviness: Annotated[tuple[float, ...], "", "exponents that are tried"] = (1.7, 2.0, 2.3)
    window: Annotated[float, "s", "of the periodogram"] = 1.0
    f_range: Annotated[tuple[float, float], "Hz", "of the periodogram"] = (0.9, 38.0)
    hann_lines: Annotated[float, "", "lines over which one of a Hann window spreads"] = 1.5
    least_windows: Annotated[float, "", "independent ones without obstacles"] = 4.0
    same_speed: Annotated[float, "", "relative range of the windows' speeds"] = 0.1
    level_updates: Annotated[int, "", "of the road's level, for the dampers"] = 2
    level_steps: Annotated[int, "", "for each"] = 8


TUNING = _Tuning()
