# %% [markdown]
# # A drive as three phones would log it
#
# A car that differs from its description drives over a street with a hump, a pothole and a bump.
# The record is written as a table of its own kind: other column names, accelerations in g that
# include gravity, a clock that jitters about 100 Hz, and one position and speed per second. The
# positions are those of satellite navigation: they wander by metres within minutes.
#
# Run it as `python examples/phone_drive.py`; `road-recon report` turns the table into a report.

# %%
import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from road_envs import simulate_record
from road_envs.drives.logger_tables.description import DriveDescription, write_description
from road_envs.records.units import STANDARD_GRAVITY
from road_envs.roads import realise_road, write_csv
from road_envs.sensing.instruments import load_instruments

WANDER, WANDER_TIME = 2.0, 300.0
"""Error [m] of a position in each direction, and the time [s] within which it changes."""

parser = argparse.ArgumentParser(description="Write a drive as three phones would log it.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the files")
parser.add_argument("--road", default="street", help="shipped name, YAML file or surface file")
parser.add_argument("--speed-kmh", type=float, default=36.0)
parser.add_argument("--grade", default="S2", help="S0: the car as described, to S3")
parser.add_argument("--seed", type=int, default=1, help="of car, noise and clock")
parser.add_argument("--jitter-ms", type=float, default=3.0, help="largest error of the clock")
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)

# %% The drive: what the phones' filters pass, 1000 times a second
surface = realise_road(options.road, options.seed)
phone = load_instruments("phone")
record, _ = simulate_record(
    surface,
    speed_kmh=options.speed_kmh,
    mode="handling",
    instruments=replace(phone, fs=1000.0),
    grade=options.grade,
    seed=options.seed,
)

# %% Its table: samples are taken when the jittering clock says
rng = np.random.default_rng(options.seed)
even = np.arange(0.01, record.t[-1] - 0.01, 1.0 / phone.fs)
t = even + 1e-3 * options.jitter_ms * rng.uniform(-1.0, 1.0, even.size)
accelerations = [np.interp(t, record.t[np.isfinite(a)], a[np.isfinite(a)]) for a in record.a]
once = np.arange(t.size) % 100 == 0  # a position per second
v = options.speed_kmh / 3.6
s = record.s[0] + v * t  # the odometer of the record has the error of its speed
heading = 0.8 + 0.4 * np.sin(s / 120.0)
step = np.diff(s, prepend=s[0])
east, north = np.cumsum(step * np.sin(heading)), np.cumsum(step * np.cos(heading))
keep = np.exp(-1.0 / (phone.fs * WANDER_TIME))
for track in (east, north):
    steps = WANDER * np.sqrt(1.0 - keep**2) * rng.standard_normal(t.size)
    track += lfilter([1.0], [1.0, -keep], steps)
metres_per_degree = 111_195.0
stamp = pd.Timestamp("2026-05-04T09:30:00Z") + pd.to_timedelta(t, unit="s")
table = pd.DataFrame(
    {
        "timestamp": stamp.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        "front_right_z [g]": np.round(1.0 + accelerations[0] / STANDARD_GRAVITY, 5),
        "rear_left_z [g]": np.round(1.0 + accelerations[1] / STANDARD_GRAVITY, 5),
        "rear_right_z [g]": np.round(1.0 + accelerations[2] / STANDARD_GRAVITY, 5),
        "gps_speed [km/h]": np.where(
            once, np.round(3.6 * np.interp(t, record.t, record.v), 2), np.nan
        ),
        "latitude": np.where(once, np.round(48.137 + north / metres_per_degree, 7), np.nan),
        "longitude": np.where(
            once,
            np.round(11.575 + east / metres_per_degree / np.cos(np.radians(48.137)), 7),
            np.nan,
        ),
    }
)
table.to_csv(options.out / "phone_drive.csv", index=False)

# %% The description, and the truth to compare with
write_description(
    options.out / "phone_drive.yaml",
    DriveDescription(
        vehicle="land_rover_defender_110",
        columns={"a_rf": "front_right_z", "a_lr": "rear_left_z", "a_rr": "rear_right_z"},
        mode="handling",
        sensors="phone",
        offset=float(s[0]),
    ),
)
write_csv(surface, options.out / "phone_drive_truth.csv")
print(f"written: {options.out / 'phone_drive.csv'} and .yaml, {t.size} samples, {s[-1]:.0f} m")
