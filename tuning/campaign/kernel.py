"""Plant and controller of many cases at once: `twin.control.rig_block` over a tile of cases.

Every number of a case lies in a lane of its own, ``[..., TILE]``, and the innermost loops go over the lanes: the
compiler makes vector instructions of them. Lanes never mix, and the compiler may not reorder a sum, so that a case
gives the same bits in whatever company it is computed.
"""

import math

from twin.control.chain import SQRT2
from twin.plant.compiled import kernel
from twin.plant.linear import Array

TILE = 64
"""Cases side by side: coefficients and states of a tile stay in the second-level cache."""

CHUNK = 6
"""States that one line of the recursion takes in; a plant's states are padded with zeros to whole chunks."""

FIGURES = 8
(X_PEAK, STROKE_PEAK, CURRENT_PEAK, CURRENT_SQUARES, MOTION_WORK, STORED, SATURATED, CONTROLLED) = range(FIGURES)
"""Rows of the figures of a span: largest |x1| and |x_r| [m] and |i| [A], sum of i² [A²], sum of k i (x2' - x1') [W],
L/2 (i_end² - i_before²) [J], samples with the reference at its clamp, and whether control acted."""

POWER_WINDOW_BLOCKS = 10


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
    places: Array,
    delays: Array,
    blended: Array,
    x: Array,
    memory: Array,
    line: Array,
    guard: Array,
    counters: Array,
    figures: Array,
    dt: float,
    n: int,
) -> None:
    """Run a tile of cases through some spans of the excitation, in place.

    Parameters
    ----------
    coefficients
        (Q, R, TILE) discrete plants at Q values of the absorber's damping, R rows: F (n, padded), then for each
        state what the last and the present command of the coil and the last and present excitation do (n, 4), then
        C of both accelerometers (2, padded) and their feed-through of the excitation (2).
    weights
        (S, Q, TILE) share of each of them in a span.
    gains
        (S, 2, 5, TILE) alpha/k, beta/k, gamma/k and tan(pi f dt) of both cutoffs at the ends of each span.
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
    blended, x, memory, line, guard, counters
        Work and state: (R, TILE), (2, padded, TILE), (18, TILE), (longest delay, TILE),
        (POWER_WINDOW_BLOCKS + 3, TILE): heating of the latest blocks, then sum of squares and largest filtered
        stroke of the present block, then the sample at which the rig tripped or -1; (3,) place in the delay line,
        blocks done, samples of the present block.
    figures
        (S, FIGURES, TILE) receives the figures.
    n
        States of the plant.
    """
    padded = x.shape[1]
    feeds, senses = n * padded, n * padded + 4 * n
    longest = len(line)
    origin = int(spans[0, 0])
    head, blocks, in_block = int(counters[0]), int(counters[1]), int(counters[2])
    primary, second, second_v, first, first_v, current = places
    window = POWER_WINDOW_BLOCKS
    for s in range(len(spans)):
        begin, end = int(spans[s, 0]), int(spans[s, 1])
        count = end - begin
        for r in range(len(blended)):
            for c in range(TILE):
                blended[r, c] = weights[s, 0, c] * coefficients[0, r, c]
            for q in range(1, len(coefficients)):
                for c in range(TILE):
                    blended[r, c] += weights[s, q, c] * coefficients[q, r, c]
        moving = False
        for c in range(TILE):
            moving |= gains[s, 0, 3, c] != gains[s, 1, 3, c] or gains[s, 0, 4, c] != gains[s, 1, 4, c]
            memory[11, c] = acts[s, c] if guard[window + 2, c] < 0.0 else 0.0
            figures[s, X_PEAK, c] = figures[s, STROKE_PEAK, c] = figures[s, CURRENT_PEAK, c] = 0.0
            figures[s, CURRENT_SQUARES, c] = figures[s, MOTION_WORK, c] = figures[s, SATURATED, c] = 0.0
            figures[s, CONTROLLED, c] = memory[11, c]
            figures[s, STORED, c] = -0.5 * constants[7, c] * x[0, current, c] ** 2
        for k in range(begin, end):
            w = (k - begin) / count
            before, now = shape[k], shape[k + 1]
            for c in range(TILE):
                memory[6, c] = line[head, c]  # computed as many samples ago as the delay is long
                memory[9, c] = constants[0, c] * before
                memory[10, c] = constants[0, c] * now
            for i in range(n):
                b = feeds + 4 * i
                f = i * padded
                for c in range(TILE):
                    x[1, i, c] = (
                        blended[f, c] * x[0, 0, c]
                        + blended[f + 1, c] * x[0, 1, c]
                        + blended[f + 2, c] * x[0, 2, c]
                        + blended[f + 3, c] * x[0, 3, c]
                        + blended[f + 4, c] * x[0, 4, c]
                        + blended[f + 5, c] * x[0, 5, c]
                        + blended[b, c] * memory[7, c]
                        + blended[b + 1, c] * memory[6, c]
                        + blended[b + 2, c] * memory[9, c]
                        + blended[b + 3, c] * memory[10, c]
                    )
                for j in range(CHUNK, padded, CHUNK):
                    for c in range(TILE):
                        x[1, i, c] += (
                            blended[f + j, c] * x[0, j, c]
                            + blended[f + j + 1, c] * x[0, j + 1, c]
                            + blended[f + j + 2, c] * x[0, j + 2, c]
                            + blended[f + j + 3, c] * x[0, j + 3, c]
                            + blended[f + j + 4, c] * x[0, j + 4, c]
                            + blended[f + j + 5, c] * x[0, j + 5, c]
                        )
            for i in range(n):
                for c in range(TILE):
                    x[0, i, c] = x[1, i, c]
            for c in range(TILE):
                memory[7, c] = memory[6, c]
                memory[8, c] = 0.0
            for sensor in range(2):
                f, d = senses + sensor * padded, senses + 2 * padded + sensor
                for c in range(TILE):
                    memory[16, c] = (
                        blended[f, c] * x[0, 0, c]
                        + blended[f + 1, c] * x[0, 1, c]
                        + blended[f + 2, c] * x[0, 2, c]
                        + blended[f + 3, c] * x[0, 3, c]
                        + blended[f + 4, c] * x[0, 4, c]
                        + blended[f + 5, c] * x[0, 5, c]
                        + blended[d, c] * memory[10, c]
                    )
                for j in range(CHUNK, padded, CHUNK):
                    for c in range(TILE):
                        memory[16, c] += (
                            blended[f + j, c] * x[0, j, c]
                            + blended[f + j + 1, c] * x[0, j + 1, c]
                            + blended[f + j + 2, c] * x[0, j + 2, c]
                            + blended[f + j + 3, c] * x[0, j + 3, c]
                            + blended[f + j + 4, c] * x[0, j + 4, c]
                            + blended[f + j + 5, c] * x[0, j + 5, c]
                        )
                if len(noise) > 0:
                    for c in range(TILE):
                        memory[16, c] += noise[k - origin, sensor, c]
                for c in range(TILE):
                    shown = min(max(memory[16, c], -constants[2 + 2 * sensor, c]), constants[2 + 2 * sensor, c])
                    memory[8, c] += constants[3 + 2 * sensor, c] * shown

            if moving or k == begin:
                for c in range(TILE):
                    g_low = gains[s, 0, 3, c] + w * (gains[s, 1, 3, c] - gains[s, 0, 3, c])
                    g_high = gains[s, 0, 4, c] + w * (gains[s, 1, 4, c] - gains[s, 0, 4, c])
                    memory[12, c] = g_low
                    memory[13, c] = 1.0 / (1.0 + g_low * (g_low + SQRT2))
                    memory[14, c] = g_high
                    memory[15, c] = 1.0 / (1.0 + g_high * (g_high + SQRT2))
                    memory[17, c] = dt / (2.0 * g_high)
            for c in range(TILE):
                g_low, g_high = memory[12, c], memory[14, c]
                band = (memory[0, c] + g_low * (memory[8, c] - memory[1, c])) * memory[13, c]
                a = memory[1, c] + g_low * band
                memory[0, c], memory[1, c] = 2.0 * band - memory[0, c], 2.0 * a - memory[1, c]
                scale = memory[17, c]
                band = (memory[2, c] + g_high * (a - memory[3, c])) * memory[15, c]
                low = memory[3, c] + g_high * band
                memory[2, c], memory[3, c] = 2.0 * band - memory[2, c], 2.0 * low - memory[3, c]
                v = scale * band
                band = (memory[4, c] + g_high * (v - memory[5, c])) * memory[15, c]
                low = memory[5, c] + g_high * band
                memory[4, c], memory[5, c] = 2.0 * band - memory[4, c], 2.0 * low - memory[5, c]
                position = scale * band
                command = (
                    (gains[s, 0, 0, c] + w * (gains[s, 1, 0, c] - gains[s, 0, 0, c])) * a
                    + (gains[s, 0, 1, c] + w * (gains[s, 1, 1, c] - gains[s, 0, 1, c])) * v
                    + (gains[s, 0, 2, c] + w * (gains[s, 1, 2, c] - gains[s, 0, 2, c])) * position
                )
                # Gains beyond all measure make inf - inf: what is no number must not reach the converter.
                command = 0.0 if math.isnan(command) else min(max(command, -constants[1, c]), constants[1, c])
                memory[9, c] = command if memory[11, c] > 0.0 else 0.0
                guard[window + 1, c] = max(guard[window + 1, c], abs(position))
                guard[window, c] += memory[6, c] * memory[6, c]
            for c in range(TILE):
                slot = head + delays[c]
                line[slot if slot < longest else slot - longest, c] = memory[9, c]
            head = head + 1 if head + 1 < longest else 0

            for c in range(TILE):
                memory[9, c] = x[0, second, c]
                memory[10, c] = x[0, second_v, c]
            if first >= 0:
                for c in range(TILE):
                    memory[9, c] -= x[0, first, c]
                    memory[10, c] -= x[0, first_v, c]
            for c in range(TILE):
                i_now = x[0, current, c]
                figures[s, X_PEAK, c] = max(figures[s, X_PEAK, c], abs(x[0, primary, c]))
                figures[s, STROKE_PEAK, c] = max(figures[s, STROKE_PEAK, c], abs(memory[9, c]))
                figures[s, CURRENT_PEAK, c] = max(figures[s, CURRENT_PEAK, c], abs(i_now))
                figures[s, CURRENT_SQUARES, c] += i_now * i_now
                figures[s, MOTION_WORK, c] += constants[6, c] * i_now * memory[10, c]
                figures[s, SATURATED, c] += 1.0 if abs(memory[6, c]) >= constants[1, c] else 0.0
        in_block += count
        for c in range(TILE):
            figures[s, STORED, c] += 0.5 * constants[7, c] * x[0, current, c] ** 2
        if spans[s, 2] > 0.0:
            kept = min(blocks + 1, window)
            for c in range(TILE):
                guard[blocks % window, c] = guard[window, c] / in_block
                total = 0.0
                for b in range(kept):
                    total += guard[b, c]
                calm = guard[window + 1, c] <= constants[8, c] and total / kept <= constants[9, c]
                if not calm and guard[window + 2, c] < 0.0:
                    guard[window + 2, c] = end
                guard[window, c] = guard[window + 1, c] = 0.0
            blocks, in_block = blocks + 1, 0
    counters[0], counters[1], counters[2] = head, blocks, in_block
