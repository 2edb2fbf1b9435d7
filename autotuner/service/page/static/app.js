// The page: which view stands behind which address, what runs now, and the abort that is always in reach.

import { Problem, get, onTokenWanted, post } from "./api.js";
import { fill, h, problemBox } from "./dom.js";
import { auditView } from "./views/audit.js";
import { compareView } from "./views/compare.js";
import { historyView } from "./views/history.js";
import { loopView } from "./views/loop.js";
import { loopsView } from "./views/loops.js";
import { tuningView } from "./views/tuning.js";
import { uploadView } from "./views/upload.js";

const POLL_MS = 2000;
const ROUTES = [
  [/^\/?$/, loopsView, "loops", () => "Loops"],
  [/^\/loops\/(.+)$/, loopView, "loops", (name) => name],
  [/^\/tunings$/, historyView, "tunings", () => "History"],
  [/^\/tunings\/([^/]+)$/, tuningView, "loops", (id) => `Tuning ${id}`],
  [/^\/compare\/([^/]+)\/([^/]+)$/, compareView, "tunings", () => "Comparison"],
  [/^\/upload$/, uploadView, "upload", () => "Upload"],
  [/^\/audit(?:\/(.+))?$/, auditView, "audit", (loop) => (loop ? `Audit log of ${loop}` : "Audit log")],
];

const main = document.getElementById("main");
const running = document.getElementById("running");
const link = document.getElementById("link");
let leave = new AbortController();

/** Show the view of the address; what the one before has under way ends. */
async function show() {
  leave.abort();
  leave = new AbortController();
  const { signal } = leave;
  const path = location.hash.slice(1);
  const [pattern, view, section, title] = ROUTES.find(([candidate]) => candidate.test(path)) ?? ROUTES[0];
  const parts = (path.match(pattern) ?? []).slice(1).filter(Boolean).map(decodeURIComponent);
  for (const anchor of document.querySelectorAll("[data-nav]")) {
    if (anchor.dataset.nav === section) anchor.setAttribute("aria-current", "page");
    else anchor.removeAttribute("aria-current");
  }
  document.title = `${title(...parts)} – relay-autotuner`;
  const root = h("div", {});
  fill(main, root);
  try {
    await view(root, signal, ...parts);
  } catch (error) {
    if (!signal.aborted) root.append(problemBox(error));
  }
}

/** Keep the strip of running tunings up to date: whoever looks at anything else can still abort. */
async function watch() {
  for (;;) {
    if (!document.hidden) await look();
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

async function look() {
  try {
    const { loops } = await get("/v1/loops");
    strip(loops.filter((loop) => loop.tuning_id && location.hash !== `#/tunings/${loop.tuning_id}`));
    say(...await readiness());
  } catch (error) {
    say(error instanceof Problem && error.status ? "refused" : "no connection", true);
  }
}

/** What a start would meet now, as `/readyz` and `/metrics` tell it: a text, and whether it is bad news. */
async function readiness() {
  try {
    const down = (await get("/readyz")).loops.filter((loop) => loop.link === "down").map((loop) => loop.loop);
    return [down.length > 1 ? `${down.length} loops down` : down.length ? `${down[0]} down` : "ready", down.length > 0];
  } catch (error) {
    if (!error.status) throw error;
    return [`not ready: ${error.title}`, true];
  }
}

function say(text, lost) {
  if (link.textContent !== text) link.textContent = text;
  link.classList.toggle("lost", lost);
}

function strip(loops) {
  const ids = loops.map((loop) => loop.tuning_id).join();
  if (running.dataset.ids === ids) return;
  running.dataset.ids = ids;
  fill(running, loops.map((loop) => h("div", { class: "strip", role: "status" },
    h("span", { class: "what" }, h("strong", {}, loop.name), " is under test: its output or set point is moved. ", h("a", { href: `#/tunings/${loop.tuning_id}` }, "Show")),
    h("button", { class: "abort", "data-abort": loop.tuning_id, onclick: (event) => abort(event.target, loop) }, `Abort ${loop.name}`))));
}

async function abort(button, loop) {
  button.disabled = true;
  button.textContent = "Restoring …";
  try {
    await post(`/v1/tunings/${loop.tuning_id}/abort`);
  } catch (error) {
    button.disabled = false;
    button.textContent = `Abort ${loop.name}`;
    if (error.status !== 409) main.prepend(problemBox(error));
  }
}

onTokenWanted((refused) => {
  askToken.pending ??= new Promise((resolve) => askToken(resolve, refused)).finally(() => { askToken.pending = null; });
  return askToken.pending;
});

function askToken(resolve, refused) {
  const field = h("input", { type: "password", autocomplete: "off", required: true, id: "token", "aria-describedby": "token-hint" });
  const dialog = h("dialog", { "aria-labelledby": "token-title" },
    h("form", { method: "dialog", onsubmit: () => { resolve(field.value.trim()); dialog.remove(); } },
      h("h2", { id: "token-title" }, "Token"),
      refused ? h("p", { class: "notice bad", role: "alert" }, "That token is not valid, or not any more.") : null,
      h("label", { for: "token" }, "Your access token"), field,
      h("p", { class: "hint small muted", id: "token-hint" }, "Made by `autotuner token add NAME --role viewer|operator` on the machine of the service. It is kept until this tab is closed."),
      h("div", { class: "row end" }, h("button", { class: "main" }, "Use it"))));
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  document.body.append(dialog);
  dialog.showModal();
}

window.addEventListener("hashchange", () => { show(); look(); main.focus(); window.scrollTo(0, 0); });
window.addEventListener("tunings-changed", look);
show();
watch();
