import { Compare } from "./compare.js";
import { DevicePage } from "./device.js";
import { Overview, Wall } from "./overview.js";
import { routeOf, Shell } from "./shell.js";
import { session, world } from "./state.js";
import { Stream } from "./stream.js";
import { icon } from "./ui.js";
import { byId, clock, el, setText, timeOf } from "./util.js";

const shell = new Shell();
let view = null;
let shownKey = null;
let isLinked = false;
let state = { problem: "connecting to the daemon", version: "" };

const stream = new Stream(onMessage, (linked) => {
  isLinked = linked;
  showState();
  refreshSession().catch(() => {});
}, () => session.read);

function onMessage(message) {
  if (message.kind === "state") {
    const isRestart = state.epoch && message.epoch && message.epoch !== state.epoch;
    state = message;
    showState();
    if (isRestart) view?.onRestart?.();
  } else if (message.kind === "dropped") {
    const parts = [];
    if (message.messages) parts.push(`${message.messages} messages dropped: this browser is too slow`);
    if (message.samples) parts.push(`${message.samples} samples dropped: imud web is too slow`);
    byId("dropped").hidden = !parts.length;
    setText(byId("dropped"), parts.join("; "));
  } else if (message.kind === "problem") {
    showProblem(message.message);
  } else {
    if (message.kind === "overview") {
      Object.assign(world, message, { isKnown: true });
      clock.offset_s = Date.now() / 1000 - message.now_s;
      shell.draw();
    }
    view?.onMessage(message);
  }
}

function showState() {
  const problem = isLinked ? state.problem : "no connection to imud web; the page tries again";
  setText(byId("daemon"), problem ? "not connected" : `imud ${state.version}`);
  byId("daemon").classList.toggle("bad", Boolean(problem));
  document.body.classList.toggle("stale", Boolean(problem));
  const last = problem && world.isKnown ? ` The last values are from ${timeOf(world.now_s)}.` : "";
  showProblem(session.read || !isLinked ? problem && `No connection to imud: ${problem}.${last}` : "");
}

function showProblem(words) {
  setText(byId("problem"), words);
  byId("problem").hidden = !words;
}

async function refreshSession() {
  const answer = await (await fetch("/api/session")).json();
  const before = session.control;
  Object.assign(session, answer);
  byId("login").hidden = !session.has_token;
  byId("login").replaceChildren(icon(session.control ? "unlock" : "lock"), el("span", { text: session.control ? "Log out" : "Log in" }));
  if (before !== session.control) view?.onSession?.();
  if (!session.read && !byId("login-dialog").open) byId("login-dialog").showModal();
}

byId("login").addEventListener("click", async () => {
  if (!session.control) return byId("login-dialog").showModal();
  await fetch("/api/logout", { method: "POST" });
  location.reload();
});
byId("login-cancel").addEventListener("click", () => byId("login-dialog").close());
byId("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const response = await fetch("/api/login", { method: "POST", body: JSON.stringify({ token: byId("token").value }) });
  const answer = await response.json();
  setText(byId("login-problem"), answer.error ?? "");
  byId("login-problem").hidden = !answer.error;
  if (answer.error) return;
  byId("token").value = "";
  byId("login-dialog").close();
  await refreshSession();
});

const VIEWS = {
  overview: (main) => new Overview(main, stream),
  wall: (main) => new Wall(main, stream),
  compare: (main, route) => new Compare(main, stream, route.name, route.other),
  device: (main, route) => new DevicePage(main, route.name, stream, shell),
};

function show() {
  const route = routeOf();
  shell.draw();
  const key = JSON.stringify([route.what, route.name, route.other]);
  if (key !== shownKey) {
    shownKey = key;
    view?.close();
    const main = byId("main");
    main.replaceChildren();
    byId("bar").hidden = true;
    showState();
    view = VIEWS[route.what](main, route);
    scrollTo(0, 0);
    document.title = route.name ? `${route.name} – imud` : "imud";
    window.imud = { view, stream, session }; // for tests and the browser's console
    if (world.isKnown) view.onMessage({ kind: "overview", ...world });
  }
  view.go?.(route.section, route.item);
}

shell.onTheme = () => view?.onTheme?.();
shell.onPause = () => view?.onPause?.();
addEventListener("hashchange", show);
try {
  await refreshSession();
} catch (error) {
  showProblem(String(error));
}
show();
stream.connect();
