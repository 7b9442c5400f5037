// The table of leases: a row keeps its place in the document while its lease lives.
import { $, bytes, chip, el, plural, setText, whole } from "/format.js";

const TONES = {
  held: "good",
  loading: "warn",
  revoking: "warn",
  unloading: "warn",
  verifying: "warn",
  queued: "",
  standby: "",
  parked: "",
};
// class and, on a narrow screen, label of each cell
const CELLS = [
  ["", ""],
  [".state", ""],
  [".n", ""],
  [".n.label", "uses"],
  [".n.label", "for"],
  [".n.label", "priority"],
  [".label", "tier"],
  [".label", "model"],
  [".n.label", "pid"],
  ["", ""],
];
const rows = new Map();
let most = 200; // rows

function notesOf(lease) {
  const drifted = lease.drift_bytes;
  return [
    lease.pinned ? `pinned by ${lease.pinned}` : lease.evictable ? "" : "never evicted",
    lease.mode === "exclusive" ? "exclusive" : "",
    lease.standby ? "standby" : "",
    lease.parked_bytes ? `${bytes(lease.parked_bytes)} in host RAM` : "",
    drifted ? `${bytes(Math.abs(drifted))} ${drifted > 0 ? "above" : "below"} declared` : "",
  ]
    .filter(Boolean)
    .join(" · ");
}

// Where the weights are.
function tierOf(feed, lease) {
  if (lease.state === "parked") return "RAM";
  const on = feed.status.gpus.find((one) => one.gpu === lease.gpu);
  return lease.state === "standby" || !on ? "–" : `GPU ${on.index}`;
}

function rowOf(feed, lease) {
  let row = rows.get(lease.lease_id);
  if (!row) {
    const cells = CELLS.map(([kind, label]) => {
      const cell = el(`td${kind}`);
      if (label) cell.dataset.label = label;
      return cell;
    });
    row = { root: el("tr", ...cells), cells, lease: null };
    row.root.dataset.lease = lease.lease_id;
    rows.set(lease.lease_id, row);
  }
  if (row.lease === lease) return row;
  row.lease = lease;
  const [name, state, charge, uses, , priority, tier, model, pid, notes] = row.cells;
  name.replaceChildren(chip(lease.consumer), el("span.name", lease.consumer));
  const tone = TONES[lease.state];
  state.replaceChildren(el(`span.badge${tone ? `.${tone}` : ""}`, lease.state));
  setText(charge, bytes(lease.charge_bytes));
  setText(uses, String(lease.uses));
  setText(priority, String(lease.priority));
  setText(tier, tierOf(feed, lease));
  setText(model, lease.model);
  setText(pid, String(lease.pid));
  setText(notes, notesOf(lease));
  return row;
}

export function renderLeases(feed) {
  const held = [...feed.leases.values()].filter((lease) => lease.state !== "queued");
  setText(
    $("lease-count"),
    held.length ? plural(feed.status.totals.leases - feed.status.totals.waiting, "lease") : "",
  );
  $("leases-empty").hidden = held.length > 0;
  $("lease-table").hidden = held.length === 0;
  const body = $("lease-rows"),
    shown = held.slice(0, most).map((lease) => rowOf(feed, lease));
  shown.forEach((row, place) => {
    const there = body.children[place];
    if (there !== row.root) body.insertBefore(row.root, there ?? null);
  });
  while (body.children.length > shown.length) body.lastElementChild.remove();
  for (const id of rows.keys()) if (!feed.leases.has(id)) rows.delete(id);
  const more = held.length - shown.length;
  $("lease-more").hidden = more <= 0;
  setText($("lease-more"), more > 0 ? `Show ${more.toLocaleString("en")} more` : "");
  countTimes(feed);
}

export function countTimes(feed) {
  for (const child of $("lease-rows").children) {
    const row = rows.get(child.dataset.lease);
    if (row) setText(row.cells[4], whole((feed.now - row.lease.at) / 1000));
  }
}

$("lease-more").addEventListener("click", () => (most = Infinity));
