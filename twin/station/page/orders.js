// Proposal, review, arm, send, acknowledged, achieved; revert; on and off.
import { call, drop, micro, number, put, seen, settings, watts } from "/page/page.js";

let proposal = null, code = null, disarm = 0, sentAfter = null, step = "";
const $ = (id) => document.getElementById(id);
const ORDER = ["review", "arm", "send", "ack", "audit"];

function at(name) {
  step = name;
  for (const item of $("steps").children) {
    const k = ORDER.indexOf(item.dataset.step), n = ORDER.indexOf(name);
    item.className = n > k || (name === "audit" && k === n) ? "done" : "";
    if (k === n && name !== "audit") item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  }
}

function say(text, bad = false) {
  put("order-state", text);
  $("order-state").className = bad ? "bad" : "";
}

function node(tag, text, className = "") {
  return Object.assign(document.createElement(tag), { textContent: text, className });
}

const UNIT = { "joule mean": "µm/W", power: "µm/W", electrical: "µm/W", current: "µm/A", voltage: "µm/V", stroke: "µm/mm" };
const price = (l) => (l.price === null || !UNIT[l.name] ? null : 1e6 * l.price * (l.name === "stroke" ? 1e-3 : 1));
const kind = (k) => ({ joule_mean: "mean Joule", joule_peak: "peak Joule", electrical: "mean electrical" })[k] ?? k;
const most = (values) => (values.some((v) => v != null) ? Math.max(...values.filter((v) => v != null)) : null);
const arrow = (from, to) => (from === to ? to : `${from} → ${to}`);

// What binds over the table, each with the range of its price: what one more unit of it would buy.
function binding(rows) {
  const limits = new Map();
  for (const l of rows.flatMap((r) => r.limits)) limits.set(l.name, [...(limits.get(l.name) ?? []), price(l)].filter((v) => v !== null));
  return [...limits].map(([name, prices]) => {
    if (!prices.length) return name;
    const low = number(Math.min(...prices), 2), high = number(Math.max(...prices), 2);
    return `${name}, ${low === high ? low : `${low} to ${high}`} ${UNIT[name]}`;
  }).join("; ");
}

function show(p) {
  const box = $("review");
  box.replaceChildren();
  const list = node("dl", "", "figures");
  const add = (name, value) => list.append(node("dt", name), node("dd", value));
  add("source", `${p.source}, proposal ${p.proposal}, model ${p.model_id.slice(0, 8)}`);
  const g = p.goal, b = p.goal_before;
  add("budget", arrow(`${number(b.budget_w)} W ${kind(b.budget_kind)}`, `${number(g.budget_w)} W ${kind(g.budget_kind)}`));
  if (g.modulus_margin !== b.modulus_margin) add("margin wanted", `${b.modulus_margin} → ${g.modulus_margin}`);
  const enough = (m) => (m === null ? "as little as possible" : `${micro(m)} µm`);
  if (g.displacement_m !== b.displacement_m) add("motion that is enough", arrow(enough(b.displacement_m), enough(g.displacement_m)));
  const band = (w) => `${number(w[0], 4)} to ${number(w[1], 4)} Hz`;
  add("control acts", arrow(band(p.window_before_hz), band(p.window_hz)));
  const now_m = most(p.rows.map((r) => r.in_use_m)), now_w = most(p.rows.map((r) => r.in_use_w));
  add("worst motion", p.worst_m === null ? "–" : `${now_m === null ? micro(p.worst_m) : arrow(micro(now_m), micro(p.worst_m))} µm`);
  add("highest power", p.worst_w === null ? "–" : `${now_w === null ? watts(p.worst_w) : arrow(watts(now_w), watts(p.worst_w))} W`);
  add("least margins", `modulus ${number(p.least_modulus_margin, 2)}, delay ${p.least_delay_margin_s === null ? "over 8 ms" : `${number(1e6 * p.least_delay_margin_s, 2)} µs`}`);
  add("what binds, its price", binding(p.rows) || "nothing");
  if (p.steps > 1) add("sent in", `${p.steps} steps, each stable`);
  box.append(list);
  if (p.without.length) box.append(node("p", `No better gains at ${p.without.join(", ")} Hz: ${p.rows.find((r) => r.displacement_m === null).reason} Those points keep theirs.`, "hint"));
  if (!p.changes_anything) box.append(node("p", "It changes nothing: the gains in use are as good.", "hint"));
  box.append(table(p));
}

function table(p) {
  const frame = node("div", "", "scroll");
  frame.tabIndex = 0;
  frame.setAttribute("role", "region");
  frame.setAttribute("aria-label", "Gains and predictions against frequency");
  const pair = (values, scale = 1) => arrow(...values.map((v) => number(scale * v)));
  const gains = [["γ [N/mm]", "gamma_n_m", 1e-3], ["β [Ns/m]", "beta_ns_m", 1], ["α [kg]", "alpha_kg", 1], ["low-pass [Hz]", "low_pass_hz", 1], ["high-pass [Hz]", "high_pass_hz", 1]];
  // Gamma and beta always; the others where they change.
  const shown = gains.filter(([, key], k) => k < 2 || p.rows.some((r) => r.gains[key][0] !== r.gains[key][1]));
  const columns = [
    ["Hz", (r) => number(r.frequency_hz, 4)],
    ...shown.map(([name, key, scale]) => [name, (r) => pair(r.gains[key], scale)]),
    ["motion [µm]", (r) => (r.in_use_m != null ? arrow(micro(r.in_use_m, 2), micro(r.displacement_m, 2)) : micro(r.displacement_m))],
    ["W", (r) => (r.in_use_w != null ? arrow(watts(r.in_use_w, 2), watts(r.power_w, 2)) : watts(r.power_w))],
    ["margin", (r) => number(r.modulus_margin, 2)],
    ["binds", (r) => r.limits.map((l) => l.name).join(", ")],
  ];
  const made = document.createElement("table"), head = made.createTHead().insertRow(), body = made.createTBody();
  for (const [name] of columns) head.append(Object.assign(node("th", name, name === "binds" ? "" : "n"), { scope: "col" }));
  for (const r of p.rows) {
    const row = body.insertRow();
    for (const [name, of] of columns) row.append(node("td", of(r), name === "binds" ? "why" : "n"));
  }
  frame.append(made);
  return frame;
}

function review(p) {
  proposal = p;
  code = null;
  show(p);
  at("review");
  $("send").disabled = true;
  if (document.body.classList.contains("read-only")) {
    say("Of a recording: nothing can be sent.");
    return;
  }
  say("Look it over, then arm.");
  $("arm").disabled = false;
  $("arm").focus({ preventScroll: false });
}

async function attempt(button, work) {
  button.disabled = true;
  try {
    await work();
  } catch (error) {
    say(error.message, true);
  } finally {
    if (button.id === "propose") button.disabled = false;
  }
}

function unarm(text) {
  clearTimeout(disarm);
  code = null;
  $("send").disabled = true;
  $("arm").disabled = proposal === null;
  if (text) say(text);
}

export function start() {
  $("controls").addEventListener("submit", (event) => {
    event.preventDefault();
    attempt($("propose"), async () => {
      say("Working it out for the whole table …");
      review(await call("/api/propose", { changes: settings() }));
    });
  });
  $("arm").addEventListener("click", () => attempt($("arm"), async () => {
    const answer = await call("/api/arm", { proposal: proposal.proposal, seen_sample: seen() });
    code = answer.code;
    at("arm");
    say(`Armed for ${answer.seconds} s.`);
    $("send").disabled = false;
    $("send").focus();
    clearTimeout(disarm);
    disarm = setTimeout(() => unarm("No longer armed."), 1000 * answer.seconds);
  }));
  $("send").addEventListener("click", () => attempt($("send"), async () => {
    clearTimeout(disarm);
    sentAfter = seen();
    await call("/api/send", { proposal: proposal.proposal, code, seen_sample: seen() });
    at("send");
    say("Sent; waiting for the rig's answer.");
    $("audit").replaceChildren();
    proposal = null;
  }));
  $("revert").addEventListener("click", () => attempt($("revert"), async () => {
    sentAfter = seen();
    await call("/api/revert", { seen_sample: seen() });
    unarm();
    at("send");
    say("Going back to the gains before.");
    $("audit").replaceChildren();
  }));
  $("on").addEventListener("click", () => attempt($("on"), async () => {
    sentAfter = seen();
    await call("/api/on", { seen_sample: seen() });
    say("Control on: sent.");
  }));
  const off = async () => {
    if (document.body.classList.contains("read-only")) return;
    emergency("Switching control off …", "warn");
    offSent = null;
    try {
      const answer = await call("/api/off", {}, AbortSignal.timeout(3000));
      offSent = { command: answer.command_id, at: performance.now() };
      unarm();
      put("said", "Control off sent.");
    } catch (error) {
      emergency(`Control off did NOT reach the station (${error.message}). Use the switch at the rig.`, "bad");
    }
  };
  $("off").addEventListener("click", off);
  document.addEventListener("keydown", (event) => event.key === "Escape" && event.shiftKey && off());
  $("standing").addEventListener("click", (event) => {
    if (event.target.tagName !== "BUTTON") return;
    attempt(event.target, async () => review(await call("/api/review", { standing: Number(event.target.dataset.number) })));
  });
}

// What an emergency stop came to stays on the screen until control is on again.
let offSent = null, confirmed = false;
function emergency(text, level) {
  const box = $("emergency");
  if (box.textContent === text) return;
  box.replaceChildren(...(text ? [node("p", text, level)] : []));
}

function followOff(s) {
  if (offSent === null) {
    if (confirmed && s.control_on) { confirmed = false; emergency("", ""); }
    return;
  }
  const late_s = (performance.now() - offSent.at) / 1000;
  if (s.control_on === false && s.acknowledged >= offSent.command) {
    emergency(`✓ Control is off; the rig confirms it (command ${offSent.command}).`, "good");
    offSent = null;
    confirmed = true;
  } else if (s.refusal?.command_id === offSent.command) {
    emergency(`The rig refused to switch control off: ${s.refusal.reason}. Use the switch at the rig.`, "bad");
    offSent = null;
  } else if (late_s > 1.5) emergency(`Control off was sent ${Math.round(late_s)} s ago and the rig has not confirmed it. Use the switch at the rig.`, "bad");
  else emergency(`Control off sent (command ${offSent.command}); waiting for the rig …`, "warn");
}
setInterval(() => { if (offSent !== null) followOff({ control_on: null }); }, 500);

export function follow(s) {
  followOff(s);
  $("on").disabled = s.control_on === true;
  $("revert").disabled = !s.can_revert;
  const standing = $("standing"), mine = s.standing;
  if (!mine) drop(standing, s.approve === false ? "The twin sends verified proposals by itself." : "");
  else if (standing.dataset.number !== String(mine.number)) {
    standing.dataset.number = String(mine.number);
    const button = node("button", `Review the twin's proposal ${mine.number}`, "quiet");
    button.dataset.number = String(mine.number);
    const held = standing.querySelector("button");
    const focused = held === document.activeElement;
    standing.replaceChildren(button, document.createTextNode(` ${mine.points} points, ${number(mine.from_hz, 4)} to ${number(mine.to_hz, 4)} Hz`));
    if (focused) button.focus();
  }
  const sent = s.sent;
  if (sentAfter !== null && sent && sent.state !== "sent" && (sent.at_sample === null || sent.at_sample > sentAfter)) {
    if (sent.state === "refused") say(`The rig refused command ${sent.command_id}: ${sent.reason}`, true);
    else {
      say(`Command ${sent.command_id} acknowledged at sample ${sent.at_sample}.`);
      if (step === "send") at("ack");
    }
    sentAfter = null;
  }
  if (s.audit && (step === "ack" || step === "audit")) {
    at("audit");
    const a = s.audit, list = node("dl", "", "figures");
    const add = (name, pair, unit, f, note = "") => list.append(node("dt", name), node("dd", `${f(pair[0])} → ${f(pair[1])} ${unit}${note}`));
    const small = Math.max(...a.displacement_m) < a.floor_m;
    add(`motion at ${number(a.frequency_hz, 4)} Hz, predicted → achieved`, a.displacement_m, "µm", micro, small ? ` (both below ${micro(a.floor_m)} µm, less than can be told yet)` : "");
    add("mean Joule power, predicted → achieved", a.joule_mean_w, "W", watts);
    $("audit").replaceChildren(list);
  }
}
