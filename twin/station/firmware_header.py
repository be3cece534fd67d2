"""The C header of a handed-over schedule: tables, interpolation and the controller's step, ISO C99 and C++.

What the header computes in double precision is what the simulated rig runs (`twin.control.schedule`,
`twin.control.chain`), in the same order of operations.
"""

import math
from collections.abc import Sequence

from tuning.firmware import BITS, SHARE_BITS, FixedTable
from twin.station.handover import Handover

WIDTH = 110
DOUBLE_COLUMNS = ("frequency_hz", "alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
FIXED_COLUMNS = ("frequency_hz", "alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_g", "high_pass_g")


def c_header(handover: Handover) -> str:
    """Text of the header, ASCII."""
    parts = [_opening(handover), _double_tables(handover), _DOUBLE_CODE]
    if handover.fixed_point is not None:
        parts += [_fixed_tables(handover.fixed_point), _fixed_code(handover.fixed_point)]
    parts.append("#endif\n")
    return "\n".join(parts).encode("ascii", "replace").decode("ascii")


def _opening(h: Handover) -> str:
    s = h.schedule
    lines = [
        f"Gain schedule for the controller of plant '{h.plant}' (fingerprint {h.fingerprint}).",
        f"From {_plain(h.source)}." + (f" Made {_plain(h.made)}." if h.made else ""),
        "",
        "i_ref = (alpha a + beta v + gamma x) / k, clamped, with a the relative acceleration behind a 2nd-order",
        "Butterworth low-pass, v its integral behind a 2nd-order high-pass, x the integral of v behind the same",
        "high-pass. Filters are trapezoidal (topology-preserving): their coefficients may change at every sample while",
        "the states stay. Gains and cutoffs are linear in the excitation frequency between rows, held beyond the ends.",
        "",
        f"Margins hold for {h.loop.sample_rate_hz:g} samples/s, {1e6 * h.loop.delay_s:g} us from measuring to the "
        f"converter's update, {h.loop.measurement} acceleration.",
        _sweep_line(h),
        _budget_line(h),
        f"Excitation: {h.excitation.amplitude:g} {h.excitation.unit} peak on {h.excitation.actuator}. "
        "Displacements are peaks of the primary body.",
        "",
        "    Hz   passive um   limit um   reached um   coil A   R i2 mean W   v i mean W   modulus   delay us",
    ]
    for p in h.points:
        limit = "-" if p.limit_displacement_m is None else f"{1e6 * p.limit_displacement_m:.3f}"
        delay = ">8000" if p.delay_margin_s is None else f"{1e6 * p.delay_margin_s:.1f}"
        lines.append(
            f"{p.frequency_hz:6.2f} {1e6 * p.passive_displacement_m:12.3f} {limit:>10} "
            f"{1e6 * p.achieved_displacement_m:12.3f} {p.current_peak_a:8.3f} {p.joule_mean_w:13.3f} "
            f"{p.electrical_mean_w:12.3f} {p.modulus_margin:9.3f} {delay:>10}"
        )
    text = "\n".join(f" * {line}".rstrip() for line in lines)
    defines = [
        ("ATMD_PLANT", f'"{h.plant}"'),
        ("ATMD_FINGERPRINT", f'"{h.fingerprint}"'),
        ("ATMD_POINTS", str(len(s.frequency_hz))),
        ("ATMD_SAMPLE_RATE_HZ", _number(h.loop.sample_rate_hz)),
        ("ATMD_DELAY_S", _number(h.loop.delay_s)),
        ("ATMD_ON_FROM_HZ", _number(s.on_from_hz)),
        ("ATMD_ON_TO_HZ", _number(s.on_to_hz)),
        ("ATMD_FORCE_CONSTANT_N_A", _number(h.coil.force_constant_n_a)),
        ("ATMD_CURRENT_LIMIT_A", _number(h.coil.current_limit_a)),
    ]
    if h.budget is not None:
        defines += [
            ("ATMD_BUDGET_W", _number(h.budget.power_w)),
            ("ATMD_BUDGET_KIND", f'"{h.budget.kind}"'),
        ]
    body = "\n".join(f"#define {name} {value}" for name, value in defines)
    return (
        f"/*\n{text}\n */\n#ifndef ATMD_SCHEDULE_H\n#define ATMD_SCHEDULE_H\n\n"
        f"#include <math.h>\n#include <stdint.h>\n\n{body}\n"
    )


def _sweep_line(h: Handover) -> str:
    t = h.transition
    if not t.shown:
        return "Stability while the frequency moves: not shown."
    if t.fastest_sweep_hz_s is None:
        return "Stable however fast the frequency moves inside the band."
    return f"Stable while the frequency moves by up to {t.fastest_sweep_hz_s:.3g} Hz/s inside the band."


def _budget_line(h: Handover) -> str:
    if h.budget is None:
        return "Power budget: none stated."
    return f"Power budget: {h.budget.power_w:g} W ({h.budget.kind.replace('_', ' ')})."


def _double_tables(h: Handover) -> str:
    return "\n".join(
        _array("double", f"atmd_{name}", "ATMD_POINTS", [_number(v) for v in getattr(h.schedule, name)])
        for name in DOUBLE_COLUMNS
    )


def _fixed_tables(table: FixedTable) -> str:
    bits = BITS[table.word]
    parts = [
        "/*",
        f" * Fixed point, {table.word} ({bits} bits): value = number * 2^exponent, an exponent per column.",
        " * Cutoffs are stored as g = tan(pi f_c/f_s), what the filters compute with.",
        " */",
        f"#define ATMD_FIXED_BITS {bits}",
        f"#define ATMD_FIXED_ON_FROM ((int32_t){table.on_from})",
        f"#define ATMD_FIXED_ON_TO ((int32_t){table.on_to})",
    ]
    parts += [f"#define ATMD_{n.upper()}_EXPONENT ({getattr(table, n).exponent})" for n in FIXED_COLUMNS]
    for name in FIXED_COLUMNS:
        numbers = [str(q) for q in getattr(table, name).numbers]
        parts.append(_array(f"int{bits}_t", f"atmd_fixed_{name}", "ATMD_POINTS", numbers))
    return "\n".join(parts)


def _array(kind: str, name: str, size: str, words: Sequence[str]) -> str:
    lines, line = [], "   "
    for word in words:
        if len(line) + len(word) + 2 > WIDTH:
            lines.append(line)
            line = "   "
        line += f" {word},"
    return f"static const {kind} {name}[{size}] = {{\n" + "\n".join([*lines, line]) + "\n};"


def _number(value: float) -> str:
    """Shortest decimal that reads back to the same bits, as a C double."""
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"


def _plain(text: str) -> str:
    """Text that cannot end a comment."""
    return " ".join(text.replace("*/", "* /").replace("/*", "/ *").split())


_DOUBLE_CODE = f"""
typedef struct {{
    double alpha_kg, beta_ns_m, gamma_n_m, low_pass_hz, high_pass_hz;
}} atmd_gains;

/* Gains in ampere per SI unit of motion, and tan(pi f_c/f_s) of both cutoffs. */
typedef struct {{
    double alpha, beta, gamma, g_low, g_high;
}} atmd_coefficients;

typedef struct {{
    double s[6];
}} atmd_chain;

/* Whether the controller acts at this excitation frequency; not at one that is no number. */
static inline int atmd_acts_at(double frequency_hz)
{{
    return frequency_hz >= ATMD_ON_FROM_HZ && frequency_hz <= ATMD_ON_TO_HZ;
}}

/* Gains and cutoffs at an excitation frequency: linear between rows, held beyond the ends. */
static inline atmd_gains atmd_gains_at(double frequency_hz)
{{
    atmd_gains out;
    int row = 0;
    double along = 0.0;
    if (frequency_hz >= atmd_frequency_hz[ATMD_POINTS - 1]) {{
        row = ATMD_POINTS - 1;
    }} else if (frequency_hz > atmd_frequency_hz[0]) {{
        int above = ATMD_POINTS - 1;
        while (above - row > 1) {{
            const int middle = row + (above - row) / 2;
            if (frequency_hz >= atmd_frequency_hz[middle]) {{
                row = middle;
            }} else {{
                above = middle;
            }}
        }}
        along = (frequency_hz - atmd_frequency_hz[row]) / (atmd_frequency_hz[above] - atmd_frequency_hz[row]);
    }}
    out.alpha_kg = atmd_alpha_kg[row];
    out.beta_ns_m = atmd_beta_ns_m[row];
    out.gamma_n_m = atmd_gamma_n_m[row];
    out.low_pass_hz = atmd_low_pass_hz[row];
    out.high_pass_hz = atmd_high_pass_hz[row];
    if (along > 0.0) {{
        out.alpha_kg += along * (atmd_alpha_kg[row + 1] - out.alpha_kg);
        out.beta_ns_m += along * (atmd_beta_ns_m[row + 1] - out.beta_ns_m);
        out.gamma_n_m += along * (atmd_gamma_n_m[row + 1] - out.gamma_n_m);
        out.low_pass_hz += along * (atmd_low_pass_hz[row + 1] - out.low_pass_hz);
        out.high_pass_hz += along * (atmd_high_pass_hz[row + 1] - out.high_pass_hz);
    }}
    return out;
}}

static inline atmd_coefficients atmd_coefficients_from(atmd_gains gains)
{{
    atmd_coefficients out;
    const double turn = {_number(math.pi)} / ATMD_SAMPLE_RATE_HZ;
    out.alpha = gains.alpha_kg / ATMD_FORCE_CONSTANT_N_A;
    out.beta = gains.beta_ns_m / ATMD_FORCE_CONSTANT_N_A;
    out.gamma = gains.gamma_n_m / ATMD_FORCE_CONSTANT_N_A;
    out.g_low = tan(turn * gains.low_pass_hz);
    out.g_high = tan(turn * gains.high_pass_hz);
    return out;
}}

static inline void atmd_reset(atmd_chain *chain)
{{
    int k;
    for (k = 0; k < 6; ++k) {{
        chain->s[k] = 0.0;
    }}
}}

/* One sample of the filters: acceleration in; acceleration, velocity and position out. */
static inline void atmd_chain_step(atmd_chain *chain, const atmd_coefficients *c, double a_in, double motion[3])
{{
    const double root2 = {_number(math.sqrt(2.0))};
    const double scale = 1.0 / ATMD_SAMPLE_RATE_HZ / (2.0 * c->g_high);
    double *s = chain->s;
    double band, low;

    band = (s[0] + c->g_low * (a_in - s[1])) / (1.0 + c->g_low * (c->g_low + root2));
    low = s[1] + c->g_low * band;
    s[0] = 2.0 * band - s[0];
    s[1] = 2.0 * low - s[1];
    motion[0] = low;

    band = (s[2] + c->g_high * (motion[0] - s[3])) / (1.0 + c->g_high * (c->g_high + root2));
    low = s[3] + c->g_high * band;
    s[2] = 2.0 * band - s[2];
    s[3] = 2.0 * low - s[3];
    motion[1] = scale * band;

    band = (s[4] + c->g_high * (motion[1] - s[5])) / (1.0 + c->g_high * (c->g_high + root2));
    low = s[5] + c->g_high * band;
    s[4] = 2.0 * band - s[4];
    s[5] = 2.0 * low - s[5];
    motion[2] = scale * band;
}}

/*
 * One sample of the controller: measured relative acceleration [m/s2] in, current reference [A] out, clamped.
 * The filters run on while the controller is off. What is no number never reaches the converter.
 */
static inline double atmd_step(atmd_chain *chain, const atmd_coefficients *c, double acceleration, int on)
{{
    double motion[3], reference;
    atmd_chain_step(chain, c, acceleration, motion);
    if (!on) {{
        return 0.0;
    }}
    reference = c->alpha * motion[0] + c->beta * motion[1] + c->gamma * motion[2];
    if (reference != reference) {{
        return 0.0;
    }}
    if (reference > ATMD_CURRENT_LIMIT_A) {{
        return ATMD_CURRENT_LIMIT_A;
    }}
    return reference < -ATMD_CURRENT_LIMIT_A ? -ATMD_CURRENT_LIMIT_A : reference;
}}
"""


def _fixed_code(table: FixedTable) -> str:
    names = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_g", "high_pass_g")
    rows = "\n".join(
        f"    out.{n} = atmd_fixed_between(atmd_fixed_{n}[row], atmd_fixed_{n}[next], share);" for n in names
    )
    last = "high_pass_g"
    gains = "\n".join(
        f"    out.{to} = ldexp((double)q.{n}, ATMD_{n.upper()}_EXPONENT) / ATMD_FORCE_CONSTANT_N_A;"
        for n, to in zip(names[:3], ("alpha", "beta", "gamma"), strict=True)
    )
    return f"""
/* The columns of {table.word} at one frequency, in steps of their own 2^exponent. */
typedef struct {{
    int32_t alpha_kg, beta_ns_m, gamma_n_m, low_pass_g, {last};
}} atmd_fixed_gains;

static inline int atmd_fixed_acts_at(int32_t frequency)
{{
    return frequency >= ATMD_FIXED_ON_FROM && frequency <= ATMD_FIXED_ON_TO;
}}

/* Between two rows, share of 2^{SHARE_BITS} from the first: rounded to nearest, halves away from zero. */
static inline int32_t atmd_fixed_between(int32_t from, int32_t to, int64_t share)
{{
    const int64_t step = ((int64_t)to - from) * share;
    const int64_t half = (int64_t)1 << {SHARE_BITS - 1};
    const int64_t size = ((step < 0 ? -step : step) + half) >> {SHARE_BITS};
    return (int32_t)(step < 0 ? from - size : from + size);
}}

/* Whole-number interpolation; the frequency in steps of 2^ATMD_FREQUENCY_HZ_EXPONENT Hz. */
static inline atmd_fixed_gains atmd_fixed_gains_at(int32_t frequency)
{{
    atmd_fixed_gains out;
    int row = 0, next = 0;
    int64_t share = 0;
    if (frequency >= atmd_fixed_frequency_hz[ATMD_POINTS - 1]) {{
        row = next = ATMD_POINTS - 1;
    }} else if (frequency > atmd_fixed_frequency_hz[0]) {{
        next = ATMD_POINTS - 1;
        while (next - row > 1) {{
            const int middle = row + (next - row) / 2;
            if (frequency >= atmd_fixed_frequency_hz[middle]) {{
                row = middle;
            }} else {{
                next = middle;
            }}
        }}
        share = (((int64_t)frequency - atmd_fixed_frequency_hz[row]) * ((int64_t)1 << {SHARE_BITS}))
            / ((int64_t)atmd_fixed_frequency_hz[next] - atmd_fixed_frequency_hz[row]);
    }}
{rows}
    return out;
}}

/* For targets that run the filters in floating point from the rounded tables. */
static inline atmd_coefficients atmd_coefficients_from_fixed(atmd_fixed_gains q)
{{
    atmd_coefficients out;
{gains}
    out.g_low = ldexp((double)q.low_pass_g, ATMD_LOW_PASS_G_EXPONENT);
    out.g_high = ldexp((double)q.high_pass_g, ATMD_HIGH_PASS_G_EXPONENT);
    return out;
}}
"""
