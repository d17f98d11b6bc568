"""One arithmetic for all kept results, whatever the processor: that of x86 with AVX2.

    env $(python -m studies.arithmetic) road-recon leaderboard --board new_road --seeds 2

With AVX-512 the same program sums in another order. That moves most scores by less than 1e-3, but
a drive of a suspension's law that switches at zero by 2 %, and a vehicle's fit now and then to
another optimum; rows of two such machines could not be compared.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import cache

import numpy as np

MACHINE = ("processor", "blas", "python", "numpy")
"""What of `describe_environment` may decide the digits of a row."""

_AVX2 = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+sse,+sse2,+sse3,+ssse3,+sse4.1,+sse4.2,+avx,+avx2,+fma,+bmi,+bmi2,"
    "+lzcnt,+popcnt,+f16c,+cx16,+movbe",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
}
"""Variables by which BLAS, Numba and torch do without the instructions after AVX2."""


def portable() -> dict[str, str]:
    """Return the environment variables for it; none on a processor that has no AVX2."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    if not {"AVX2", "X86_V3"} & {*found}:
        return {}
    later = [name for name in found if name.startswith(("AVX512", "X86_V4"))]
    return _AVX2 | ({"NPY_DISABLE_CPU_FEATURES": ",".join(later)} if later else {})


def environment(native: bool) -> dict[str, str]:
    """Return the environment of a result's commands: `native`, with all that the processor has."""
    return {**os.environ, **({} if native else portable())}


@cache
def describe_machine(native: bool) -> Mapping[str, str]:
    """Return the entries `MACHINE` of what commands in that environment compute with."""
    words = "import json; from leaderboard.evaluation.provenance import describe_environment; "
    words += "print(json.dumps(describe_environment()))"
    command = [sys.executable, "-c", words]
    done = subprocess.run(command, env=environment(native), stdout=subprocess.PIPE, check=True)
    told = json.loads(done.stdout)
    return {key: told[key] for key in MACHINE if key in told}


if __name__ == "__main__":
    print(" ".join(f"{name}={value}" for name, value in portable().items()))
