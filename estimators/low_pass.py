"""Records whose accelerations were low-passed before they came here.

Such a filter weakens signal and noise alike. Up to its bandwidth it is undone, which leaves signals
and white noise as they were sampled; above, nothing is known. An estimator that took the silence
there for a measurement would look for a vehicle that explains it.

A filter that the record does not name is noticed where the accelerations end: within an octave
below _MAX_CORNER they fall by _FALL or more, which neither vehicle nor road do, to less than
_SILENCE of the noise of the instruments. It is taken for the Butterworth filter without phase
behind which the spectrum follows a power law best. One that begins lower, or falls less, as the
mean of a few samples that an app has taken, is not undone, but a note says so (`smoothing_notes`).
"""

from dataclasses import replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.ndimage import binary_dilation, uniform_filter1d
from scipy.signal import welch

from road_envs.records.record import LowPass, Record
from road_envs.sensing.instruments import Instruments

_TAPER = 1.2  # frequency at which the spectrum of filtered accelerations ends, over the bandwidth
# Periods of the cut-off around a gap and at the ends of a record in which what is not measured
# exceeds the noise: a gap is bridged, and beyond the ends the signals are guessed
_GAP_REACH, _END_REACH = 2.0, 5.0
# Ratio of the power densities at both ends of an octave, and share of the noise's
_FALL, _SILENCE = 1e-3, 1e-2
# Range of the corner [Hz] of a filter that is not named; estimators use no more
_MIN_CORNER, _MAX_CORNER = 10.0, 100.0
# 0.1 to 0.7 behind such filters, 1.0 to 1.4 behind one of second order that begins lower
_POOR_FIT = 0.8  # RMS of the logarithm of the density over the best filter's
# Orders that are tried, and corners over the frequency at which the fall begins
_ORDERS, _CORNER_RATIOS = (3, 4, 5, 6, 8, 10), np.geomspace(0.8, 1.4, 60)
_WELCH_SECONDS = 0.5  # length [s] of the periodograms: their lines are 2 Hz apart
# Share of the noise of the instruments below which no sensor of theirs is, in bands of this share
# of the sample rate, from this one on. Means of 3 to 10 samples of a saloon's phone have 0.07 to
# 0.52, over classes A to C at 50 to 100 km/h, raw ones 1.3 to 5.0
_QUIET, _BAND, _SMOOTHED_FROM = 0.6, 0.03, 0.2
_LEAST_SECONDS, _MOST_LOST = 5.0, 0.05  # of a record whose density is known well enough


def undo_low_pass(
    record: Record, valid: np.ndarray, noise_density: float = 0.0
) -> tuple[Record, np.ndarray, tuple[str, ...]]:
    """Return a record whose accelerations are as sampled up to its bandwidth, which samples of them
    are `valid` (k, N), and notes.

    Its low-pass is then one without an order. `noise_density` [(m/s²)/sqrt(Hz)] of the
    accelerometers, by which a filter that the record does not name is noticed; 0: it is not.
    """
    fs, low_pass, a = record.fs, record.low_pass, bridge(record.a)
    named = low_pass is not None
    if not named and noise_density > 0.0:
        low_pass = _find_low_pass(a, fs, noise_density)
    if low_pass is None or low_pass.order is None or low_pass.bandwidth >= 0.5 * fs:
        return record, valid, ()
    gap, reach = (int(np.ceil(x * fs / low_pass.f_c)) for x in (_GAP_REACH, _END_REACH))
    reach = min(reach, a.shape[1] // 4)
    end = low_pass.bandwidth
    padded = np.pad(a, ((0, 0), (reach, reach)), mode="reflect", reflect_type="odd")
    size = next_fast_len(padded.shape[1], real=True)
    f = rfftfreq(size, 1.0 / fs)
    taper = np.clip((_TAPER - f / end) / (_TAPER - 1.0), 0.0, 1.0)
    inverse = np.sin(0.5 * np.pi * taper) ** 2 / np.maximum(low_pass.gain(f, fs), 1e-6)
    # the beginning is that of the padded signal's end on the circle: both are level
    undone = irfft(inverse * rfft(padded, size), size)[:, reach : reach + a.shape[1]]
    near = binary_dilation(~valid, np.ones((1, 2 * gap + 1)))
    near[:, :reach] = near[:, -reach:] = True
    undone[np.isnan(record.a)] = np.nan
    guess = "" if named else f", as it seems with order {low_pass.order}"
    note = (
        f"the accelerations were low-passed at {low_pass.f_c:.3g} Hz{guess}: the filter is undone "
        f"up to {end:.0f} Hz, and nothing above is used"
    )
    return replace(record, a=undone, low_pass=LowPass(end, None)), valid & ~near, (note,)


def smoothing_notes(record: Record, instruments: Instruments) -> tuple[str, ...]:
    """Return a note where accelerations are quieter than the noise of their sensors, as the mean of
    a few samples is about the frequencies that it takes out.
    """
    fs, lost = record.fs, float(np.mean(~np.isfinite(record.a)))
    if record.low_pass or lost > _MOST_LOST or record.t.size < _LEAST_SECONDS * fs:
        return ()
    f, S = welch(bridge(record.a), fs, window="blackmanharris", nperseg=round(fs), axis=1)
    level = np.sqrt(uniform_filter1d(S, max(3, round(_BAND * fs)), axis=1))
    used = (f >= _SMOOTHED_FROM * fs) & (f <= min(0.45 * fs, instruments.f_alias))
    noise = np.maximum(instruments.noise_densities[:, None], 1e-12)
    least = (level[:, used] / noise).min(axis=0)
    if not used.any() or least.min() > _QUIET:
        return ()
    return (
        f"the accelerations have {least.min():.0%} of the sensors' noise at "
        f"{f[used][least.argmin()]:.0f} Hz: they seem to be smoothed, which makes heights and IRI "
        "too low; record raw values, or give the filter (--low-pass)",
    )


def bridge(a: np.ndarray) -> np.ndarray:
    """Return signals (k, N), interpolated where they are not finite; 0 if none is."""
    t, good = np.arange(a.shape[1]), np.isfinite(a)
    pairs = zip(a, good, strict=True)
    return np.array([np.interp(t, t[g], x[g]) if g.any() else np.zeros(t.size) for x, g in pairs])


def _find_low_pass(a: np.ndarray, fs: float, noise_density: float) -> LowPass | None:
    """Return the low-pass that accelerations (k, N) seem to have passed, None if they have not."""
    size = min(round(_WELCH_SECONDS * fs), a.shape[1])
    f, S = welch(a, fs, window="blackmanharris", nperseg=size, axis=1)
    used = (f >= _MIN_CORNER) & (f <= 0.4 * fs)
    f, S = f[used], S[:, used].max(axis=0)
    above = np.maximum.accumulate(S[::-1])[::-1]  # greatest density from each frequency on
    low = f <= min(_MAX_CORNER, 0.5 * f[-1])
    silent = np.interp(2.0 * f[low], f, above)
    found = np.flatnonzero((silent < _FALL * S[low]) & (silent < _SILENCE * noise_density**2))
    if not found.size:
        return None
    begin = f[found[0]]
    near = (f >= 0.5 * begin) & (f <= 2.0 * begin)
    power_law = np.stack([np.ones(near.sum()), np.log(f[near])], axis=1)

    def misfit(low_pass: LowPass) -> float:
        log = np.log(S[near]) - 2.0 * np.log(low_pass.gain(f[near], fs))
        line = np.linalg.lstsq(power_law, log, rcond=None)[0]
        return float(np.sum((log - power_law @ line) ** 2))

    tried = (LowPass(float(r * begin), m) for m in _ORDERS for r in _CORNER_RATIOS)
    best = min(tried, key=misfit)
    return best if misfit(best) < _POOR_FIT**2 * near.sum() else None
