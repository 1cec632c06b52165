// What is watched, when, and how often it is asked for.

import { BlocksPage } from "./blocks.js";
import { make, shown } from "./draw.js";
import { SessionPage } from "./session.js";

const KINDS = {
  session: { name: "closed loop", page: SessionPage, seeks: true },
  training: { name: "training", page: BlocksPage },
  study: { name: "study", page: BlocksPage },
  cultures: { name: "study over cultures", page: BlocksPage },
  tuning: { name: "tuning", page: BlocksPage },
  recording: { name: "recordings", page: BlocksPage, seeks: true },
};
// From the start of a look to that of the next, and after a look at what does not change.
const LIVE_MS = 200, SETTLED_MS = 1000, THINGS_MS = 3000;
const $ = (id) => document.getElementById(id);

let thing = null, about = null, page = null, view = null;
let picked = false;
let following = true, to = null, span = 8, asking = false, timer = 0, again = false;

// What a study makes is part of it.
function isPartOf(whole, each) {
  return ["study", "cultures", "tuning"].includes(whole?.kind) && each.kind !== whole.kind && (!whole.place || each.place.startsWith(`${whole.place}/`));
}

function ask(path, more = {}) {
  const words = new URLSearchParams({ ...(thing ? { kind: thing.kind, in: thing.place } : {}), ...more });
  return `${path}?${words}`;
}

async function fetched(path, more, options = {}) {
  const answer = await fetch(ask(path, more), { ...options, cache: "no-store" });
  const type = answer.headers.get("content-type") ?? "";
  const said = type.startsWith("application/json") ? await answer.json() : { error: await answer.text() };
  if (!answer.ok) throw new Error(said.error ?? `status ${answer.status}`);
  return said;
}

function trouble(words) {
  $("trouble").hidden = !words;
  if ($("trouble").textContent !== words) $("trouble").textContent = words;
}

async function look() {
  if (asking) { again = true; return; }
  asking = true;
  again = false;
  const of = thing, began = performance.now();
  try {
    if (of) await lookAt(of);
    trouble("");
  } catch (error) {
    if (of === thing) trouble(error instanceof TypeError ? "the page's server does not answer: it was ended, or its machine sleeps. What it showed goes on without it; a session is stopped by a file STOP in its folder." : error.message);
  }
  asking = false;
  clearTimeout(timer);
  const settled = !view || view.state !== "running" || !following;
  const busy = view && (view.summed < 1 || !(view.is_found ?? true));
  timer = setTimeout(look, again || busy ? 20 : settled ? SETTLED_MS : Math.max(20, LIVE_MS - (performance.now() - began)));
}

async function lookAt(of) {
  if (!about) {
    const found = await fetched("about");
    if (of !== thing) return;
    about = found;
    $("main").replaceChildren();
    page = new KINDS[of.kind].page($("main"), about, ask);
    $("title").textContent = about.title;
    document.title = `${about.title} – animat watch`;
  }
  const found = await fetched("view", { span, ...(following || to === null ? {} : { to }) });
  if (of !== thing) return;
  if (found.generation !== about.generation) { about = null; again = true; return; }
  view = found;
  page.draw(view);
  tellState();
}

function tellState() {
  const words = { running: "● running", ended: "■ ended", silent: "▲ silent" }[view.state] ?? "";
  const told = `${words}${view.message ? `: ${view.message}` : ""}${view.damage ? `; ${view.damage}` : ""}`;
  if ($("state").textContent !== told) $("state").textContent = told;
  const canStop = thing.kind === "session";
  $("stop").hidden = !canStop;
  $("stop").disabled = view.state === "ended" || view.stop;
  $("stop").textContent = view.stop && view.state === "running" ? "Stopping…" : "Stop the session";
  $("controls").hidden = !KINDS[thing.kind].seeks;
  if (!KINDS[thing.kind].seeks) return;
  $("seek").max = String(view.end_s);
  if (following) $("seek").value = String(view.end_s);
  $("clock").textContent = `${shown(Math.round(view.to_s * 10) / 10, 8)} of ${shown(Math.round(view.end_s * 10) / 10, 8)} s`;
  $("pause").textContent = following ? "Pause" : "Follow";
}

async function things() {
  try {
    const found = await fetched("things", {});
    $("folder").textContent = found.folder;
    const key = (each) => `${each.kind} ${each.place}`;
    const listed = [...found.things].sort((a, b) => (key(a) < key(b) ? -1 : 1));
    const known = [...$("things").options].map((each) => each.value).join("\n");
    if (known !== listed.map(key).join("\n")) {
      const before = new Set(known.split("\n"));
      $("things").replaceChildren(...listed.map((each) => make("option", { value: key(each), textContent: `${KINDS[each.kind].name}${each.place ? `: ${each.place}` : ""}` })));
      $("things").things = listed;
      if (thing) $("things").value = key(thing);
      // What came last is what goes on, unless somebody chose.
      const fresh = found.things.find((each) => !before.has(key(each)) && !isPartOf(thing, each));
      if (thing && fresh && !picked) choose(fresh);
    }
    $("choose").hidden = found.things.length < 2;
    const [newest] = found.things;
    const [outermost] = found.things.filter((each) => isPartOf(each, newest)).sort((a, b) => a.place.length - b.place.length);
    if (!thing && newest) choose(outermost ?? newest);
    if (!thing) $("main").replaceChildren(make("p", { className: "words", textContent: `${found.folder} holds nothing to watch yet: no session, training, study, tuning or recording. It is looked at again every few seconds.` }));
  } catch {
    // Said where it is looked at.
    if (!thing) trouble("the page's server does not answer");
  }
  setTimeout(things, THINGS_MS);
}

function choose(one) {
  thing = one;
  about = page = view = null;
  following = true;
  to = null;
  $("things").value = `${one.kind} ${one.place}`;
  // Nothing of what was shown before may be taken for this one's.
  $("stop").hidden = $("controls").hidden = true;
  $("title").textContent = KINDS[one.kind].name;
  $("state").textContent = "reading…";
  $("main").replaceChildren();
  look();
}

$("things").addEventListener("change", () => { picked = true; choose($("things").things[$("things").selectedIndex]); });
$("seek").addEventListener("input", () => { following = false; to = Number($("seek").value); look(); });
$("pause").addEventListener("click", () => {
  following = !following;
  to = following ? null : view?.to_s ?? null;
  look();
});
for (const seconds of [1, 2, 4, 8, 20, 60]) $("span").append(make("option", { value: String(seconds), textContent: `${seconds} s`, selected: seconds === span }));
$("span").addEventListener("change", () => { span = Number($("span").value); look(); });
$("stop").addEventListener("click", async () => {
  $("stop").disabled = true;
  try {
    await fetched("stop", {}, { method: "POST" });
  } catch (error) {
    trouble(`it could not be stopped from here: ${error.message}. Make a file STOP in its folder, or press Ctrl-C where it runs.`);
  }
  look();
});
addEventListener("resize", () => { if (view && page) page.draw(view); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (view && page) setTimeout(() => page.draw(view), 0); });
things();
look();
