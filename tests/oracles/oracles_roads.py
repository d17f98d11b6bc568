"""Independent reference solutions for roads, roughness and comfort, without the code under test.

Constants are repeated here from their sources, so that a wrong one in the code is detected.
"""

import numpy as np
from scipy.integrate import quad

CLASS_MEANS = {
    "A": 16e-6,
    "B": 64e-6,
    "C": 256e-6,
    "D": 1024e-6,
    "E": 4096e-6,
    "F": 16384e-6,
    "G": 65536e-6,
    "H": 262144e-6,
}

# Transition over 0.25 m at 80 km/h as printed by Sayers (1995), state: slopes and their rates
SAYERS_ST = np.array(
    [
        [0.9966071, 0.01091514, -0.002083274, 0.0003190145],
        [-0.5563044, 0.9438768, -0.8324718, 0.05064701],
        [0.02153176, 0.002126763, 0.7508714, 0.008221888],
        [3.335013, 0.3376467, -39.12762, 0.4347564],
    ]
)
SAYERS_PR = np.array([0.005476107, 1.388776, 0.2275968, 35.79262])


def trapezoid(s, middle, height, ramp, top):
    """Return the heights of a trapezoid from its four corners."""
    corners = middle + np.array([-0.5 * top - ramp, -0.5 * top, 0.5 * top, 0.5 * top + ramp])
    return np.interp(s, corners, [0.0, height, height, 0.0])


def iso_density(n, G_d0, w=2.0):
    return G_d0 * (np.asarray(n) / 0.1) ** -w


def isotropic_root_coherence(n, w, track):
    """Return cross over auto-spectrum of two cuts through a surface of spectrum k^-(w+1)."""

    def surface(m):  # wavenumber across the track in units of that along it
        return (1.0 + m * m) ** (-0.5 * (w + 1.0))

    auto = quad(surface, 0.0, np.inf)[0]
    cross = quad(surface, 0.0, np.inf, weight="cos", wvar=2.0 * np.pi * n * track, limlst=500)[0]
    return cross / auto


def sayers_iri(z):
    """Return the cumulative IRI [mm/m] after each step of 0.25 m, by the printed coefficients."""
    x = np.array([1.0, 0.0, 1.0, 0.0]) * (z[min(44, len(z) - 1)] - z[0]) / 11.0
    total, out = 0.0, []
    for slope in np.diff(z) / 0.25:
        x = SAYERS_ST @ x + SAYERS_PR * slope
        total += abs(x[0] - x[2])
        out.append(1e3 * total / (len(out) + 1))
    return np.array(out)


def golden_car_gain(n):
    """Return suspension slope over profile slope of the golden car at 80 km/h."""
    s = 2j * np.pi * n * 80.0 / 3.6
    k1, k2, c, mu = 653.0, 63.3, 6.0, 0.15
    link = k2 + c * s
    body = link / (s * s + link)  # z_s / z_u
    wheel = k1 / (mu * s * s + link + k1 - link * body)  # z_u / y
    return abs(wheel * (body - 1.0))


def wk_weight(f):
    """Return Wk from the magnitudes of its four factors as printed in ISO 2631-1, annex A."""
    f1, f2, f3, f4, Q4, f5, Q5, f6, Q6 = 0.4, 100.0, 12.5, 12.5, 0.63, 2.37, 0.91, 3.35, 0.91
    high = np.sqrt(f**4 / (f**4 + f1**4))
    low = np.sqrt(f2**4 / (f**4 + f2**4))
    transition = np.sqrt((f**2 + f3**2) / f3**2) * np.sqrt(
        f4**4 * Q4**2 / (f**4 * Q4**2 + f**2 * f4**2 * (1 - 2 * Q4**2) + f4**4 * Q4**2)
    )
    step = (Q6 / Q5) * np.sqrt(
        (f**4 * Q5**2 + f**2 * f5**2 * (1 - 2 * Q5**2) + f5**4 * Q5**2)
        / (f**4 * Q6**2 + f**2 * f6**2 * (1 - 2 * Q6**2) + f6**4 * Q6**2)
    )
    return high * low * transition * step


def segment_spectrum(z, ds, size):
    """Return n and the one-sided density: Hann segments, 50 % overlap, linearly detrended."""
    window = np.sin(np.pi * np.arange(size) / size) ** 2
    k = np.arange(size)
    total, count = np.zeros(size // 2), 0
    for start in range(0, len(z) - size + 1, size - size // 2):
        part = z[start : start + size]
        part = part - np.polyval(np.polyfit(k, part, 1), k)
        total += np.abs(np.fft.rfft(window * part)[1 : size // 2 + 1]) ** 2
        count += 1
    scale = 2.0 * ds / (window**2).sum() / count
    G = total * scale
    G[-1] /= 2.0  # the Nyquist line has no negative counterpart
    return np.arange(1, size // 2 + 1) / (size * ds), G


def crg_file(z, form="KRBI", du=0.1, dv=0.5, places=None, road=(), extra=(), eol="\n", start=0.0):
    """Return an OpenCRG file with the grid `z` (nu, nv); `places` are explicit v of sections."""
    nu, nv = z.shape
    lines = ["$CT", "written for a test", "$", "$ROAD_CRG  ! parameters"]
    lines += [
        f"REFERENCE_LINE_START_U = {start}",
        f"reference_line_end_u = {start + du * (nu - 1)!r}",
    ]
    lines += [f"reference_line_increment = {du!r}  ! step"]
    if places is None:
        right = -0.5 * dv * (nv - 1)
        lines += [f"long_section_v_right = {right!r}", f"long_section_v_left = {-right!r}"]
        lines += [f"long_section_v_increment = {dv!r}"]
    lines += [*road, "* a comment", "$", *extra, "$KD_Definition", f"#:{form}"]
    lines += [f"U:reference line u,m,{start:.3f},{du:.3f}"]
    for k in range(nv):
        name = f"{k + 1}" if places is None else f"at v = {places[k]:.3f}"
        lines.append(f"D:long section {name},m  ! from right to left")
    header = eol.join([*lines, "$", "$" * 72, ""]).encode("latin-1")
    return header + (_binary(z, form) if form[0] == "K" else _text(z, form, eol))


def _binary(z, form):
    raw = z.astype(">f4" if form == "KRBI" else ">f8").tobytes()
    nan = np.array([np.nan], ">f4" if form == "KRBI" else ">f8").tobytes()
    return raw + nan * ((-len(raw) % 80) // len(nan))


def _text(z, form, eol):
    width = 10 if form == "LRFI" else 20
    digits = ("{:10.6f}", "{:20.12e}")[form == "LDFI"]
    records = []
    for row in z:
        fields = ["*missing*".rjust(width) if np.isnan(x) else digits.format(x) for x in row]
        per = 80 // width
        records += ["".join(fields[k : k + per]) for k in range(0, len(fields), per)]
    return (eol.join(records) + eol).encode("latin-1")


def half_sine(s, middle, height, length):
    x = s - (middle - 0.5 * length)
    return np.where((x >= 0.0) & (x <= length), height * np.sin(np.pi * x / length), 0.0)


def sweep_height(s, length, n_start, n_end, progress, amplitude, amplitude_end):
    """Return a sine whose phase is the numerical integral of the frequency."""
    share = s / length
    if progress == "linear":
        n = lambda u: n_start + (n_end - n_start) * u / length  # noqa: E731
    else:
        n = lambda u: n_start * (n_end / n_start) ** (u / length)  # noqa: E731
    cycles = quad(n, 0.0, s, limit=500)[0]
    envelope = np.exp((1.0 - share) * np.log(amplitude) + share * np.log(amplitude_end))
    return envelope * np.sin(2.0 * np.pi * cycles)


def erd_file(z, form="text", unit="mm", step=0.025, x_unit="m", names=("LElev.", "RElev."), **how):
    """Return header and numbers of an ERD file with the channels `z` (K, N) in `unit`."""
    eol, samples = how.get("eol", "\n"), how.get("samples", z.shape[1])
    units = unit if isinstance(unit, tuple) else (unit,) * len(z)
    kind = 5 if form == "text" else 1
    lines = [
        "ERDFILEV2.00",
        f"{len(z):7d},{samples:7d},     -1,      1,{kind:7d},{step!r:>12},  -1,",
    ]
    lines += ["TITLE   a section of road: run 1", *how.get("extra", ())]
    if names:
        lines.append("SHORTNAM" + "".join(name.ljust(8) for name in names))
    lines += ["UNITSNAM" + "".join(u.ljust(8) for u in units), f"XUNITS  {x_unit}", "", "END"]
    header = (eol.join(lines) + eol).encode("ascii")
    if form != "text":
        return header, z.T.astype(f"{form}f4").tobytes()
    rows = [" ".join(f"{x:14.7e}" for x in row) for row in z.T]
    return header, (eol.join(rows) + eol).encode("ascii")
