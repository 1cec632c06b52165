// What is watched, at which time, and how often it is requested.

import { BlocksPage } from "./blocks.js";
import { make, shown } from "./draw.js";
import { SessionPage } from "./session.js";

const KINDS = {
  live: { name: "live run", page: BlocksPage },
  session: { name: "closed loop", page: SessionPage, seeks: true },
  training: { name: "training", page: BlocksPage },
  study: { name: "study", page: BlocksPage },
  cultures: { name: "study over cultures", page: BlocksPage },
  tuning: { name: "tuning", page: BlocksPage },
  recording: { name: "recordings", page: BlocksPage, seeks: true },
};
// From the start of one look to the next, and after a look at something that does not change.
const LIVE_MS = 200, SETTLED_MS = 1000, THINGS_MS = 3000;
const $ = (id) => document.getElementById(id);

let thing = null, about = null, page = null, view = null;
let picked = false;
let following = true, to = null, span = 8, asking = false, timer = 0, again = false;

// The outputs of a study are part of it, as are the recordings of a live run; its closed loop is worth its own page.
function isPartOf(whole, item) {
  if (whole?.kind === "live" && item.kind === "session") return false;
  return ["study", "cultures", "tuning", "live"].includes(whole?.kind) && item.kind !== whole.kind && (!whole.place || item.place.startsWith(`${whole.place}/`));
}

function urlOf(path, more = {}) {
  const query = new URLSearchParams({ ...(thing ? { kind: thing.kind, in: thing.place } : {}), ...more });
  return `${path}?${query}`;
}

async function request(path, more, options = {}) {
  const response = await fetch(urlOf(path, more), { ...options, cache: "no-store" });
  const type = response.headers.get("content-type") ?? "";
  const content = type.startsWith("application/json") ? await response.json() : { error: await response.text() };
  if (!response.ok) throw new Error(content.error ?? `status ${response.status}`);
  return content;
}

function showError(message) {
  $("trouble").hidden = !message;
  if ($("trouble").textContent !== message) $("trouble").textContent = message;
}

async function look() {
  if (asking) { again = true; return; }
  asking = true;
  again = false;
  const item = thing, began = performance.now();
  try {
    if (item) await lookAt(item);
    showError("");
  } catch (error) {
    if (item === thing) showError(error instanceof TypeError ? "the page's server does not respond: it was ended, or its machine is asleep. What it showed continues without it; a session is stopped by a file STOP in its folder." : error.message);
  }
  asking = false;
  clearTimeout(timer);
  const settled = !view || view.state !== "running" || !following;
  const busy = view && (view.summed < 1 || !(view.is_found ?? true));
  timer = setTimeout(look, again || busy ? 20 : settled ? SETTLED_MS : Math.max(20, LIVE_MS - (performance.now() - began)));
}

async function lookAt(item) {
  if (!about) {
    const content = await request("about");
    if (item !== thing) return;
    about = content;
    $("main").replaceChildren();
    page = new KINDS[item.kind].page($("main"), about, urlOf);
    $("title").textContent = about.title;
    document.title = `${about.title} – animat watch`;
  }
  const content = await request("view", { span, ...(following || to === null ? {} : { to }) });
  if (item !== thing) return;
  if (content.generation !== about.generation) { about = null; again = true; return; }
  view = content;
  page.draw(view);
  showState();
}

function showState() {
  const state = { running: "● running", ended: "■ ended", silent: "▲ silent" }[view.state] ?? "";
  const line = `${state}${view.message ? `: ${view.message}` : ""}${view.damage ? `; ${view.damage}` : ""}`;
  if ($("state").textContent !== line) $("state").textContent = line;
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
    const content = await request("things", {});
    $("folder").textContent = content.folder;
    const key = (item) => `${item.kind} ${item.place}`;
    const listed = [...content.things].sort((a, b) => (key(a) < key(b) ? -1 : 1));
    const known = [...$("things").options].map((option) => option.value).join("\n");
    if (known !== listed.map(key).join("\n")) {
      const before = new Set(known.split("\n"));
      $("things").replaceChildren(...listed.map((item) => make("option", { value: key(item), textContent: `${KINDS[item.kind].name}${item.place ? `: ${item.place}` : ""}` })));
      $("things").things = listed;
      if (thing) $("things").value = key(thing);
      // Show the newest item, unless the user has chosen one.
      const fresh = content.things.find((item) => !before.has(key(item)) && !isPartOf(thing, item));
      if (thing && fresh && !picked) choose(fresh);
    }
    $("choose").hidden = content.things.length < 2;
    const [newest] = content.things;
    const [outermost] = content.things.filter((item) => isPartOf(item, newest)).sort((a, b) => a.place.length - b.place.length);
    if (!thing && newest) choose(outermost ?? newest);
    if (!thing) $("main").replaceChildren(make("p", { className: "words", textContent: `${content.folder} holds nothing to watch yet: no session, training, live run, study, tuning or recording. It is checked again every few seconds.` }));
  } catch {
    // With an item shown, `look` reports the error.
    if (!thing) showError("the page's server does not respond");
  }
  setTimeout(things, THINGS_MS);
}

function choose(item) {
  thing = item;
  about = page = view = null;
  following = true;
  to = null;
  $("things").value = `${item.kind} ${item.place}`;
  // Nothing of the previous item may be mistaken for this one's. A session can be stopped even if it cannot be shown.
  $("controls").hidden = true;
  $("stop").hidden = item.kind !== "session";
  $("stop").disabled = false;
  $("stop").textContent = "Stop the session";
  $("title").textContent = KINDS[item.kind].name;
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
    await request("stop", {}, { method: "POST" });
  } catch (error) {
    showError(`it could not be stopped from here: ${error.message}. Create a file STOP in its folder, or press Ctrl-C where it runs.`);
  }
  look();
});
addEventListener("resize", () => { if (view && page) page.draw(view); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (view && page) setTimeout(() => page.draw(view), 0); });
things();
look();
