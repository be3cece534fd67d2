"""What was run, on a report's page: files and checksums, plant, law, channels, versions."""

from typing import Any

from twin.station.report.page import Html, badge, element, facts, join, table
from twin.station.report.words import quantity, share, size, span


def setup_of(said: dict[str, Any]) -> Html:
    """Facts and the plant's parts, as a report's page has them."""
    s, v = said["setup"], said["verify"]
    whole = {
        True: badge("whole", "good"),
        False: badge("not whole", "bad"),
        None: badge("no checksums", "open"),
    }[v["whole"]]
    files = join(
        join((f"{f['name']}, {size(f['bytes'])}, SHA-256 ", element("code", f["sha256"]), Html("<br>")))
        for f in s["files"]
    )
    hz = s["excitation_hz"]
    pairs: list[tuple[str, object]] = [
        ("File", files),
        (
            "Verified",
            join((whole, f" {v['blocks']} blocks read;" if v["blocks"] is not None else "", _masked(v))),
        ),
        ("Plant", join((f"{s['plant']}, fingerprint ", element("code", s["plant_fingerprint"])))),
        ("Configuration", element("code", s["config_id"]) if s["config_id"] else "not recorded"),
        ("Law at the start", _law(s["law"])),
        (
            "Excitation",
            "none tracked"
            if hz is None
            else f"{span(hz[0], hz[1], 'Hz')}, by {s['excitation_tracked'] or 'the absorber'}",
        ),
        ("Channels", ", ".join(f"{c['name']} [{c['unit']}]" for c in s["channels"])),
        ("Seed", "–" if s["seed"] is None else str(s["seed"])),
        ("Recorded by", f"atmd-twin {s['program_version']}" if s["program_version"] else "another program"),
        ("Versions", ", ".join(f"{k} {w}" for k, w in s["software"].items()) or "not recorded"),
    ]
    pairs += [("Remark", remark) for remark in s["remarks"]]
    return join((facts(pairs), _parts(s)))


def _masked(v: dict[str, Any]) -> str:
    m = v["masked"]
    text = f" {m['values']} values masked"
    return text + (f" ({share(m['share'])} of all)" if m["values"] else "")


def _law(law: dict[str, Any]) -> str:
    if not law:
        return "not recorded"
    words = [law["feedback"]] if "feedback" in law else []
    if "on_from_hz" in law:
        words.append(
            f"acting from {law['on_from_hz']:g} to {law['on_to_hz']:g} Hz, {law['table_points']} points"
        )
        for name, sign, unit in (
            ("gamma_n_m", "γ", "N/m"), ("beta_ns_m", "β", "Ns/m"), ("alpha_kg", "α", "kg"),
            ("low_pass_hz", "low-pass", "Hz"), ("high_pass_hz", "high-pass", "Hz"),
        ):  # fmt: skip
            words.append(f"{sign} {span(law[name][0], law[name][1], unit)}")
    if "loop_delay_s" in law:
        words.append(f"loop delay {quantity(law['loop_delay_s'], 's')}")
    if "retuned" in law:
        words.append("retuned as it ran" if law["retuned"] else "not retuned")
    return "; ".join(words)


def _parts(s: dict[str, Any]) -> Html:
    def damping(value: object) -> str:
        return f"{value:g} Ns/m" if isinstance(value, float) else "against frequency"

    bodies = [
        [
            b["name"],
            f"{b['mass_kg']:g} kg",
            b["attached_to"],
            f"{b['stiffness_n_m']:g} N/m",
            damping(b["damping_ns_m"]),
        ]
        for b in s["bodies"]
    ]
    motors = []
    for a in s["actuators"]:
        about = {
            k: v
            for k, v in a.items()
            if k not in ("name", "kind", "between", "on", "recorded_as") and v is not None
        }
        where = a["on"] or " and ".join(a["between"] or ())
        motors.append(
            [a["name"], a["kind"].replace("_", " "), where, ", ".join(f"{k} {v}" for k, v in about.items())]
        )
    return join((
        element("h3", "Plant", class_="sub"),
        table(("body", "mass", "attached to", "stiffness", "damping"), bodies, (1, 3, 4)),
        table(("actuator", "kind", "on, between", "constants"), motors) if motors else "",
    ))  # fmt: skip
