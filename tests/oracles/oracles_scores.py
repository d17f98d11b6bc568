"""Independent implementations of the scores and their statistics, from the definitions.

Nothing of the packages under test is imported. The code is slow and literal: loops over samples,
SciPy's own estimators, quadrature in place of closed forms.
"""

import numpy as np
from scipy import integrate, signal, stats

CLASS_LIMITS = [32e-6 * 4.0**k for k in range(7)]  # ISO 8608: A ends at 32e-6 m³, B at 128e-6, ...


def case(seed, length=120.0, ds=100.0 / 3964, share=0.8, noise=0.004):
    """Return truth, estimate and its standard deviation, each (2, M), and ds, drawn from a seed.

    The truth is a sum of 300 cosines of decreasing amplitude; the estimate is damped, late and
    noisy.
    """
    rng = np.random.default_rng(seed)
    s = ds * np.arange(int(length / ds))
    n = np.linspace(0.02, 6.0, 300)
    amplitude = 0.002 * n**-1.0
    y, a = np.zeros((2, s.size)), np.zeros((2, s.size))
    for side in range(2):
        phase = rng.uniform(0.0, 2.0 * np.pi, n.size)
        for k in range(n.size):
            y[side] += amplitude[k] * np.cos(2.0 * np.pi * n[k] * s + phase[k])
            late = 2.0 * np.pi * n[k] * (s - 0.06)
            a[side] += share * amplitude[k] * np.cos(late + phase[k])
    a += noise * rng.standard_normal(a.shape)
    sigma = rng.uniform(0.002, 0.008, a.shape)
    return y, a, sigma, ds


def in_band(z, ds, low, high):
    """Band-pass a wheel path (M,): subtract the line, taper odd ends of 20 m, cut the spectrum."""
    M = z.size
    k = np.arange(M)
    z = z - np.polyval(np.polyfit(k, z, 1), k)
    pad = min(M - 1, round(20.0 / ds))
    before = 2.0 * z[0] - z[1 : pad + 1][::-1]
    after = 2.0 * z[-1] - z[-1 - pad : -1][::-1]
    z = np.concatenate([before, z, after]) * signal.windows.tukey(
        M + 2 * pad, 2 * pad / (M + 2 * pad)
    )
    size = next_size(z.size)
    Z = np.fft.fft(z, size)
    n = np.abs(np.fft.fftfreq(size, ds))
    Z[(n < low) | (n > high)] = 0.0
    z = np.fft.ifft(Z).real
    trim = round(min(1.0 / low, 0.1 * M * ds) / ds)
    return z[pad + trim : pad + M - trim]


def next_size(size):
    """Return the least number >= size without a prime factor above 5, as for a real SciPy FFT."""
    while True:
        rest = size
        for p in (2, 3, 5):
            while rest % p == 0:
                rest //= p
        if rest == 1:
            return size
        size += 1


def rms(x):
    return np.sqrt(np.mean(np.square(x)))


def error_over_truth(y, a, ds, low, high):
    """Return RMS error over RMS truth, of both wheel paths together."""
    e = np.concatenate([in_band(a[i] - y[i], ds, low, high) for i in range(2)])
    t = np.concatenate([in_band(y[i], ds, low, high) for i in range(2)])
    return rms(e) / rms(t)


def pearson(y, a, ds, low, high):
    """Return r at equal stations, the lag [m] of the largest r within 0.5 m, and that r."""
    y = [in_band(z, ds, low, high) for z in y]
    a = [in_band(z, ds, low, high) for z in a]
    reach = int(0.5 / ds)
    M = y[0].size
    best = (-2.0, 0)
    for k in range(-reach, reach + 1):
        yy = ya = aa = 0.0
        for i in range(2):
            t, x = y[i][reach : M - reach], a[i][reach + k : M - reach + k]
            yy, ya, aa = yy + t @ t, ya + t @ x, aa + x @ x
        best = max(best, (ya / np.sqrt(yy * aa), k))
    ya = sum(float(np.correlate(y[i], a[i])[0]) for i in range(2))
    whole = np.sqrt(sum(z @ z for z in y) * sum(z @ z for z in a))
    return ya / whole, best[1] * ds, best[0]


def error_at_best_lag(y, a, ds, low, high):
    """Return the least RMS error over RMS truth of shifts within 0.5 m, shift by shift."""
    y = [in_band(z, ds, low, high) for z in y]
    a = [in_band(z, ds, low, high) for z in a]
    reach = int(0.5 / ds)
    M = y[0].size
    truth = np.concatenate([z[reach : M - reach] for z in y])
    errors = []
    for k in range(-reach, reach + 1):
        moved = np.concatenate([z[reach + k : M - reach + k] for z in a])
        errors.append(rms(moved - truth) / rms(truth))
    return min(errors)


def coherence(y, a, ds, low, high):
    """Return the mean of SciPy's magnitude-squared coherence inside the band, 10 m segments."""
    size = round(10.0 / ds)
    found = []
    for i in range(2):
        n, gamma2 = signal.coherence(y[i], a[i], 1.0 / ds, "hann", size, size // 2)
        found.append(gamma2[(n >= low) & (n <= high)])
    return float(np.mean(found))


def level_error(y, a):
    """Return equation 12 [-] with its sign, of both wheel paths about their means."""
    y = np.concatenate([z - np.mean(z) for z in y])
    a = np.concatenate([z - np.mean(z) for z in a])
    return (rms(a) - rms(y)) / rms(y)


def density(z, ds):
    """Return n and G (2, K) by SciPy's Welch estimate, 100 m segments with linear detrending."""
    size = min(z.shape[1], round(100.0 / ds))
    n, G = signal.welch(z, 1.0 / ds, "hann", size, size // 2, detrend="linear")
    return n[1:], G[:, 1:]


def mean_density(n, G, low, high):
    """Return the mean of G (K,) over a band: integral of the step function over its width."""
    dn, total = n[1] - n[0], 0.0
    for k in range(n.size):
        total += G[k] * max(0.0, min(high, n[k] + dn / 2) - max(low, n[k] - dn / 2))
    return total / (high - low)


def dsd_distance(y, a, ds, low, high):
    """Return RMS and mean [dB] of the ratios of the third octaves inside the band."""
    n, G_y = density(y, ds)
    _, G_a = density(a, ds)
    ratios = []
    for k in range(-20, 20):
        edges = 2.0 ** ((k - 0.5) / 3), 2.0 ** ((k + 0.5) / 3)
        if edges[0] >= low and edges[1] <= high:
            for i in range(2):
                ratio = mean_density(n, G_a[i], *edges) / mean_density(n, G_y[i], *edges)
                ratios.append(10.0 * np.log10(ratio))
    return rms(ratios), float(np.mean(ratios))


def class_of(G_d0):
    """Return the index of the class: 0 for A to 7 for H."""
    return sum(G_d0 >= limit for limit in CLASS_LIMITS)


def octave_classes(z, ds, n_c):
    """Return the classes of both wheel paths in the octave at `n_c`, from the w = 2 level."""
    n, G = density(z, ds)
    means = [mean_density(n, path, n_c / np.sqrt(2.0), n_c * np.sqrt(2.0)) for path in G]
    return [class_of(mean * (n_c / 0.1) ** 2) for mean in means]


def error_at(y, a, ds, n_c):
    """Return the NRMSE in the third octave at `n_c`."""
    n, G_y = density(y, ds)
    _, G_e = density(a - y, ds)
    edges = n_c * 2.0 ** (-1 / 6), n_c * 2.0 ** (1 / 6)
    return np.sqrt(
        mean_density(n, G_e.sum(axis=0), *edges) / mean_density(n, G_y.sum(axis=0), *edges)
    )


def crps(e, sigma):
    """Return the continuous ranked probability score of a normal forecast, by quadrature."""

    def gap(x):
        return (stats.norm.cdf(x, scale=sigma) - (x >= e)) ** 2

    far = abs(e) + 12.0 * sigma
    return sum(
        integrate.quad(gap, low, high, epsabs=1e-13, limit=200)[0]
        for low, high in ((-far, min(e, 0)), (min(e, 0), max(e, 0)), (max(e, 0), far))
    )


def coverage(e, sigma, share):
    """Return the share of errors inside the central interval of probability `share`."""
    low, high = stats.norm.interval(share, scale=sigma)
    return float(np.mean((low <= e) & (e <= high)))


# --- statistics -----------------------------------------------------------------------------------


def interquartile_mean(x):
    """Return the 25 % trimmed mean as the integral of the quantile function."""
    x = np.sort(np.asarray(x, dtype=float))
    N = x.size
    total = 0.0
    for k in range(N):
        total += x[k] * max(0.0, min((k + 1) / N, 0.75) - max(k / N, 0.25))
    return total / 0.5


def hierarchical(scores, draws, rng):
    """Return interquartile means of resamples of scores (R, C, S): R - 1 roads, S - 1 seeds."""
    R, C, S = scores.shape
    found = []
    for _ in range(draws):
        roads = [rng.integers(R) for _ in range(R - 1)]
        seeds = [rng.integers(S) for _ in range(S - 1)]
        found.append(
            interquartile_mean([scores[r, c, s] for r in roads for c in range(C) for s in seeds])
        )
    return np.array(found)
