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

TILE = 72
"""Cases side by side. Rows a power of two apart would fall on each other in the first-level cache."""

CHUNK = 5
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
    """Sums for the states, which are computed in pairs; those of both accelerometers follow."""
    return states + states % 2


def terms_of(states: int) -> int:
    """Terms of every sum for a plant of so many states, padding included."""
    return max(2, -(-(states + INPUTS) // CHUNK)) * CHUNK


@kernel
def _sums(coefficients: Array, z: Array, out: Array, first: int, last: int, terms: int) -> None:
    """Rows ``first`` to ``last`` of the coefficients times z, lane by lane, two rows for each time z is loaded."""
    for i in range(first, last, 2):
        row = coefficients[i * terms * TILE : (i + 1) * terms * TILE]
        next_row = coefficients[(i + 1) * terms * TILE : (i + 2) * terms * TILE]
        into = out[i * TILE : (i + 2) * TILE]
        for c in range(TILE):
            into[c] = (
                row[c] * z[c]
                + row[TILE + c] * z[TILE + c]
                + row[2 * TILE + c] * z[2 * TILE + c]
                + row[3 * TILE + c] * z[3 * TILE + c]
                + row[4 * TILE + c] * z[4 * TILE + c]
                + row[5 * TILE + c] * z[5 * TILE + c]
                + row[6 * TILE + c] * z[6 * TILE + c]
                + row[7 * TILE + c] * z[7 * TILE + c]
                + row[8 * TILE + c] * z[8 * TILE + c]
                + row[9 * TILE + c] * z[9 * TILE + c]
            )
            into[TILE + c] = (
                next_row[c] * z[c]
                + next_row[TILE + c] * z[TILE + c]
                + next_row[2 * TILE + c] * z[2 * TILE + c]
                + next_row[3 * TILE + c] * z[3 * TILE + c]
                + next_row[4 * TILE + c] * z[4 * TILE + c]
                + next_row[5 * TILE + c] * z[5 * TILE + c]
                + next_row[6 * TILE + c] * z[6 * TILE + c]
                + next_row[7 * TILE + c] * z[7 * TILE + c]
                + next_row[8 * TILE + c] * z[8 * TILE + c]
                + next_row[9 * TILE + c] * z[9 * TILE + c]
            )
        for j in range(2 * CHUNK, terms, CHUNK):
            more, next_more = row[j * TILE : (j + CHUNK) * TILE], next_row[j * TILE : (j + CHUNK) * TILE]
            rest = z[j * TILE : (j + CHUNK) * TILE]
            for c in range(TILE):
                into[c] += (
                    more[c] * rest[c]
                    + more[TILE + c] * rest[TILE + c]
                    + more[2 * TILE + c] * rest[2 * TILE + c]
                    + more[3 * TILE + c] * rest[3 * TILE + c]
                    + more[4 * TILE + c] * rest[4 * TILE + c]
                )
                into[TILE + c] += (
                    next_more[c] * rest[c]
                    + next_more[TILE + c] * rest[TILE + c]
                    + next_more[2 * TILE + c] * rest[2 * TILE + c]
                    + next_more[3 * TILE + c] * rest[3 * TILE + c]
                    + next_more[4 * TILE + c] * rest[4 * TILE + c]
                )


@kernel
def _show(sums: Array, noise: Array, limit: Array, weight: Array, memory: Array, first: bool) -> None:
    """Add what one accelerometer shows to the relative acceleration; no noise where the array has no entries."""
    if len(noise) > 0:
        for c in range(TILE):
            sums[c] += noise[c]
    if first:
        for c in range(TILE):
            memory[ACCELERATION + c] = weight[c] * min(max(sums[c], -limit[c]), limit[c])
    else:
        for c in range(TILE):
            memory[ACCELERATION + c] += weight[c] * min(max(sums[c], -limit[c]), limit[c])


@kernel
def _cutoffs(memory: Array, begin: Array, end: Array, w: float, dt: float) -> None:
    """Coefficients of the filter chain a share ``w`` of the way through a span."""
    for c in range(TILE):
        g_low = begin[3 * TILE + c] + w * (end[3 * TILE + c] - begin[3 * TILE + c])
        g_high = begin[4 * TILE + c] + w * (end[4 * TILE + c] - begin[4 * TILE + c])
        memory[G_LOW + c] = g_low
        memory[D_LOW + c] = 1.0 / (1.0 + g_low * (g_low + SQRT2))
        memory[G_HIGH + c] = g_high
        memory[D_HIGH + c] = 1.0 / (1.0 + g_high * (g_high + SQRT2))
        memory[SCALE + c] = dt / (2.0 * g_high)


@kernel
def _law(memory: Array, begin: Array, end: Array, clamp: Array, stroke: Array, w: float) -> None:
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
            (begin[c] + w * (end[c] - begin[c])) * memory[ACCELERATION + c]
            + (begin[TILE + c] + w * (end[TILE + c] - begin[TILE + c])) * memory[SPEED + c]
            + (begin[2 * TILE + c] + w * (end[2 * TILE + c] - begin[2 * TILE + c])) * memory[STROKE + c]
        )
        bounded = min(max(command, -clamp[c]), clamp[c])
        # Gains beyond all measure make inf - inf: what is no number must not reach the converter.
        bounded = bounded if command == command else 0.0  # noqa: PLR0124
        memory[COMMAND + c] = bounded if memory[ACTING + c] > 0.0 else 0.0
        stroke[c] = max(stroke[c], abs(memory[STROKE + c]))


@kernel
def _gather(z: Array, held: Array, memory: Array, figures: Array, places: Whole, constants: Array) -> None:
    """Add a sample to the figures of a span."""
    x, i = z[places[0] * TILE : (places[0] + 1) * TILE], z[places[5] * TILE : (places[5] + 1) * TILE]
    end, end_v = z[places[1] * TILE : (places[1] + 1) * TILE], z[places[2] * TILE : (places[2] + 1) * TILE]
    if places[3] >= 0:
        base, base_v = (
            z[places[3] * TILE : (places[3] + 1) * TILE],
            z[places[4] * TILE : (places[4] + 1) * TILE],
        )
        for c in range(TILE):
            memory[STROKE + c] = end[c] - base[c]
        for c in range(TILE):
            memory[SPEED + c] = end_v[c] - base_v[c]
    else:
        for c in range(TILE):
            memory[STROKE + c] = end[c]
        for c in range(TILE):
            memory[SPEED + c] = end_v[c]
    force = constants[FORCE_CONSTANT]
    clamp = constants[CLAMP]
    for c in range(TILE):
        figures[X_PEAK * TILE + c] = max(figures[X_PEAK * TILE + c], abs(x[c]))
        figures[STROKE_PEAK * TILE + c] = max(figures[STROKE_PEAK * TILE + c], abs(memory[STROKE + c]))
        figures[CURRENT_PEAK * TILE + c] = max(figures[CURRENT_PEAK * TILE + c], abs(i[c]))
        figures[CURRENT_SQUARES * TILE + c] += i[c] * i[c]
        figures[MOTION_WORK * TILE + c] += force[c] * i[c] * memory[SPEED + c]
    for c in range(TILE):
        figures[SATURATED * TILE + c] += 1.0 if abs(held[c]) >= clamp[c] else 0.0


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
        (Q, (rows_of(n) + 2) * terms * TILE) discrete plants at Q values of the absorber's damping: for each state and
        both accelerometers the factors of states, last and present command, last and present excitation.
    weights
        (S, Q, TILE) share of each of them in a span.
    gains
        (S, 2, 5 * TILE) alpha/k, beta/k, gamma/k and tan(pi f dt) of both cutoffs at the ends of each span.
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
    current = z[places[5] * TILE : (places[5] + 1) * TILE]
    last, present = z[n * TILE : (n + 1) * TILE], z[(n + 1) * TILE : (n + 2) * TILE]
    before, now = z[(n + 2) * TILE : (n + 3) * TILE], z[(n + 3) * TILE : (n + 4) * TILE]
    rows = n + n % 2
    sums = np.zeros((rows + 2) * TILE)
    first_sum, second_sum = sums[rows * TILE : (rows + 1) * TILE], sums[(rows + 1) * TILE :]
    amplitude, quiet = constants[AMPLITUDE], np.empty(0)
    heating, stroke, tripped = guard[window], guard[window + 1], guard[window + 2]
    for s in range(len(spans)):
        begin, end = int(spans[s, 0]), int(spans[s, 1])
        for r in range((rows + 2) * terms):
            into = blended[r * TILE : (r + 1) * TILE]
            into[:] = 0.0
            for q in range(len(coefficients)):
                node = coefficients[q, r * TILE : (r + 1) * TILE]
                for c in range(TILE):
                    into[c] += weights[s, q, c] * node[c]
        out, from_gains, to_gains = figures[s], gains[s, 0], gains[s, 1]
        moving = False
        for c in range(3 * TILE, 5 * TILE):
            moving |= from_gains[c] != to_gains[c]
        out[:] = 0.0
        for c in range(TILE):
            memory[ACTING + c] = acts[s, c] if tripped[c] < 0.0 else 0.0
            out[CONTROLLED * TILE + c] = memory[ACTING + c]
            out[STORED * TILE + c] = -0.5 * constants[INDUCTANCE, c] * current[c] ** 2
        for k in range(begin, end):
            w = (k - begin) / (end - begin)
            for c in range(TILE):
                present[c] = line[head, c]  # computed as many samples ago as the delay is long
            for c in range(TILE):
                before[c] = amplitude[c] * shape[k]
            for c in range(TILE):
                now[c] = amplitude[c] * shape[k + 1]
            _sums(blended, z, sums, 0, rows, terms)
            for c in range(n * TILE):
                z[c] = sums[c]
            for c in range(TILE):
                last[c] = present[c]
            _sums(blended, z, sums, rows, rows + 2, terms)
            _show(
                first_sum, noise[k - origin, 0] if len(noise) > 0 else quiet, constants[RANGE_1],
                constants[WEIGHT_1], memory, True,
            )  # fmt: skip
            _show(
                second_sum, noise[k - origin, 1] if len(noise) > 0 else quiet, constants[RANGE_2],
                constants[WEIGHT_2], memory, False,
            )  # fmt: skip
            if moving or k == begin:
                _cutoffs(memory, from_gains, to_gains, w, dt)
            _law(memory, from_gains, to_gains, constants[CLAMP], stroke, w)
            for c in range(TILE):
                heating[c] += present[c] * present[c]
            for c in range(TILE):
                slot = head + delays[c]
                line[slot if slot < longest else slot - longest, c] = memory[COMMAND + c]
            head = head + 1 if head + 1 < longest else 0
            _gather(z, present, memory, out, places, constants)
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
