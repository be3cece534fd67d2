"""The page that is filed after a test."""

from collections.abc import Callable
from typing import Any

from twin.station.report.document import alarms
from twin.station.report.figures import HOVER, all_as_html, no_progress
from twin.station.report.page import Html, badge, element, join, page, section, table, tiles
from twin.station.report.plots import plots_of
from twin.station.report.replayed import Replayed
from twin.station.report.setup_page import setup_of
from twin.station.report.words import quantity, seconds, share, some, span

MARKS = {"kept": "good", "broken": "bad", "unknown": "open"}
LEVELS = {"error": "bad", "warning": "warn", "info": "open"}
SECTIONS = (
    ("limits", "Limits"), ("plots", "Plots"), ("setup", "Set-up"), ("proposals", "Proposals"),
    ("audit-table", "Predicted and achieved"), ("alarms", "Alarms and faults"), ("unknown", "What this cannot say"),
)  # fmt: skip


def filed_page(
    run: Replayed, said: dict[str, Any], progress: Callable[[int, int], None] = no_progress
) -> str:
    """The whole page.

    Parameters
    ----------
    said
        `twin.station.report.document.document` of the run.
    progress
        Takes plots drawn and plots in all.
    """
    links = join(element("a", title, href=f"#{name}") for name, title in SECTIONS)
    plots = all_as_html(plots_of(run), progress)
    body = join((
        element("h1", f"Test report: {run.name}"),
        element("p", _lead(said), class_="dim"),
        _condition(said),
        tiles(_headline(said)),
        element("nav", links, aria_label="Sections"),
        section("Limits", "limits", _limits(said)),
        section("Plots", "plots", plots, _prediction(said)),
        section("Set-up", "setup", setup_of(said)),
        section("Proposals", "proposals", _proposals(said)),
        section("Predicted and achieved", "audit-table", _audit(said)),
        section("Alarms and faults", "alarms", _alarms(run, said)),
        section("What this cannot say", "unknown", _unknown(said)),
    ))  # fmt: skip
    return page(f"Test report: {run.name}", body, HOVER)


def _lead(said: dict[str, Any]) -> str:
    s = said["setup"]
    when = (
        "at an unknown time"
        if s["recorded_at"] is None
        else s["recorded_at"].replace("T", " ").replace("+00:00", " UTC")
    )
    return (
        f"Plant {s['plant']}, {s['seconds']:.1f} s at {s['sample_rate_hz']:g} samples/s, {when} ({s['date_from']}). "
        f"{s['estimates']}"
    )


def _condition(said: dict[str, Any]) -> Html:
    """What is wrong with the file itself, before anything else."""
    v = said["verify"]
    notes = [element("p", f"The recording is not whole: {d}.", class_="notice") for d in v["damage"]]
    if v["gaps"]:
        lost = sum(n for _, n in v["gaps"])
        where = some([f"{n} samples from {first}" for first, n in v["gaps"]])
        notes.append(element("p", f"{lost} samples are missing: {where}.", class_="notice warn"))
    if said["figures"]["decisions_repeated"] is False:
        words = (
            "The replay decided otherwise than the run did: proposals and commands below are the replay's."
        )
        notes.append(element("p", words, class_="notice warn"))
    return join(notes)


def _headline(said: dict[str, Any]) -> list[tuple[object, object]]:
    h, f = said["hindsight"], said["figures"]
    found: list[tuple[object, object]] = []
    if h["attenuation_mean"] is not None:
        found.append((share(h["attenuation_mean"], h["attenuation_std"]), "mean attenuation"))
        found.append((share(h["attenuation_worst"]), f"worst, at {h['worst_at_hz']:.1f} Hz"))
    if f["joule_mean_w"] is not None:
        found.append((quantity(f["joule_mean_w"], "W", digits=3), "Joule mean, worst block"))
    if f["current_peak_a"] is not None:
        found.append((quantity(f["current_peak_a"], "A", digits=3), "peak current"))
    if f["nrmse"] is not None:
        found.append((f"{f['nrmse']:.3g}", "prediction NRMSE"))
    limits = said["limits"]
    broken = sum(entry["verdict"] == "broken" for entry in limits)
    found.append((f"{broken} of {len(limits)}", "limits passed over"))
    found.append((f"{f['commands']}", "commands"))
    share_ok = f["estimation"]["consistent_share"]
    found.append((share(share_ok), "model consistent"))
    return found


def _limits(said: dict[str, Any]) -> Html:
    if not said["limits"]:
        return element("p", "The plant states no limits.")
    rows = []
    for e in said["limits"]:
        when = "–" if e["at_s"] is None else seconds(e["at_s"])
        if e["at_hz"] is not None:
            when += f", {e['at_hz']:.2f} Hz"
        rows.append([
            join((element("b", e["key"]), Html("<br>"), element("small", e["what"]))),
            quantity(e["limit"], e["unit"]),
            quantity(e["worst"], e["unit"], e["worst_std"]),
            when,
            share(e["margin"]),
            badge(e["verdict"], MARKS[e["verdict"]]),
            quantity(e["worst_settled"], e["unit"]),
            badge(e["verdict_settled"], MARKS[e["verdict_settled"]]),
        ])  # fmt: skip
    heads = ("limit", "value", "worst seen", "when", "margin", "verdict", "worst settled", "settled")
    note = element(
        "p",
        "Verdicts are over the whole recording, also where the controller was off; the last two columns count from "
        "half a second after it came on. A limit that nothing recorded tells is unknown, never kept.",
        class_="dim",
    )
    return join((table(heads, rows, (1, 2, 4, 6)), note))


def _prediction(said: dict[str, Any]) -> Html:
    rows = []
    for s in said["figures"]["sensors"]:
        without = s["nrmse_without_input"]
        rows.append(
            [s["sensor"], f"{s['nrmse']:.4f}", None if without is None else f"{without:.4f}", s["rows"]]
        )
    if not rows:
        return Html("")
    words = "One-step prediction, rms(error)/std(signal), with the known input and without."
    heads = ("sensor", "NRMSE", "without the input", "rows")
    return join((element("h3", "Prediction", class_="sub"), element("p", words, class_="dim"),
                 table(heads, rows, (1, 2, 3))))  # fmt: skip


def _proposals(said: dict[str, Any]) -> Html:
    rows = []
    answers = {c["command_id"]: c for c in said["commands"]}
    for p in said["proposals"]:
        near = p.get("nearest")
        command = answers.get(p["command_id"])
        became = "–"
        if command is not None:
            at = command["applied_s"]
            became = f"command {command['command_id']}, " + (
                command["answer"] or "unanswered in the recording"
                if at is None
                else f"in effect at {seconds(at)}"
            )
        note = f" ({p['note']})" if p.get("note") and p["note"] not in p["reason"] else ""
        what = p["what"] + (
            f", {span(p['points_hz'][0], p['points_hz'][-1], 'Hz')}" if p.get("points_hz") else ""
        )
        rows.append([
            seconds(p["time_s"]),
            "–" if p["frequency_hz"] is None else f"{p['frequency_hz']:.2f}",
            what,
            "–" if near is None else _gains(near["gains"]),
            "–" if near is None else quantity(near["predicted_displacement_m"], "m", digits=3),
            "–" if near is None else quantity(near["limit_displacement_m"], "m", digits=3),
            "–" if near is None else quantity(near["joule_mean_w"], "W", digits=3),
            "–" if near is None else f"{near['modulus_margin']:.2f}",
            join((badge("taken" if p["accepted"] else "declined", "good" if p["accepted"] else "warn"),
                  f" {p['by']}: {p['reason']}{note}")),
            became,
        ])  # fmt: skip
    skipped = [f"{n} with {reason}" for reason, n in said["proposals_not_listed"].items()]
    note = element("p", f"Not listed: {', '.join(skipped)}." if skipped else "", class_="dim")
    if not rows:
        return join((element("p", "No proposal led to a decision."), note if skipped else ""))
    heads = ("time", "Hz", "what", "gains at the excitation", "predicted", "least possible", "Joule mean", "margin",
             "decision", "became")  # fmt: skip
    return join((table(heads, rows, (0, 1, 4, 5, 6, 7)), note if skipped else ""))


def _gains(g: dict[str, float]) -> str:
    alpha = f"α {g['alpha_kg']:.3g} kg, " if g["alpha_kg"] else ""
    return (
        f"{alpha}β {g['beta_ns_m']:.4g} Ns/m, γ {g['gamma_n_m']:.5g} N/m, "
        f"{g['low_pass_hz']:.4g}/{g['high_pass_hz']:.3g} Hz"
    )


def _audit(said: dict[str, Any]) -> Html:
    summary, points = said["audit"]["summary"], said["audit"]["points"]
    if not points:
        return element("p", "No comparison: the motion never settled under gains that had been proposed.")
    words = (
        f"Motion: rms error {share(summary['displacement_error_rms'])} at {summary['displacement_points']} of "
        f"{summary['points']} points above the floor; power: {share(summary['power_error_rms'])} at "
        f"{summary['power_points']}."
    )
    rows = [
        [
            seconds(p["time_s"]), f"{p['frequency_hz']:.2f}",
            *(quantity(v, "m", digits=3) for v in p["displacement_m"]), share(p["displacement_error"]),
            *(quantity(v, "W", digits=3) for v in p["joule_mean_w"]), share(p["power_error"]),
        ]
        for p in points
    ]  # fmt: skip
    heads = ("time", "Hz", "motion, predicted", "achieved", "error", "power, predicted", "achieved", "error")
    listed = table(heads, rows, range(8))
    if len(rows) > 12:
        listed = element("details", element("summary", f"{len(rows)} points"), listed)
    return join((element("p", words), listed))


def _alarms(run: Replayed, said: dict[str, Any]) -> Html:
    told = [
        [seconds(a["time_s"]), badge(a["level"], LEVELS[a["level"]]), a["text"],
         "" if a["times"] == 1 else f"{a['times']} times, last at {seconds(a['last_s'])}"]
        for a in alarms(run)
    ]  # fmt: skip
    faults = [
        [f["channel"], f["kind"], str(f["samples"]), str(f["blocks"]),
         f"{seconds(f['from_s'])} to {seconds(f['to_s'])}", quantity(f["value"], f["unit"])]
        for f in said["faults"]
    ]  # fmt: skip
    log = [[seconds(e["time_s"]), badge(e["level"], LEVELS[e["level"]]), e["text"]] for e in said["events"]]
    return join((
        table(("first at", "level", "what", ""), told, (0,)) if told else element("p", "No warning and no error."),
        element("h3", "Masked samples", class_="sub"),
        table(("channel", "why", "samples", "blocks", "when", "value"), faults, (2, 3, 5))
        if faults else element("p", "None."),
        element("details", element("summary", f"Whole log, {len(log)} entries"),
                table(("time", "level", "what"), log, (0,)), class_="screen"),
    ))  # fmt: skip


def _unknown(said: dict[str, Any]) -> Html:
    if not said["cannot_say"]:
        return element("p", "Nothing that a report of this kind usually holds is missing.")
    return element("ul", join(element("li", words) for words in said["cannot_say"]))
