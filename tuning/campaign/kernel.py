"""Plant and controller of many cases at once: `twin.control.rig_block` over a tile of cases.

Every number of a case lies in a lane of its own, ``[..., TILE]``, and the innermost loops go over the lanes: the
compiler makes vector instructions of them. Lanes never mix, and the compiler may not reorder a sum, so that a case
gives the same bits in whatever company it is computed.

State is kept in flat arrays in which the rows of a tile lie a constant ``TILE`` apart. Only then can the compiler see
that rows do not overlap; with the rows' distance in a variable it falls back on one case at a time, four times slower.
"""

import numpy as np
from numpy.typing import NDArray

from twin.control.chain import SQRT2
from twin.plant.compiled import kernel
from twin.plant.linear import Array

Whole = NDArray[np.int64]

TILE = 32
"""Cases side by side. Rows a power of two apart would fall on each other in the first-level cache."""

TOGETHER = 4
"""Sums computed at once."""

CHUNK, FEWEST = 5, 10
"""Terms of a sum are padded with zeros to whole chunks, at least two of them."""

INPUTS = 4
"""Beside the states: last and present command of the coil, last and present excitation."""

FIGURES = 8
(X_PEAK, STROKE_PEAK, CURRENT_PEAK, CURRENT_SQUARES, MOTION_WORK, STORED, SATURATED, CONTROLLED) = range(
    FIGURES
)
"""Rows of the figures of a span: largest |x1| and |x_r| [m] and |i| [A], sum of i² [A²], sum of k i (x2' - x1') [W],
L/2 (i_end² - i_before²) [J], samples with the reference at its clamp, and whether control acted."""

POWER_WINDOW_BLOCKS = 10

(
    A_LOW,
    B_LOW,
    A_VELOCITY,
    B_VELOCITY,
    A_POSITION,
    B_POSITION,
    ACCELERATION,
    COMMAND,
    ACTING,
    STROKE,
    SPEED,
) = (row * TILE for row in range(11))
(G_LOW, D_LOW, G_HIGH, D_HIGH, SCALE) = (row * TILE for row in range(11, 16))
MEMORY = 16 * TILE
"""Rows of a tile's memory: states of the filter chain, what is computed on the way, the chain's coefficients."""

(
    AMPLITUDE,
    CLAMP,
    RANGE_1,
    WEIGHT_1,
    RANGE_2,
    WEIGHT_2,
    FORCE_CONSTANT,
    INDUCTANCE,
    MOST_STROKE,
    MOST_HEATING,
) = range(10)
"""Rows of a tile's constants: see `run_spans`."""


def rows_of(states: int) -> int:
    """Sums for the states and both accelerometers, padded to a whole number of those computed at once."""
    return -(-(states + 2) // TOGETHER) * TOGETHER


def terms_of(states: int) -> int:
    """Terms of every sum for a plant of so many states, padding included."""
    return max(FEWEST, -(-(states + INPUTS) // CHUNK) * CHUNK)


def in_order(factors: Array) -> Array:
    """Factors (rows, terms) in the order in which `run_spans` takes them: first terms of all rows, then chunks."""
    parts = [factors[:, :FEWEST]] + [
        factors[:, j : j + CHUNK] for j in range(FEWEST, factors.shape[1], CHUNK)
    ]
    return np.concatenate([part.ravel() for part in parts])


@kernel
def _sums(coefficients: Array, z: Array, out: Array, rows: int, terms: int) -> None:
    """Coefficients times z, lane by lane, four rows for each time z is loaded."""
    for i in range(0, rows, TOGETHER):
        block = coefficients[i * FEWEST * TILE : (i + TOGETHER) * FEWEST * TILE]
        into = out[i * TILE : (i + TOGETHER) * TILE]
        for c in range(TILE):
            # Read once: the compiler does not know that what is written is not z.
            z0 = z[c]
            z1 = z[TILE + c]
            z2 = z[2 * TILE + c]
            z3 = z[3 * TILE + c]
            z4 = z[4 * TILE + c]
            z5 = z[5 * TILE + c]
            z6 = z[6 * TILE + c]
            z7 = z[7 * TILE + c]
            z8 = z[8 * TILE + c]
            z9 = z[9 * TILE + c]
            into[c] = (
                block[c] * z0
                + block[TILE + c] * z1
                + block[2 * TILE + c] * z2
                + block[3 * TILE + c] * z3
                + block[4 * TILE + c] * z4
                + block[5 * TILE + c] * z5
                + block[6 * TILE + c] * z6
                + block[7 * TILE + c] * z7
                + block[8 * TILE + c] * z8
                + block[9 * TILE + c] * z9
            )
            into[TILE + c] = (
                block[10 * TILE + c] * z0
                + block[11 * TILE + c] * z1
                + block[12 * TILE + c] * z2
                + block[13 * TILE + c] * z3
                + block[14 * TILE + c] * z4
                + block[15 * TILE + c] * z5
                + block[16 * TILE + c] * z6
                + block[17 * TILE + c] * z7
                + block[18 * TILE + c] * z8
                + block[19 * TILE + c] * z9
            )
            into[2 * TILE + c] = (
                block[20 * TILE + c] * z0
                + block[21 * TILE + c] * z1
                + block[22 * TILE + c] * z2
                + block[23 * TILE + c] * z3
                + block[24 * TILE + c] * z4
                + block[25 * TILE + c] * z5
                + block[26 * TILE + c] * z6
                + block[27 * TILE + c] * z7
                + block[28 * TILE + c] * z8
                + block[29 * TILE + c] * z9
            )
            into[3 * TILE + c] = (
                block[30 * TILE + c] * z0
                + block[31 * TILE + c] * z1
                + block[32 * TILE + c] * z2
                + block[33 * TILE + c] * z3
                + block[34 * TILE + c] * z4
                + block[35 * TILE + c] * z5
                + block[36 * TILE + c] * z6
                + block[37 * TILE + c] * z7
                + block[38 * TILE + c] * z8
                + block[39 * TILE + c] * z9
            )
    # Larger plants have more terms; their coefficients follow those of the first.
    for j in range(FEWEST, terms, CHUNK):
        rest = z[j * TILE : (j + CHUNK) * TILE]
        for i in range(rows):
            block = coefficients[(j * rows + i * CHUNK) * TILE : (j * rows + (i + 1) * CHUNK) * TILE]
            into = out[i * TILE : (i + 1) * TILE]
            for c in range(TILE):
                into[c] += (
                    block[c] * rest[c]
                    + block[TILE + c] * rest[TILE + c]
                    + block[2 * TILE + c] * rest[2 * TILE + c]
                    + block[3 * TILE + c] * rest[3 * TILE + c]
                    + block[4 * TILE + c] * rest[4 * TILE + c]
                )


@kernel
def _show(sums: Array, noise: Array, constants: Array, memory: Array) -> None:
    """Relative acceleration of what both accelerometers show; no noise where the array has no entries."""
    low, high = sums[:TILE], sums[TILE : 2 * TILE]
    if len(noise) > 0:
        for c in range(TILE):
            low[c] += noise[0, c]
        for c in range(TILE):
            high[c] += noise[1, c]
    first, second = constants[RANGE_1], constants[RANGE_2]
    weight, other = constants[WEIGHT_1], constants[WEIGHT_2]
    for c in range(TILE):
        memory[ACCELERATION + c] = weight[c] * min(max(low[c], -first[c]), first[c]) + other[c] * min(
            max(high[c], -second[c]), second[c]
        )


@kernel
def _cutoffs(memory: Array, begin: Array, change: Array, w: float, dt: float, alike: bool) -> None:
    """Coefficients of the filter chain a share ``w`` of the way through a span, once for all if they are alike."""
    count = 1 if alike else TILE
    for c in range(count):
        g_low = begin[3 * TILE + c] + w * change[3 * TILE + c]
        g_high = begin[4 * TILE + c] + w * change[4 * TILE + c]
        memory[G_LOW + c] = g_low
        memory[D_LOW + c] = 1.0 / (1.0 + g_low * (g_low + SQRT2))
        memory[G_HIGH + c] = g_high
        memory[D_HIGH + c] = 1.0 / (1.0 + g_high * (g_high + SQRT2))
        memory[SCALE + c] = dt / (2.0 * g_high)
    if alike:
        for row in range(G_LOW, SCALE + 1, TILE):
            memory[row : row + TILE] = memory[row]


@kernel
def _law(memory: Array, begin: Array, change: Array, clamp: Array, stroke: Array, w: float) -> None:
    """Filter chain, gains and clamp, as `twin.control.chain.chain_step` and `twin.control.rig_block`."""
    # In stages: a chain of operations that wait for each other is short enough for several lanes to overlap.
    for c in range(TILE):
        g_low = memory[G_LOW + c]
        band = (memory[A_LOW + c] + g_low * (memory[ACCELERATION + c] - memory[B_LOW + c])) * memory[
            D_LOW + c
        ]
        a = memory[B_LOW + c] + g_low * band
        memory[A_LOW + c] = 2.0 * band - memory[A_LOW + c]
        memory[B_LOW + c] = 2.0 * a - memory[B_LOW + c]
        memory[ACCELERATION + c] = a
    for c in range(TILE):
        g_high = memory[G_HIGH + c]
        band = (
            memory[A_VELOCITY + c] + g_high * (memory[ACCELERATION + c] - memory[B_VELOCITY + c])
        ) * memory[D_HIGH + c]
        low = memory[B_VELOCITY + c] + g_high * band
        memory[A_VELOCITY + c] = 2.0 * band - memory[A_VELOCITY + c]
        memory[B_VELOCITY + c] = 2.0 * low - memory[B_VELOCITY + c]
        memory[SPEED + c] = memory[SCALE + c] * band
    for c in range(TILE):
        g_high = memory[G_HIGH + c]
        band = (memory[A_POSITION + c] + g_high * (memory[SPEED + c] - memory[B_POSITION + c])) * memory[
            D_HIGH + c
        ]
        low = memory[B_POSITION + c] + g_high * band
        memory[A_POSITION + c] = 2.0 * band - memory[A_POSITION + c]
        memory[B_POSITION + c] = 2.0 * low - memory[B_POSITION + c]
        memory[STROKE + c] = memory[SCALE + c] * band
    for c in range(TILE):
        command = (
            (begin[c] + w * change[c]) * memory[ACCELERATION + c]
            + (begin[TILE + c] + w * change[TILE + c]) * memory[SPEED + c]
            + (begin[2 * TILE + c] + w * change[2 * TILE + c]) * memory[STROKE + c]
        )
        bounded = min(max(command, -clamp[c]), clamp[c])
        # Gains beyond all measure make inf - inf: what is no number must not reach the converter.
        bounded = bounded if command == command else 0.0  # noqa: PLR0124
        memory[COMMAND + c] = bounded if memory[ACTING + c] > 0.0 else 0.0
        stroke[c] = max(stroke[c] + 0.0, abs(memory[STROKE + c]))


@kernel
def _gather(
    z: Array, held: Array, figures: Array, heating: Array, places: Whole, constants: Array, grounded: bool
) -> None:
    """Add a sample to the figures of a span."""
    x, i = _lanes(z, places[0]), _lanes(z, places[5])
    end, end_v = _lanes(z, places[1]), _lanes(z, places[2])
    base, base_v = (end, end_v) if grounded else (_lanes(z, places[3]), _lanes(z, places[4]))
    stands = 0.0 if grounded else 1.0
    force, clamp = constants[FORCE_CONSTANT], constants[CLAMP]
    # The added zero keeps what is written from being what was read: the compiler would store only where it differs,
    # lane by lane.
    for c in range(TILE):
        figures[X_PEAK * TILE + c] = max(figures[X_PEAK * TILE + c] + 0.0, abs(x[c]))
        figures[CURRENT_PEAK * TILE + c] = max(figures[CURRENT_PEAK * TILE + c] + 0.0, abs(i[c]))
        figures[CURRENT_SQUARES * TILE + c] += i[c] * i[c]
        figures[SATURATED * TILE + c] += 1.0 if abs(held[c]) >= clamp[c] else 0.0
    for c in range(TILE):
        heating[c] += held[c] * held[c]
        stroke = abs(end[c] - stands * base[c])
        figures[STROKE_PEAK * TILE + c] = max(figures[STROKE_PEAK * TILE + c] + 0.0, stroke)
        figures[MOTION_WORK * TILE + c] += force[c] * i[c] * (end_v[c] - stands * base_v[c])


@kernel
def _lanes(rows: Array, row: int) -> Array:
    """One row of a flat array."""
    return rows[row * TILE : (row + 1) * TILE]


@kernel
def run_spans(
    coefficients: Array,
    weights: Array,
    gains: Array,
    acts: Array,
    spans: Array,
    shape: Array,
    noise: Array,
    constants: Array,
    places: Whole,
    delays: Whole,
    blended: Array,
    z: Array,
    memory: Array,
    line: Array,
    guard: Array,
    counters: Array,
    figures: Array,
    dt: float,
    n: int,
    terms: int,
) -> None:
    """Run a tile of cases through some spans of the excitation, in place.

    Parameters
    ----------
    coefficients
        (Q, rows_of(n) * terms * TILE) discrete plants at Q values of the absorber's damping, `in_order`: for each state
        and accelerometer the factors of states, last and present command, last and present excitation.
    weights
        (S, Q, TILE) share of each of them in a span.
    gains
        (S, 2, 5 * TILE) alpha/k, beta/k, gamma/k and tan(pi f dt) of both cutoffs where a span begins, and their change
    acts
        (S, TILE) 1 where the schedule acts.
    spans
        (S, 3) first sample, sample after the last, and 1 where a block of the rig ends with the span; whole numbers.
    shape
        (N + 1,) excitation of amplitude 1; before its first sample comes a zero.
    noise
        (samples of these spans, 2, TILE) of both accelerometers; no rows for none.
    constants
        (10, TILE) amplitude of the excitation, clamp [A], range and weight of the first accelerometer, range and
        weight of the second, the coil's k [N/A], L [H], and what the rig switches off at: stroke [m] and, over R,
        mean power [A²].
    places
        (6,) states: x1, x and v at the coil's second end, x and v at its first (-1 where that is the ground), and the
        coil's current.
    delays
        (TILE,) samples between a command and the converter, at least 1.
    blended, z, memory, line, guard, counters
        Work and state: one plant's coefficients; (terms * TILE,) states and inputs; (MEMORY,); (longest delay, TILE);
        (POWER_WINDOW_BLOCKS + 3, TILE) heating of the latest blocks, sum of squares and largest filtered stroke of the
        present block, and the sample at which the rig tripped or -1; (3,) place in the delay line, blocks done,
        samples of the present block.
    figures
        (S, FIGURES * TILE) receives the figures.
    n, terms
        States of the plant, and `terms_of` them.
    """
    longest, window = len(line), POWER_WINDOW_BLOCKS
    origin = int(spans[0, 0])
    head, blocks, in_block = int(counters[0]), int(counters[1]), int(counters[2])
    rows = len(blended) // (terms * TILE)
    x, inputs = z, z[n * TILE : (n + INPUTS) * TILE]
    sums = np.zeros(rows * TILE)
    amplitude, quiet = constants[AMPLITUDE], np.empty((0, TILE))
    heating, stroke, tripped = guard[window], guard[window + 1], guard[window + 2]
    grounded, current = places[3] < 0, _lanes(x, places[5])
    together = True
    for c in range(TILE):
        together &= delays[c] == delays[0]
    for s in range(len(spans)):
        begin, end = int(spans[s, 0]), int(spans[s, 1])
        for r in range(rows * terms):
            into = _lanes(blended, r)
            into[:] = 0.0
            for q in range(len(coefficients)):
                node = coefficients[q, r * TILE : (r + 1) * TILE]
                for c in range(TILE):
                    into[c] += weights[s, q, c] * node[c]
        out, from_gains, change = figures[s], gains[s, 0], gains[s, 1]
        moving, alike = False, True
        for row in (3, 4):
            for c in range(row * TILE, (row + 1) * TILE):
                moving |= change[c] != 0.0
                alike &= from_gains[c] == from_gains[row * TILE] and change[c] == change[row * TILE]
        out[:] = 0.0
        for c in range(TILE):
            memory[ACTING + c] = acts[s, c] if tripped[c] < 0.0 else 0.0
            out[CONTROLLED * TILE + c] = memory[ACTING + c]
            out[STORED * TILE + c] = -0.5 * constants[INDUCTANCE, c] * current[c] ** 2
        for k in range(begin, end):
            w = (k - begin) / (end - begin)
            held = line[head]  # computed as many samples ago as the delay is long
            for c in range(TILE):
                inputs[c] = inputs[TILE + c]
                inputs[2 * TILE + c] = amplitude[c] * shape[k]
                inputs[3 * TILE + c] = amplitude[c] * shape[k + 1]
            for c in range(TILE):
                inputs[TILE + c] = held[c]
            _sums(blended, x, sums, rows, terms)
            for c in range(n * TILE):
                x[c] = sums[c]
            _show(sums[n * TILE :], noise[k - origin] if len(noise) > 0 else quiet, constants, memory)
            if moving or k == begin:
                _cutoffs(memory, from_gains, change, w, dt, alike)
            _law(memory, from_gains, change, constants[CLAMP], stroke, w)
            _gather(x, held, out, heating, places, constants, grounded)
            if together:
                slot = head + delays[0]
                into = line[slot if slot < longest else slot - longest]
                for c in range(TILE):
                    into[c] = memory[COMMAND + c]
            else:
                for c in range(TILE):
                    slot = head + delays[c]
                    line[slot if slot < longest else slot - longest, c] = memory[COMMAND + c]
            head = head + 1 if head + 1 < longest else 0
        in_block += end - begin
        for c in range(TILE):
            out[STORED * TILE + c] += 0.5 * constants[INDUCTANCE, c] * current[c] ** 2
        if spans[s, 2] > 0.0:
            kept = min(blocks + 1, window)
            for c in range(TILE):
                guard[blocks % window, c] = heating[c] / in_block
                total = 0.0
                for b in range(kept):
                    total += guard[b, c]
                calm = stroke[c] <= constants[MOST_STROKE, c] and total / kept <= constants[MOST_HEATING, c]
                if not calm and tripped[c] < 0.0:
                    tripped[c] = end
            heating[:] = 0.0
            stroke[:] = 0.0
            blocks, in_block = blocks + 1, 0
    counters[0], counters[1], counters[2] = head, blocks, in_block
