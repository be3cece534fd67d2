// Proposal, review, arm, send, acknowledged, achieved; revert; on and off.
import { call, drop, micro, number, put, seen, settings } from "/page/page.js";

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

function price(l) {
  if (l.price === null) return l.name;
  const unit = { "joule mean": "µm/W", power: "µm/W", electrical: "µm/W", current: "µm/A", voltage: "µm/V", stroke: "µm/mm" }[l.name];
  return unit ? `${l.name} (${number(1e6 * l.price * (l.name === "stroke" ? 1e-3 : 1), 2)} ${unit})` : l.name;
}

function show(p) {
  const box = $("review");
  box.replaceChildren();
  const list = node("dl", "", "figures");
  const add = (name, value) => list.append(node("dt", name), node("dd", value));
  const kind = (k) => k.replace("_", " ");
  add("source", `${p.source}, proposal ${p.proposal}`);
  const g = p.goal, b = p.goal_before;
  add("budget", g.budget_w === b.budget_w && g.budget_kind === b.budget_kind ? `${number(g.budget_w)} W ${kind(g.budget_kind)}` : `${number(b.budget_w)} W ${kind(b.budget_kind)} → ${number(g.budget_w)} W ${kind(g.budget_kind)}`);
  if (g.modulus_margin !== b.modulus_margin) add("margin wanted", `${b.modulus_margin} → ${g.modulus_margin}`);
  add("control acts", `${p.window_hz[0]} to ${p.window_hz[1]} Hz`);
  add("worst motion", p.worst_m === null ? "–" : `${micro(p.worst_m)} µm`);
  add("highest power", p.worst_w === null ? "–" : `${number(p.worst_w)} W`);
  add("least modulus margin", number(p.least_modulus_margin, 2));
  add("least delay margin", p.least_delay_margin_s === null ? "over 8 ms" : `${number(1e6 * p.least_delay_margin_s, 2)} µs`);
  const limits = new Map();
  for (const r of p.rows) for (const l of r.limits) if (!limits.has(l.name)) limits.set(l.name, price(l));
  add("what binds", limits.size ? [...limits.values()].join(", ") : "nothing");
  add("steps on the way", String(p.steps));
  add("model", p.model_id.slice(0, 8));
  box.append(list);
  if (p.without.length) box.append(node("p", `No better gains at ${p.without.join(", ")} Hz: ${p.rows.find((r) => r.displacement_m === null).reason} Those points keep theirs.`, "hint"));
  if (!p.changes_anything) box.append(node("p", "It changes nothing: the gains in use are as good.", "hint"));
  const frame = node("div", "", "scroll");
  frame.tabIndex = 0;
  const table = document.createElement("table");
  const head = table.createTHead().insertRow();
  for (const name of ["Hz", "γ [N/mm]", "β [Ns/m]", "motion [µm]", "W", "margin"]) head.append(Object.assign(node("th", name, "n"), { scope: "col" }));
  const body = table.createTBody();
  for (const r of p.rows) {
    const row = body.insertRow();
    const pair = ([from, to], scale = 1) => (from === to ? number(scale * from) : `${number(scale * from)} → ${number(scale * to)}`);
    const cells = [number(r.frequency_hz, 4), pair(r.gains.gamma_n_m, 1e-3), pair(r.gains.beta_ns_m), `${r.in_use_m != null ? `${micro(r.in_use_m)} → ` : ""}${micro(r.displacement_m)}`, number(r.power_w), number(r.modulus_margin, 2)];
    for (const text of cells) row.append(node("td", text, "n"));
  }
  frame.append(table);
  box.append(frame);
}

function review(p) {
  proposal = p;
  code = null;
  show(p);
  at("review");
  say("Look it over, then arm.");
  $("arm").disabled = false;
  $("send").disabled = true;
}

async function attempt(button, work) {
  button.disabled = true;
  try {
    await work();
  } catch (error) {
    say(error.message, true);
  } finally {
    if (button.id === "propose" || button.id === "on") button.disabled = false;
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
    try {
      const answer = await call("/api/off", {});
      unarm();
      say(`Control off: command ${answer.command_id} sent.`);
      put("said", "Control off sent.");
    } catch (error) {
      say(error.message, true);
    }
  };
  $("off").addEventListener("click", off);
  document.addEventListener("keydown", (event) => event.key === "Escape" && event.shiftKey && off());
  $("standing").addEventListener("click", (event) => {
    if (event.target.tagName !== "BUTTON") return;
    attempt(event.target, async () => review(await call("/api/review", { standing: Number(event.target.dataset.number) })));
  });
}

export function follow(s) {
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
    add(`motion at ${number(a.frequency_hz, 4)} Hz, predicted → achieved`, a.displacement_m, "µm", micro, small ? ` (both below ${micro(a.floor_m)} µm, less than can be told)` : "");
    add("mean Joule power, predicted → achieved", a.joule_mean_w, "W", number);
    $("audit").replaceChildren(list);
  }
}
