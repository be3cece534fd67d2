// What-if that follows the controls: one question at a time, the newest next, drawn as soon as it is answered.
import { drawCurves, drawDamping } from "/page/charts.js";
import { post, put, settings } from "/page/page.js";

const ANEW_MS = 1000;
const REFINED_MS = 250; // how often points are drawn that the whole search has confirmed or bettered
let asking = false, wanted = null, rest = null;

// The curves for what the controls say by now; `moved` is when a person moved them, if one did.
export function redraw(moved = null) {
  if (!wanted?.moved) wanted = { moved };
  if (!asking) ask();
}

async function ask() {
  asking = true;
  let next = question();
  while (next !== null) {
    const { moved, answer } = next;
    next = null;
    try {
      const lines = linesOf(await answer), first = (await lines.next()).value;
      if (wanted !== null) next = question(); // it is worked out while this one is drawn
      if (first?.points) {
        drawCurves(first);
        await painted();
        tell("redraw", moved);
        say(first);
      } else if (first?.reason) put("whatif-state", first.reason);
      if (first?.points && next === null && wanted === null) refine(first, lines, moved);
      else lines.return();
    } catch (error) {
      if (error.name !== "AbortError") put("whatif-state", error.message);
    }
    if (next === null && wanted !== null) next = question();
  }
  asking = false;
}

function question() {
  const { moved } = wanted;
  wanted = null;
  rest?.return(); // what is still to come of the question before is of no use
  rest = null;
  return { moved, answer: post("/api/whatif", { changes: settings() }) };
}

// The first curves were sought next to the last ones; what the tuner's whole search finds follows, point by point.
async function refine(curves, lines, moved) {
  rest = lines;
  drawDamping(curves);
  let due = performance.now() + REFINED_MS;
  try {
    for await (const line of lines) {
      if (line.point) curves.points[line.k] = line.point;
      else if (line.reason) put("whatif-state", line.reason);
      if (!line.done && performance.now() < due) continue;
      if (rest !== lines) return;
      drawCurves(curves);
      due = performance.now() + REFINED_MS;
      if (!line.done) continue;
      await painted();
      say(curves);
      if (curves.points.some((p) => p.provisional)) setTimeout(redraw, ANEW_MS); // another question came between
      else tell("complete", moved);
    }
  } catch (error) {
    if (rest === lines) put("whatif-state", error.message);
  }
}

function say(curves) {
  const without = curves.points.filter((p) => p.reason && !p.provisional);
  put("whatif-state", without.length ? `No gains at ${without.length} of ${curves.points.length} frequencies: ${without[0].reason}` : "");
}

// How long it took since the control moved; also kept where a test or a measurement finds it.
function tell(what, moved) {
  document.body.dataset[`${what}s`] = String(Number(document.body.dataset[`${what}s`] ?? 0) + 1);
  if (moved === null) return;
  document.dispatchEvent(new CustomEvent(`curves-${what}`, { detail: performance.now() - moved }));
}

// After the frame with what was drawn has been painted: a message is delivered behind it.
function painted() {
  return new Promise((done) => {
    const shown = new MessageChannel();
    shown.port1.onmessage = () => done();
    const frame = () => shown.port2.postMessage(0);
    if (document.hidden) frame(); // nothing is painted, nothing calls back
    else requestAnimationFrame(frame);
  });
}

async function* linesOf(answer) {
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      const lines = (text + value).split("\n");
      text = lines.pop();
      for (const line of lines) yield JSON.parse(line);
    }
  } finally {
    reader.cancel().catch(() => {}); // an answer may have broken off already
  }
}
