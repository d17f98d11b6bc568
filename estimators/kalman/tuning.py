"""Tuned constants of the Kalman filters.

Unless a comment says otherwise they were set on simulated drives of the training vehicle, on roads
of classes A to E, Belgian paving, bumps and potholes at 14.5 to 110 km/h.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np


@dataclass(frozen=True, kw_only=True)
class _Tuning:
    """Constants of `kalman`, `kalman_lag` and `kalman_rts`."""

    # road, windows and output
    node_spacing: Annotated[float, "m", "between the road's nodes"] = 0.05
    initial_length: Annotated[float, "m", "of nodes behind the rear axle at the start"] = 2.0
    ar_length: Annotated[float, "m", "of road from which the next node is predicted"] = 2.0
    circulant_length: Annotated[float, "m", "least circle for covariances by FFT"] = 400.0
    increment_length: Annotated[float, "m", "of the increments that tell the roughness"] = 0.5
    roughness_length: Annotated[float, "m", "over which roughness is averaged"] = 8.0
    # far beyond classes A to H
    min_roughness_scale: Annotated[float, "", "least roughness over the prior's"] = 1e-4
    max_roughness_scale: Annotated[float, "", "greatest roughness over the prior's"] = 1e3
    window_length: Annotated[float, "m", "that the vehicle moves in a window, or one block"] = 0.3
    max_blocks: Annotated[int, "", "most blocks in a window"] = 24
    # each chunk is smoothed with the next one only: long waves show at the joints of shorter ones
    chunk_windows: Annotated[int, "", "windows that are smoothed at once, 120 m"] = 400
    max_wheelbases_per_block: Annotated[float, "", "greatest advance in one block"] = 0.5
    max_speed: Annotated[float, "m/s", "above which the scored band is empty"] = 110.0
    n_detrend: Annotated[float, "cycles/m", "at which half the height is emitted"] = 0.1
    n_max_output: Annotated[float, "cycles/m", "highest emitted, if 25 Hz are not below"] = 5.0
    half_window: Annotated[float, "m", "half length of the output's low-pass"] = 1.0
    variance_stride: Annotated[int, "", "stations to the next whose variance is computed"] = 16
    # sensors and struts
    bias_std: Annotated[float, "m/s²", "prior standard deviation of the sensor biases"] = 0.05
    noise_time: Annotated[float, "s", "time constant of the noise scale"] = 1.2
    force_correlation_time: Annotated[float, "s", "of a strut force residual"] = 0.005
    # P lacks the errors of the filter's other linearizations
    std_inflation: Annotated[float, "", "factor on the standard deviation of a strut rate"] = 1.2
    max_nis: Annotated[float, "", "NIS per measurement to which innovations are reduced"] = 16.0
    # clipping may be a fault of the sensor
    max_limit: Annotated[float, "", "most deviations of a clipped sample's limit"] = 1.5
    # steps of the road; deviations are of bumps and potholes of 25 to 100 mm, over 1 to 3 nodes
    jump_length: Annotated[float, "m", "behind the newest node whose nodes are candidates"] = 0.3
    jump_std: Annotated[float, "m", "prior standard deviation of a step"] = 0.04
    # on a vehicle that is not the one described much is unexplained that is no obstacle
    min_log_ratio: Annotated[float, "noise scales", "log likelihood ratio of a step"] = 8.0
    # the step of a node that the wheel has hardly reached would be taken far too high
    min_information: Annotated[float, "", "on a step, over its prior's"] = 10.0
    # tyre and friction are linearized about the road without it, and the wheel may lift off
    relative_error: Annotated[float, "", "of an accepted step"] = 0.4
    rear_reach: Annotated[float, "m", "of the rear axle about a step, where none is accepted"] = 0.2
    max_jumps: Annotated[int, "", "steps accepted at a time"] = 4
    obstacle_error: Annotated[float, "", "of heights over the root sum square of steps"] = 0.2
    obstacle_reach: Annotated[float, "m", "about a step within which heights have it"] = 1.0
    # consistency: on grade S1 the median NIS is below 2 before the filter is lost; on a road that
    # became rough at once it was above 3 on the described vehicle itself
    noise_scale_warning: Annotated[float, "", "noise scale from which a note is given"] = 2.0
    lost_nis: Annotated[float, "", "median NIS above which the filter has lost the vehicle"] = 5.0
    lost_blocks: Annotated[int, "", "blocks of that median"] = 60
    lost_reach: Annotated[float, "m", "about a loss over which heights are wrong"] = 10.0
    obstacle_length: Annotated[float, "m", "over which a step explains the innovations"] = 6.5
    restart_noise: Annotated[float, "", "factor of each restart on the least noise scale"] = 4.0
    max_restarts: Annotated[int, "", "restarts at most"] = 2
    restart_blocks: Annotated[int, "", "below which a lost filter would be lost again"] = 400
    lost_noise_scale: Annotated[float, "", "noise scale from which heights are reduced"] = 20.0
    lost_power_share: Annotated[float, "", "of the measurements' power, that noise exceeds"] = 0.05
    # before the rear axle has passed, heights of another vehicle are worth nothing
    early_noise_scale: Annotated[float, "", "the same before the rear axle has passed"] = 8.0
    early_nis: Annotated[float, "", "mean NIS from which they are reduced, too"] = 3.0
    early_length: Annotated[float, "m", "of that mean: the noise scale takes 10 m"] = 2.0
    nis_cell: Annotated[float, "m", "over which the NIS is averaged"] = 0.25
    nis_behind: Annotated[float, "m", "front axle before a station whose NIS counts"] = 0.5
    nis_ahead: Annotated[float, "m", "front axle beyond it: either axle within 2 m"] = 4.79
    min_blocks: Annotated[int, "", "of a mean NIS, at least"] = 20
    power_window: Annotated[float, "m", "to either side, of the mean square of heights"] = 1.0
    # known and described individuals of grade S1 on classes A to D at 14.5 to 100 km/h (seeds 9765
    # to 10621): 51 to 98 % inside 90 % without the two, 81 to 98 with them
    linear_acceleration: Annotated[float, "m/s²", "RMS that increases errors by 0.4"] = 4.5
    tolerance_error: Annotated[float, "", "error of heights over the tolerance"] = 1.5
    tolerance_length: Annotated[float, "m", "of these heights"] = 10.0
    detrend_length: Annotated[float, "m", "of the Gaussian taken off; half at 0.12/m"] = 1.6

    @property
    def decay(self) -> float:
        """Decay per node of the retired-node sums (`state.py`)."""
        return float(np.sqrt(2.0) * np.pi * self.n_detrend * self.node_spacing)


TUNING = _Tuning()
