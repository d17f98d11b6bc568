# %% [markdown]
# # An estimator of your own
#
# An estimator is a frozen dataclass of settings with a method `estimate(record, car)`. This one
# inverts the frequency response of the linearised vehicle, regularised by the spectrum of a typical
# road (a Wiener filter). It is tested as the leaderboard tests it, then compared on the main task.

# %%
import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from estimators.preprocessing import clean_record, spatial_accelerations
from estimators.wiener.segments import dominant_modes
from leaderboard import run_task
from leaderboard.conformance.probes import probe_estimator
from road_envs import Estimate, Record, load_vehicle, simulate_record
from road_envs.records.record import PROFILE_SPACING, profile_stations
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.linear_model import frequency_response, gaussian_damping, linearise
from road_envs.vehicle.parameters import VehicleParameters

parser = argparse.ArgumentParser(description="Define an estimator, probe it and compare it.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the picture")
parser.add_argument("--roads", type=int, default=2, help="test roads per condition")
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The method
#
# With the response H (3 sensors by 2 wheel paths) of the vehicle, the density S of the road and the
# noise density R of the sensors, the best linear estimate of the road at each spatial frequency is
# K a with K = S H* (H S H* + R)^-1.

# %%
MARGIN = 200
"""Stations before and after the road that the inversion may use: 5 m."""


@dataclass(frozen=True, kw_only=True)
class LinearInverse:
    """`noise` [(m/s²)/sqrt(Hz)] of the sensors and of what the linear model leaves out;
    `strut_rate` [m/s]: typical rate of the struts, for which the dampers are linearised.
    """

    causal: ClassVar[bool] = False  # the whole record is used

    noise: float = 0.06
    strut_rate: float = 0.15

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the heights of both wheel paths at the profile stations."""
        record, notes = clean_record(record)  # fills lost samples
        a = spatial_accelerations(record, MARGIN)  # (3, M), over distance
        size = 2 * a.shape[1]  # zeros keep the end from leaking into the beginning
        n = np.fft.rfftfreq(size, PROFILE_SPACING)  # [cycles/m]
        n[0] = n[1]  # the prior has a pole at 0

        v = float(np.median(record.v))
        mode = dominant_modes(record, np.arange(record.t.size))
        sensors = load_instruments("paper").locations(car)
        damping = gaussian_damping(car, mode, self.strut_rate)
        H = frequency_response(linearise(car, mode, sensors, damping=damping), v, n=n)

        prior = 1e-5 * n**-2.0  # a road of ISO 8608 class D, as S(n) [m³]
        SH = prior[:, None, None] * H.conj().transpose(0, 2, 1)
        K = SH @ np.linalg.inv(H @ SH + self.noise**2 * v * np.eye(3))
        z = np.fft.irfft(np.einsum("fij,jf->if", K, np.fft.rfft(a, size)), size)

        stations = profile_stations(record.length)
        return Estimate(stations, z[:, MARGIN : MARGIN + stations.size], notes=notes)


# %% [markdown]
# ## The probes
#
# Does the estimate follow the record? The leaderboard perturbs a record (sign, scale, order, sides)
# and checks that the estimate changes accordingly.

# %%
record, _ = simulate_record("iso_d", speed_kmh=30.0, mode="handling", seed=1)
for probe in probe_estimator(LinearInverse(), record, load_vehicle("land_rover_defender_110")):
    verdict = {True: "passed", False: "FAILED", None: "does not apply"}[probe.passed]
    print(f"{probe.name:<8} {verdict:<15} {probe.message}")

# %% [markdown]
# ## The comparison
#
# `run_task` takes registered names and "module:Class". It simulates the training and test drives,
# trains what has to be trained, and returns one row per estimated drive.

# %%
table = run_task("new_road", ["flat", "fir_ridge", "__main__:LinearInverse"], roads=options.roads)
table["estimator"] = table["estimator"].replace("__main__:LinearInverse", "LinearInverse")
conditions = table["condition"].unique()
errors = table.pivot_table(index="condition", columns="estimator", values="nrmse").loc[conditions]
print(errors.round(2))

# %%
axes = errors.drop(columns="flat").plot.barh(figsize=(9, 5), width=0.7)
axes.axvline(1.0, color="0.4", ls="--", lw=1.0, label="flat road")
axes.invert_yaxis()
axes.set(xlabel="in-band NRMSE", ylabel="", xlim=(0.0, 1.05))
axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
axes.spines[["top", "right"]].set_visible(False)
axes.figure.savefig(options.out / "own_estimator.png", dpi=120, bbox_inches="tight")
