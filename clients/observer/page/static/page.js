// The status page: draws the state of `feed.js`; every text of the daemon becomes a text node.
import { renderDemands } from "/demands.js";
import { renderEvictions } from "/evictions.js";
import { Feed } from "/feed.js";
import { $, bytes, clock, el, plural, setText, whole } from "/format.js";
import { drawCharts, onRange, renderGpus } from "/gpus.js";
import { announce, onOlder, renderHistory } from "/history.js";
import { countTimes, renderLeases } from "/leases.js";
import { countWaits, renderQueue } from "/queue.js";

const due = new Set();
let planned = false;

function plan(...parts) {
  parts.forEach((part) => due.add(part));
  if (planned) return;
  planned = true;
  requestAnimationFrame(() => {
    planned = false;
    render();
  });
}

const NEEDS = {
  link: ["link"],
  snapshot: ["link", "gpus", "leases", "queue", "demands"],
  page: ["leases", "queue"],
  waits: ["queue"],
  usage: ["gpus"],
  history: ["history"],
};
const feed = new Feed((name) => plan(...NEEDS[name]));

function render() {
  const parts = new Set(due);
  due.clear();
  if (parts.has("link")) renderLink();
  if (!feed.status) return;
  if (parts.has("gpus")) renderGpus(feed);
  if (parts.has("queue")) renderQueue(feed);
  if (parts.has("leases")) renderLeases(feed);
  if (parts.has("demands")) renderDemands(feed);
  if (parts.has("history")) {
    renderHistory(feed);
    announce(feed);
  }
  if (parts.has("history") || parts.has("clock")) renderEvictions(feed);
  if (parts.has("clock")) tick();
}

function renderLink() {
  const { status } = feed,
    link = $("link");
  const state = feed.live ? "live" : feed.heardWall ? "stale" : "wait";
  link.dataset.state = state;
  const why = feed.problem ? `: ${feed.problem}` : "";
  setText(
    link,
    {
      live: "live",
      wait: `connecting …${why}`,
      stale: `stale since ${clock(feed.heardWall ?? 0)}, reconnecting${why}`,
    }[state],
  );
  document.body.classList.toggle("stale", state === "stale");
  if (!status) return;
  setText(
    $("server"),
    `${status.phase} · up ${whole(feed.uptime)} · ${plural(status.clients, "client")}` +
      (status.host_ram.parked_bytes
        ? ` · ${bytes(status.host_ram.parked_bytes)} parked in host RAM`
        : ""),
  );
  const told = [
    ...(status.drained ? [`Drained by ${status.drained}: nothing is granted until resume.`] : []),
    ...status.problems,
  ];
  const banners = $("banners");
  if (banners.dataset.told !== JSON.stringify(told)) {
    banners.dataset.told = JSON.stringify(told);
    banners.replaceChildren(...told.map((text) => el("p.banner", text)));
  }
}

function tick() {
  countTimes(feed);
  countWaits(feed);
  drawCharts(feed);
}

// The sections take their own clicks first: each plans the part that it changes.
for (const [id, part] of [
  ["filters", "history"],
  ["event-more", "history"],
  ["eviction-more", "history"],
  ["lease-more", "leases"],
])
  $(id).addEventListener(id === "filters" ? "input" : "click", () => plan(part));
onRange(() => plan("gpus"));
onOlder(feed);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plan("gpus"));
addEventListener("resize", () => plan("gpus"));
setInterval(() => {
  if (!document.hidden && feed.live) plan("clock");
}, 1000);
