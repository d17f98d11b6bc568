"""Commands `roads list`, `roads plot`, `roads export`, and `export` of the road of a report."""

from pathlib import Path
from typing import Annotated

import numpy as np

from leaderboard.commands import check_output_path, make_table
from leaderboard.commands.options import Length, Seed, argument, option
from leaderboard.commands.output import Output
from leaderboard.drive_report.export import read_heights
from leaderboard.report import plots
from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.records.roughness import displacement_psd, fit_line, iri, roughness_class, smooth_psd
from road_envs.roads import Surface, load_road, realise_road
from road_envs.roads.formats.write import WRITERS, write, write_crg

_Which = Annotated[str, argument("Shipped name, YAML path or surface file.")]


def list_roads() -> Output:
    """List the shipped roads, each realised with seed 1."""
    rows = [
        _facts(name, load_road(name).realise(np.random.default_rng(1)))
        for name in config.names("roads")
    ]
    pair = "{:.1f}, {:.1f}".format
    cells = [
        (
            x["road"],
            f"{x['length_m']:.1f}",
            pair(*x["rms_mm"]),
            pair(*x["iri_mm_per_m"]),
            x["class"],
        )
        for x in rows
    ]
    heads = ("road", "length [m]", "RMS left, right [mm]", "IRI left, right [mm/m]", "class")
    return Output(facts=rows, shows=[make_table(heads, cells, texts=("class",))])


def plot_road(
    road: _Which,
    out: Annotated[Path, option("Picture to write (.png, .svg or .pdf).")],
    length: Length = None,
    seed: Seed = 1,
) -> Output:
    """Plot both wheel paths of a road, and their PSD over the ISO 8608 classes."""
    check_output_path(out, ".png", ".svg", ".pdf")
    plots.draw_road(realise_road(road, seed, length), out)
    return Output(facts={"written": str(out)})


def export(
    road: _Which,
    out: Annotated[Path, option("File to write (.csv, .parquet, .crg or .erd).")],
    length: Length = None,
    seed: Seed = 1,
    form: Annotated[str | None, option("Format of a .crg file: KDBI, KRBI, LDFI or LRFI.")] = None,
) -> Output:
    """Write both wheel paths of a road to a file that can be read back as a road."""
    check_output_path(out, *WRITERS)
    if form and out.suffix.lower() != ".crg":
        raise ConfigError(f"{out}: --form is for .crg files only; leave it out")
    return _written(realise_road(road, seed, length), out, form)


def export_heights(
    heights: Annotated[Path, argument("NAME_heights.parquet of a report.")],
    out: Annotated[Path, option("Road: .erd for ProVAL, .crg for simulators, .csv.")],
) -> Output:
    """Write the road that a report found as a surface for other programs.

    The own vehicle over it moves as in the drive: `simulate --road` takes it, too.
    """
    check_output_path(out, *WRITERS)
    return _written(read_heights(heights), out)


def _written(surface: Surface, out: Path, form: str | None = None) -> Output:
    """Write a road, of which a .crg file can have a `form`, and return what was written."""
    if form:
        write_crg(surface, out, form)
    else:
        write(surface, out)
    return Output(facts={"written": str(out), "length_m": surface.length, "spacing_m": surface.ds})


def _facts(name: str, surface: Surface) -> dict:
    n, G_d = smooth_psd(*displacement_psd(surface.z, surface.ds))
    letters = [roughness_class(fit_line(n, G, w=2.0)[0]) if G.max() > 0 else "-" for G in G_d]
    return {
        "road": name,
        "length_m": surface.length,
        "rms_mm": [1000.0 * float(z.std()) for z in surface.z],
        "iri_mm_per_m": [float(iri(z, surface.ds)) for z in surface.z],
        "class": "".join(sorted(set(letters))),
        "notes": list(surface.notes),
    }
