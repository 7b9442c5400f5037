// The status page: draws the state of `feed.js`; every text of the daemon becomes a text node.
import { Chart } from "/chart.js";
import { Feed, USES } from "/feed.js";
import { bytes, chip, clock, el, partClass, partName, plural, setText, span, whole } from "/format.js";
import { evictionsOf, facts } from "/story.js";

const LEASES_SHOWN = 200, WAITERS_SHOWN = 24, EVICTIONS_SHOWN = 5, EVENTS_SHOWN = 120;
const $ = (id) => document.getElementById(id);
const cards = new Map(), rows = new Map(), due = new Set();
const TONES = { held: "good", loading: "warn", revoking: "warn", unloading: "warn", verifying: "warn", queued: "", standby: "", parked: "" };
let minutes = 3, evictionsShown = EVICTIONS_SHOWN, leasesShown = LEASES_SHOWN, eventsShown = EVENTS_SHOWN, announcedAt = 0, announcedSeq = null, planned = false;

function plan(...parts) {
  parts.forEach((part) => due.add(part));
  if (planned) return;
  planned = true;
  requestAnimationFrame(() => { planned = false; render(); });
}

const NEEDS = { link: ["link"], snapshot: ["link", "gpus", "leases", "queue"], page: ["leases", "queue"], change: ["link", "gpus", "leases", "queue"],
  waits: ["queue"], usage: ["gpus"], history: ["history"] };
const feed = new Feed((name) => plan(...NEEDS[name]));

function render() {
  const parts = new Set(due);
  due.clear();
  if (parts.has("link")) renderLink();
  if (!feed.status) return;
  if (parts.has("gpus")) renderGpus();
  if (parts.has("queue")) renderQueue();
  if (parts.has("leases")) renderLeases();
  if (parts.has("history")) { renderHistory(); announce(); }
  if (parts.has("history") || parts.has("clock")) renderEvictions();
  if (parts.has("clock")) tick();
}

function renderLink() {
  const { status } = feed, link = $("link");
  const state = feed.live ? "live" : feed.heardWall ? "stale" : "wait";
  link.dataset.state = state;
  const why = feed.problem ? `: ${feed.problem}` : "";
  setText(link, { live: "live", wait: `connecting …${why}`, stale: `stale since ${clock(feed.heardWall ?? 0)}, reconnecting${why}` }[state]);
  document.body.classList.toggle("stale", state === "stale");
  if (!status) return;
  setText($("server"), `${status.phase} · up ${whole(feed.uptime)} · ${plural(status.clients, "client")}`
    + (status.host_ram.parked_bytes ? ` · ${bytes(status.host_ram.parked_bytes)} parked in host RAM` : ""));
  const told = [...(status.drained ? [`Drained by ${status.drained}: nothing is granted until resume.`] : []), ...status.problems];
  const banners = $("banners");
  if (banners.dataset.told !== JSON.stringify(told)) {
    banners.dataset.told = JSON.stringify(told);
    banners.replaceChildren(...told.map((text) => el("p.banner", text)));
  }
}

// -- GPUs
function cardOf(gpu) {
  if (cards.has(gpu.index)) return cards.get(gpu.index);
  const title = el("h3"), figures = el("p.figures"), block = el("p.block"), bar = el("div.bar"), legend = el("ul.legend");
  const canvas = el("canvas"), output = el("output");
  bar.setAttribute("role", "img");
  output.setAttribute("aria-live", "polite");
  const root = el("div.card", el("div.title", title, figures, block), bar, legend, el("div.chart", canvas, output));
  $("cards").append(root);
  const card = { root, title, figures, block, bar, legend, chart: new Chart(canvas, output, `Memory of GPU ${gpu.index}`) };
  cards.set(gpu.index, card);
  return card;
}

// The parts of a GPU's bytes now: from its leases, so that a change shows at once.
function partsOf(gpu) {
  const samples = feed.samples.get(gpu.index) ?? [];
  if (feed.status.totals.leases > feed.leases.size) return samples.length ? samples[samples.length - 1].parts : [];
  const charged = new Map();
  for (const lease of feed.leases.values()) {
    if (lease.gpu !== gpu.gpu || ["queued", "standby", "parked"].includes(lease.state)) continue;
    const part = lease.state === "verifying" ? -1 : lease.consumer;
    charged.set(part, (charged.get(part) ?? 0) + lease.charge_bytes);
  }
  const sum = [...charged.values()].reduce((a, b) => a + b, 0);
  const last = samples.length ? new Map(samples[samples.length - 1].parts) : new Map();
  const rest = gpu.charged_bytes - sum;
  const debts = Math.min(rest, Math.max(0, (last.get(-1) ?? 0) - (charged.get(-1) ?? 0)));  // of leases that are over
  if (debts > 0) charged.set(-1, (charged.get(-1) ?? 0) + debts);
  if (rest - debts > 0) charged.set(-2, rest - debts);
  if (gpu.stowaway_bytes) charged.set(-3, gpu.stowaway_bytes);
  const order = (part) => (typeof part === "number" ? `~${-part}` : ` ${part}`);
  return [...charged].filter(([, count]) => count > 0).sort(([a], [b]) => (order(a) < order(b) ? -1 : 1));
}

function renderGpus() {
  const known = new Set(feed.status.gpus.map((gpu) => gpu.index));
  for (const [index, card] of cards) if (!known.has(index)) { card.root.remove(); cards.delete(index); }
  for (const gpu of feed.status.gpus) {
    const card = cardOf(gpu), parts = partsOf(gpu);
    setText(card.title, `GPU ${gpu.index} · ${gpu.name}`);
    card.figures.replaceChildren(
      el("b", bytes(gpu.charged_bytes)), " charged · ", el("b", bytes(gpu.measured_used_bytes)), " measured · ",
      el("b", bytes(gpu.capacity_bytes)), " capacity");
    setText(card.block, gpu.blocked ? `Nothing is granted: ${gpu.blocked.text}` : "");
    card.block.hidden = !gpu.blocked;
    card.block.classList.toggle("hard", Boolean(gpu.blocked) && ["unreadable", "pressure"].includes(gpu.blocked.code));
    const all = [...parts.map(([part, count]) => [partClass(part), partName(part), count, part])];
    const free = Math.max(0, gpu.capacity_bytes - gpu.reserve_bytes - parts.reduce((sum, [, count]) => sum + count, 0));
    const whole_ = Math.max(gpu.capacity_bytes, gpu.capacity_bytes - free);
    const legend = all.map(([, name, count, part]) => el("li", chip(part), `${name} `, el("b", bytes(count))));
    const line = el("i.chip.mark"), hatch = el("i.chip.reserve");
    legend.push(el("li", hatch, "reserve ", el("b", bytes(gpu.reserve_bytes))), el("li", "free ", el("b", bytes(free))),
      el("li", line, "measured"));
    card.legend.replaceChildren(...legend);
    const used = all.reduce((sum, [, , count]) => sum + count, 0), scale = Math.max(whole_, used + gpu.reserve_bytes);
    const segment = (name, count) => { const made = el(`i.${name}`); made.style.flexBasis = `${(100 * count) / scale}%`; return made; };
    card.bar.replaceChildren(...all.map(([name, , count]) => segment(name, count)), el("i.gap"), segment("reserve", gpu.reserve_bytes));
    card.bar.setAttribute("aria-label", `${all.map(([, name, count]) => `${name} ${bytes(count)}`).join(", ") || "nothing charged"}; `
      + `free ${bytes(free)}, reserve ${bytes(gpu.reserve_bytes)}`);
    drawChart(gpu);
  }
}

function drawChart(gpu) {
  cards.get(gpu.index)?.chart.update(gpu, feed.samples.get(gpu.index) ?? [], feed.uptime, minutes * 60);
}

// -- queue
function reasonOf(lease) {
  const told = feed.waits.get(lease.lease_id);
  if (!told) return lease.position ? `waits as number ${lease.position}` : "waits for the rest of its gang";
  if (told.condition !== "no_room" || !told.blockers?.length) return told.next;
  const from = told.blockers.slice(0, 3).map((one) => `${bytes(one.bytes)} from ${one.consumer}, ${one.text.replace(/^is /, "")}`);
  const more = told.blockers.length - from.length;
  return `waits for ${from.join("; ")}${more > 0 ? `; and ${more} more` : ""}`;
}

function renderQueue() {
  const queued = [...feed.leases.values()].filter((lease) => lease.state === "queued")
    .sort((a, b) => (a.position ?? 0) - (b.position ?? 0) || a.askedAt - b.askedAt);
  setText($("queue-count"), queued.length ? plural(feed.status.totals.waiting, "request") : "");
  $("queue-empty").hidden = queued.length > 0;
  $("waiters").replaceChildren(...queued.slice(0, WAITERS_SHOWN).map((lease) => {
    const told = feed.waits.get(lease.lease_id), eta = told?.eta_s;
    const waited = el("span.waited", whole((feed.now - lease.askedAt) / 1000));
    waited.dataset.at = lease.askedAt;
    const item = el("li", el("div.line", el("span.place", lease.position ? `${lease.position}.` : "–"),
      el("span.name", chip(lease.consumer), lease.consumer), el("span", `needs ${bytes(told?.needed_bytes ?? lease.charge_bytes)}`),
      told?.deficit_bytes ? el("span", `${bytes(told.deficit_bytes)} are missing`) : null,
      el("span.right", "waits ", waited, typeof eta === "number" ? ` · about ${span(eta)} left` : "")),
    el("p.reason.quiet", reasonOf(lease)));
    item.dataset.lease = lease.lease_id;
    return item;
  }));
  const more = feed.status.totals.waiting - Math.min(queued.length, WAITERS_SHOWN);
  $("queue-more").hidden = more <= 0;
  setText($("queue-more"), more > 0 ? `and ${more.toLocaleString("en")} more` : "");
}

// -- evictions
function renderEvictions() {
  const all = evictionsOf(feed.events), found = all.slice(0, evictionsShown);
  $("evictions-empty").hidden = found.length > 0;
  $("eviction-more").hidden = all.length <= evictionsShown;
  $("eviction-list").replaceChildren(...found.map((one) => {
    const running = one.running;
    const phases = one.phases.map((phase) => (phase.end === null
      ? { ...phase, ms: phase.arrivedAt === null ? 1000 * (Date.now() / 1000 - phase.begin) : feed.now - phase.arrivedAt }
      : { ...phase, ms: phase.ms ?? 1000 * (phase.end - phase.begin) })).map((phase) => ({ ...phase, ms: Math.max(0, phase.ms) }));
    const track = el("div.track", ...phases.map((phase) => {
      const part = el(`i.${phase.name}`);
      part.style.flexGrow = String(Math.max(1, phase.ms));
      return part;
    }));
    track.setAttribute("aria-hidden", "true");
    const tone = one.verdict === "verified" ? "good" : running ? "warn" : one.verdict ? "bad" : "";
    const text = phases.map((phase) => `${phase.name} ${span(phase.ms / 1000)}${phase.end === null && running ? " …" : ""}`).join(" · ");
    const item = el("li", el("div.line", el("span.name", chip(one.consumer), one.consumer), el("span.quiet", one.reason),
      el(`span.badge${tone ? `.${tone}` : ""}`, one.verdict || (running ? running : "ended")),
      el("span.right", clock(one.at))), track, el("p.quiet", `${text} · ${span(phases.reduce((sum, phase) => sum + phase.ms, 0) / 1000)} in all`));
    item.dataset.lease = one.lease;
    return item;
  }));
}

// -- leases
function notesOf(lease) {
  return [lease.pinned ? `pinned by ${lease.pinned}` : lease.evictable ? "" : "never evicted", lease.mode === "exclusive" ? "exclusive" : "",
    lease.standby ? "standby" : "", lease.parked_bytes ? `${bytes(lease.parked_bytes)} in host RAM` : "",
    lease.drift_bytes ? `${bytes(Math.abs(lease.drift_bytes))} ${lease.drift_bytes > 0 ? "above" : "below"} declared` : "",
    lease.yielded ? plural(lease.yielded, "paused use") : "", lease.resizing, lease.grows ? `grows ${lease.grows}` : "",
    lease.gang ? `gang ${lease.gang.id}, ${lease.gang.members} of ${lease.gang.size}` : ""].filter(Boolean).join(" · ");
}

function rowOf(lease) {
  let row = rows.get(lease.lease_id);
  if (!row) {
    const cells = ["", ".state", ".n", ".n.label", ".n.label", ".n.label", ".label", ".label", ".n.label", ""].map((kind) => el(`td${kind}`));
    ["", "", "", "uses", "for", "priority", "GPU", "model", "pid", ""].forEach((label, at) => { if (label) cells[at].dataset.label = label; });
    row = { root: el("tr", ...cells), cells, lease: null };
    row.root.dataset.lease = lease.lease_id;
    rows.set(lease.lease_id, row);
  }
  if (row.lease === lease) return row;
  row.lease = lease;
  const [name, state, charge, uses, , priority, gpu, model, pid, notes] = row.cells;
  name.replaceChildren(chip(lease.consumer), el("span.name", lease.consumer));
  const tone = TONES[lease.state];
  state.replaceChildren(el(`span.badge${tone ? `.${tone}` : ""}`, lease.state));
  setText(charge, bytes(lease.charge_bytes));
  setText(uses, String(lease.uses));
  setText(priority, String(lease.priority));
  const on = feed.status.gpus.find((one) => one.gpu === lease.gpu);
  setText(gpu, on ? String(on.index) : lease.gpu ?? "–");
  setText(model, lease.model);
  setText(pid, String(lease.pid));
  setText(notes, notesOf(lease));
  return row;
}

function renderLeases() {
  const held = [...feed.leases.values()].filter((lease) => lease.state !== "queued");
  setText($("lease-count"), held.length ? plural(feed.status.totals.leases - feed.status.totals.waiting, "lease") : "");
  $("leases-empty").hidden = held.length > 0;
  $("lease-table").hidden = held.length === 0;
  const body = $("lease-rows"), shown = held.slice(0, leasesShown).map(rowOf);
  shown.forEach((row, place) => {
    const there = body.children[place];
    if (there !== row.root) body.insertBefore(row.root, there ?? null);
  });
  while (body.children.length > shown.length) body.lastElementChild.remove();
  for (const id of rows.keys()) if (!feed.leases.has(id)) rows.delete(id);
  const more = held.length - shown.length;
  $("lease-more").hidden = more <= 0;
  setText($("lease-more"), more > 0 ? `Show ${more.toLocaleString("en")} more` : "");
  times();
}

function times() {
  for (const child of $("lease-rows").children) {
    const row = rows.get(child.dataset.lease);
    if (row) setText(row.cells[4], whole((feed.now - row.lease.at) / 1000));
  }
}

// -- history
function fits() {
  const kind = $("kind").value, consumer = $("consumer").value, words = $("text").value.toLowerCase().split(/\s+/).filter(Boolean);
  return (event) => (kind === "-uses" ? !USES.has(event.kind) : !kind || event.kind === kind)
    && (!consumer || event.consumer === consumer)
    && (!words.length || words.every((word) => JSON.stringify(event).toLowerCase().includes(word)));
}

function renderHistory() {
  choices($("kind"), feed.events.map((event) => event.kind));
  choices($("consumer"), feed.events.map((event) => event.consumer).filter(Boolean));
  const found = feed.events.filter(fits()).reverse();
  setText($("event-count"), `${found.length.toLocaleString("en")} of ${plural(feed.events.length, "event")}${feed.historyProblem ? ` · ${feed.historyProblem}` : ""}`);
  $("events-empty").hidden = found.length > 0;
  const list = $("events"), before = new Map([...list.children].map((item) => [item.dataset.seq, item]));
  list.replaceChildren(...found.slice(0, eventsShown).map((event) => before.get(String(event.seq)) ?? eventItem(event)));
  $("event-more").hidden = found.length <= eventsShown;
  $("older").hidden = Boolean(feed.oldest) || feed.firstSeq <= 1;
}

function eventItem(event) {
  const time = el("time", clock(event.at_wall_s, true));
  time.dateTime = new Date(event.at_wall_s * 1000).toISOString();
  const item = el("li", time, el("span.kind", event.kind), el("span.name", event.consumer ? chip(event.consumer) : "", event.consumer ?? ""),
    el("span.quiet", facts(event)));
  item.dataset.seq = event.seq;
  return item;
}

function choices(select, names) {
  const known = new Set([...select.options].map((option) => option.value));
  const fresh = [...new Set(names)].filter((name) => !known.has(name)).sort();
  for (const name of fresh) select.append(new Option(name, name));
}

// -- a screen reader hears of evictions, at most one each five seconds
function announce() {
  const newest = feed.events.length ? feed.events[feed.events.length - 1].seq : 0;
  if (announcedSeq !== null && performance.now() - announcedAt > 5000) {
    const told = feed.events.filter((event) => event.seq > announcedSeq && ["revoke_asked", "pressure", "stowaway"].includes(event.kind));
    if (told.length) {
      const last = told[told.length - 1];
      setText($("announce"), `${last.kind.replace("_", " ")}: ${last.consumer ?? ""} ${last.reason ?? ""}`);
      announcedAt = performance.now();
    }
  }
  announcedSeq = newest;
}

function tick() {
  times();
  for (const node of document.querySelectorAll(".waited")) setText(node, whole((feed.now - Number(node.dataset.at)) / 1000));
  for (const gpu of feed.status.gpus) drawChart(gpu);
}

for (const button of document.querySelectorAll("[data-minutes]")) {
  button.addEventListener("click", () => {
    minutes = Number(button.dataset.minutes);
    for (const other of document.querySelectorAll("[data-minutes]")) other.setAttribute("aria-pressed", String(other === button));
    plan("gpus");
  });
}
$("filters").addEventListener("submit", (event) => event.preventDefault());
$("filters").addEventListener("input", () => { eventsShown = EVENTS_SHOWN; plan("history"); });
$("lease-more").addEventListener("click", () => { leasesShown = Infinity; plan("leases"); });
$("eviction-more").addEventListener("click", () => { evictionsShown += 20; plan("history"); });
$("event-more").addEventListener("click", () => { eventsShown += 4 * EVENTS_SHOWN; plan("history"); });
$("older").addEventListener("click", () => { eventsShown += 2 * EVENTS_SHOWN; feed.loadOlder(fits()); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plan("gpus"));
addEventListener("resize", () => plan("gpus"));
setInterval(() => { if (!document.hidden && feed.live) plan("clock"); }, 1000);
