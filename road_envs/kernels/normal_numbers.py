"""Standard normal numbers in kernels: those that NumPy draws with PCG64 from the same state.

PCG64 permutes the state of a linear congruential generator of 128 bits to 64 (O'Neill 2014, "PCG",
Harvey Mudd College, HMC-CS-2014-0905: XSL-RR). The ziggurat (Marsaglia & Tsang 2000, J. Stat.
Softw. 5(8)) takes 8 of them for the layer, one for the sign and 52 for the place in it. Inlined it
takes a third of the time of a call of `Generator.standard_normal`.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from road_envs.kernels._numba import kernel, ziggurat
from road_envs.kernels.simd import intrinsic

MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645  # `PCG_DEFAULT_MULTIPLIER_128`
DENSITIES = ziggurat.fi_double  # of the normal distribution at the edges of the 256 layers
WIDTHS = np.append(ziggurat.wi_double, -ziggurat.wi_double)
LIMITS = np.tile(ziggurat.ki_double.astype(np.int64), 2)
"""Of the layers, for both signs: width per unit of the 52 bits, and the greatest place at which a
number is accepted without looking at the density."""

TAIL, INVERSE_TAIL = ziggurat.ziggurat_nor_r, ziggurat.ziggurat_nor_inv_r
LAYER_BITS, SIGNED_LAYER_BITS, PLACE_SHIFT, PLACE_BITS = 0xFF, 0x1FF, 9, (1 << 52) - 1


def generator_state(rng: np.random.Generator) -> np.ndarray:
    """Return the state (4,) uint64 of a generator: high and low half, increment high and low.

    A generator of another kind than PCG64 gets the PCG64 of its seed.
    """
    bits: Any = rng.bit_generator
    if not isinstance(bits, np.random.PCG64):
        bits = np.random.PCG64(bits.seed_seq)
    state = bits.state["state"]
    halves = [divmod(state[name], 1 << 64) for name in ("state", "inc")]
    return np.array(halves, dtype=np.uint64).ravel()


@intrinsic
def _next_bits(context, high, low, inc_high, inc_low):
    """Return the next state (high, low) of PCG64, and its 64 random bits as an int64."""

    def generate(context, builder, signature, values):
        wide, word = ir.IntType(128), ir.IntType(64)

        def joined(high, low):
            shifted = builder.shl(builder.zext(high, wide), wide(64))
            return builder.or_(shifted, builder.zext(low, wide))

        state = builder.mul(joined(*values[:2]), wide(MULTIPLIER))
        state = builder.add(state, joined(*values[2:]))
        high, low = builder.trunc(builder.lshr(state, wide(64)), word), builder.trunc(state, word)
        folded, by = builder.xor(high, low), builder.lshr(high, word(58))
        left = builder.and_(builder.neg(by), word(63))
        bits = builder.or_(builder.lshr(folded, by), builder.shl(folded, left))
        return context.make_tuple(builder, signature.return_type, [high, low, bits])

    kinds = types.Tuple((types.uint64, types.uint64, types.int64))
    return kinds(*[types.uint64] * 4), generate


@kernel
def _uniform(bits):
    """Return the number in [0, 1) of 64 random bits."""
    return ((bits >> 11) & ((1 << 53) - 1)) * (1.0 / (1 << 53))


@kernel(inline=False)
def _draw_outside(state, k, bits):
    """Return lane `k`'s number if its `bits` are not inside their layer; advance its `state`."""
    high, low, inc_high, inc_low = state[0, k], state[1, k], state[2, k], state[3, k]
    accepted, x = False, 0.0
    while not accepted:
        layer, place = bits & SIGNED_LAYER_BITS, (bits >> PLACE_SHIFT) & PLACE_BITS
        x, accepted = place * WIDTHS[layer], place < LIMITS[layer]
        if not accepted and layer & LAYER_BITS > 0:
            high, low, bits = _next_bits(high, low, inc_high, inc_low)
            below, above = DENSITIES[layer & LAYER_BITS], DENSITIES[(layer & LAYER_BITS) - 1]
            accepted = below + (above - below) * _uniform(bits) < np.exp(-0.5 * x * x)
        while not accepted and layer & LAYER_BITS == 0:  # Marsaglia's method for the tail
            high, low, bits = _next_bits(high, low, inc_high, inc_low)
            x = -INVERSE_TAIL * np.log1p(-_uniform(bits))
            high, low, bits = _next_bits(high, low, inc_high, inc_low)
            y = -np.log1p(-_uniform(bits))
            accepted = y + y > x * x
            x = (-1.0 if (place >> 8) & 1 else 1.0) * (TAIL + x)
        if not accepted:
            high, low, bits = _next_bits(high, low, inc_high, inc_low)
    state[0, k], state[1, k] = high, low
    return x


@kernel
def fill_normal(state, lanes, out):
    """Fill the first `lanes` of `out` (rows, n, LANES) with standard normal numbers, rows first.

    `state` (4, LANES) of `generator_state` is advanced. Lanes take turns: each waits for its last.
    """
    for i in range(out.shape[1]):
        for j in range(out.shape[0]):
            for k in range(lanes):
                high, low, bits = _next_bits(state[0, k], state[1, k], state[2, k], state[3, k])
                state[0, k], state[1, k] = high, low
                layer, place = bits & SIGNED_LAYER_BITS, (bits >> PLACE_SHIFT) & PLACE_BITS
                out[j, i, k] = place * WIDTHS[layer]
                if place >= LIMITS[layer]:
                    out[j, i, k] = _draw_outside(state, k, bits)
