// The page: events of the node in, cards and canvas out. Connects again by itself.

import { Cards } from "./cards.js";
import { Session, readMap } from "./state.js";
import { View } from "./view.js";

const RETRY_MS = 1500;
const QUIET_MS = 4000; // without any sign of life: the server sends one every second
const CARDS_MS = 250;
const KINDS = ["pose", "status", "hypotheses", "scan", "trail"];
const $ = (id) => document.getElementById(id);

const session = new Session();
const view = new View($("map"), session);
const cards = new Cards($("cards"), (name) => view.setFollow(view.follow === name ? null : name));
view.onFollow = () => { cardsDue = 0; };

// ---- connection

let source = null;
let heard = 0;
let retryAt = 0;

function connect() {
  source?.close();
  source = new EventSource("events");
  heard = performance.now();
  source.addEventListener("open", () => { heard = performance.now(); });
  source.addEventListener("tick", () => { heard = performance.now(); });
  source.addEventListener("map", (event) => { heard = performance.now(); loadMap(JSON.parse(event.data).sha256); });
  for (const kind of KINDS) {
    source.addEventListener(kind, (event) => {
      heard = performance.now();
      session.take(kind, JSON.parse(event.data), heard);
    });
  }
  source.addEventListener("error", () => {
    if (source.readyState === EventSource.CLOSED) retryAt = performance.now() + RETRY_MS; // it has given up; we have not
  });
}

function keepConnected(now) {
  if ((retryAt && now >= retryAt) || now - heard > 2 * QUIET_MS) {
    retryAt = 0;
    connect();
  }
  const open = source.readyState === EventSource.OPEN && now - heard < QUIET_MS;
  const link = open ? "open" : heard && session.robots.size ? "lost" : "waiting";
  if ($("link").dataset.link !== link) $("link").dataset.link = link;
  say($("link"), { open: "live", lost: "connection lost, trying again", waiting: "connecting" }[link]);
}

async function loadMap(sha256) {
  if (session.maps.has(sha256)) return;
  try {
    const answer = await fetch(`map/${encodeURIComponent(sha256)}`);
    if (!answer.ok) return; // it is kept no more
    session.maps.set(sha256, { map: readMap(await answer.arrayBuffer()) });
  } catch { // the connection broke, and a new one may bring another map
    setTimeout(() => loadMap(sha256), 2 * RETRY_MS);
    return;
  }
  if (session.maps.size === 1) view.fitAll();
}

// ---- what is said

const told = new Map(); // states, by robot

function describe(now) {
  const robots = [...session.robots.values()];
  $("nobody").hidden = robots.length > 0;
  const tracking = robots.filter((robot) => robot.located(now)).length;
  say($("summary"), robots.length ? `${tracking} of ${robots.length} ${robots.length === 1 ? "robot" : "robots"} located` : "");
  const entry = view.map();
  const other = robots.find((robot) => robot.status.map_sha256 && entry && robot.status.map_sha256 !== entry.map.map_sha256);
  let notice = "";
  if (!robots.length) notice = "waiting for a node";
  else if (!entry) notice = "no map yet";
  else if (other) notice = `${other.name} is served on another map than the one shown`;
  say($("notice"), notice);
  for (const robot of robots) {
    const state = robot.state(now);
    if (told.get(robot.name) !== state) {
      if (told.has(robot.name)) say($("live"), `${robot.name}: ${state}. ${robot.status.reason || ""}`);
      told.set(robot.name, state);
    }
  }
}

function say(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function showCursor() {
  if (!view.cursor) return say($("cursor"), "");
  const [x, y] = view.toMap(...view.cursor);
  say($("cursor"), `${x.toFixed(2)}, ${y.toFixed(2)} m`);
}

// ---- themes

const THEMES = ["system", "light", "dark"];
const dark = matchMedia("(prefers-color-scheme: dark)");
let theme = "system";
try { theme = localStorage.getItem("theme") || theme; } catch { /* storage may be switched off */ }

function applyTheme() {
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  view.theme = theme === "system" ? (dark.matches ? "dark" : "light") : theme;
  say($("theme"), `theme: ${theme}`);
  session.changed = true;
}

function nextTheme() {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  try { localStorage.setItem("theme", theme); } catch { /* as above */ }
  applyTheme();
}

// ---- controls

for (const what of ["scan", "trail", "hypotheses"]) {
  $(`show-${what}`).addEventListener("change", (event) => {
    view.show[what] = event.target.checked;
    session.changed = true;
  });
}
$("fit").addEventListener("click", () => { view.setFollow(null); view.fitAll(); });
$("zoom-in").addEventListener("click", () => view.zoom(1.4));
$("zoom-out").addEventListener("click", () => view.zoom(1 / 1.4));
$("theme").addEventListener("click", nextTheme);
dark.addEventListener("change", applyTheme);
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "INPUT") return;
  const step = 60;
  const moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  if (moves[event.key] && event.target === $("map")) { view.setFollow(null); view.pan(...moves[event.key]); }
  else if (event.key === "+" || event.key === "=") view.zoom(1.4);
  else if (event.key === "-") view.zoom(1 / 1.4);
  else if (event.key === "f") $("fit").click();
  else if (event.key === "t") nextTheme();
  else return;
  event.preventDefault();
});

// ---- the loop

let cardsDue = 0;

function loop() {
  requestAnimationFrame(loop); // first: what goes wrong with one picture does not end them all
  const now = performance.now();
  if (now >= cardsDue) {
    cardsDue = now + CARDS_MS;
    keepConnected(now);
    cards.update(session.robots, now, view.follow);
    describe(now);
    showCursor();
    session.changed = true; // states change by silence, too
  }
  if (session.changed) {
    session.changed = false;
    if (!view.placed) view.fitAll();
    view.draw(now);
  }
}

applyTheme();
connect();
loop();
