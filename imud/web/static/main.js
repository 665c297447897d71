// The page: selects the view, shows the state of the daemon, and logs in.

import { DevicePage } from "./device.js";
import { Overview } from "./overview.js";
import { Stream } from "./stream.js";
import { el, setText } from "./util.js";

const byId = (id) => document.getElementById(id);
const session = { read: false, control: false, has_token: false, version: "" };
let view = null;
let isLinked = false;
let state = { problem: "connecting to the daemon", version: "" };

const stream = new Stream(onMessage, (linked) => {
  isLinked = linked;
  showState();
  if (linked) refreshSession();
  else refreshSession().catch(() => {});
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
    view?.onMessage(message);
  }
}

function showState() {
  const pill = byId("daemon");
  const problem = isLinked ? state.problem : "no connection to imud web; the page tries again";
  setText(pill, problem ? "not connected" : `imud ${state.version}`);
  pill.className = `pill ${problem ? "bad" : "good"}`;
  document.body.classList.toggle("stale", Boolean(problem));
  showProblem(session.read || !isLinked ? problem : "");
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
  setText(byId("login"), session.control ? "Log out" : "Log in");
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

function show() {
  const [, what, name] = location.hash.split("/");
  view?.close();
  const main = byId("main");
  main.replaceChildren();
  showProblem(state.problem);
  if (what === "device" && name) view = new DevicePage(main, decodeURIComponent(name), stream, session);
  else view = new Overview(main, stream);
  document.title = what === "device" ? `${decodeURIComponent(name)} – imud` : "imud";
  window.imud = { view, stream, session }; // for tests and the browser's console
}

window.addEventListener("hashchange", show);
try {
  await refreshSession();
} catch (error) {
  showProblem(String(error));
}
show();
stream.connect();
