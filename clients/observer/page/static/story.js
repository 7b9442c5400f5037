// What the history tells: evictions with their phases, and the facts of an event in one line.
import { bytes, span } from "/format.js";

export const PHASES = ["revoke", "quiesce", "unload", "verify"];
const RUNNING = {
  revoke: "revoking",
  quiesce: "quiescing",
  unload: "unloading",
  verify: "verifying",
};
const BEGINS = {
  revoke_asked: "revoke",
  revoke_acked: "quiesce",
  unloading: "unload",
  released: "verify",
};
const SHOWN_ELSEWHERE = new Set([
  "seq",
  "at_wall_s",
  "kind",
  "lease_id",
  "consumer",
  "gpu",
  "traceparent",
  "trace_id",
  "span_id",
  "parent_id",
  "trace_flags",
  "reason",
  "arrivedAt",
  "left_out",
  "wait",
  "why",
  "resolved",
  // of a revoke: in its reason
  "cause",
  "wanted_by",
  "wanted_by_lease",
]);

// Steps that other events sum up; `clients/cli/text.py` has the same list.
const QUIET = new Set([
  "use_began",
  "use_ended",
  "revoke_acked",
  "reminded",
  "unloading",
]);

// Also quiet: a load that evicted no lease, and the verdict on a process that had no lease.
export function isQuiet(event) {
  if (event.kind === "switch") return !event.switched;
  if (event.kind === "verified") return !event.lease_id;
  return QUIET.has(event.kind);
}

// Newest first. A phase lasts until the next one begins; a later phase may begin without the ones
// between, such as the release of a holder that was killed.
export function evictionsOf(events) {
  const open = new Map(),
    all = [];
  for (const event of events) {
    const one = open.get(event.lease_id);
    if (event.kind === "revoke_asked" && one) {
      one.reason = event.reason ?? one.reason; // another waiter takes it over
    } else if (event.kind === "revoke_asked") {
      const made = {
        lease: event.lease_id,
        consumer: event.consumer ?? "",
        reason: event.reason ?? "",
        at: event.at_wall_s,
        phases: [],
        verdict: "",
        running: "",
      };
      open.set(event.lease_id, made);
      all.push(made);
      begin(made, "revoke", event);
    } else if (one && BEGINS[event.kind]) {
      if (
        PHASES.indexOf(BEGINS[event.kind]) > PHASES.indexOf(one.phases[one.phases.length - 1].name)
      )
        begin(one, BEGINS[event.kind], event);
    } else if (one && event.kind === "verified") {
      one.verdict = event.verdict;
      if (!event.resolved) continue;
      const last = one.phases[one.phases.length - 1];
      last.end = event.at_wall_s;
      if (last.name === "verify") last.ms = event.ms;
      one.running = "";
      open.delete(event.lease_id);
    } else if (one && event.kind === "revoke_withdrawn") {
      one.verdict = "withdrawn";
      one.running = "";
      one.phases[one.phases.length - 1].end = event.at_wall_s;
      open.delete(event.lease_id);
    } else if (one && (event.kind === "lost" || event.kind === "expired")) {
      one.reason = event.reason ?? one.reason;
    }
  }
  return all.reverse();
}

function begin(one, name, event) {
  const last = one.phases[one.phases.length - 1];
  if (last) last.end = event.at_wall_s;
  one.phases.push({ name, begin: event.at_wall_s, end: null, arrivedAt: event.arrivedAt ?? null });
  one.running = RUNNING[name];
}

function plain(key, value) {
  if (value === null || value === "" || (Array.isArray(value) && !value.length)) return "";
  if (typeof value === "number" && key.endsWith("_bytes")) return bytes(value);
  if (typeof value === "number" && (key === "ms" || key.endsWith("_ms"))) return span(value / 1000);
  if (typeof value === "number" && key.endsWith("_s")) return span(value);
  if (Array.isArray(value))
    return value
      .map((item) =>
        typeof item === "object" && item
          ? (item.consumer ?? item.name ?? item.pid ?? JSON.stringify(item))
          : String(item),
      )
      .join(", ");
  if (typeof value === "object") return JSON.stringify(value);
  return String(value);
}

// Fields of a switch that evicted no lease.
const LOADED = new Set(["load_ms", "total_ms"]);

// "fits · charge 2.10 GiB · waited 12 ms": the reason first, then every other field.
export function facts(event) {
  const told = event.reason ? [event.reason] : [];
  for (const [key, value] of Object.entries(event)) {
    if (SHOWN_ELSEWHERE.has(key) || value === false) continue;
    if (event.kind === "switch" && !event.switched && !LOADED.has(key)) continue;
    const text = plain(key, value);
    const name =
      key === "drain_ms" ? "quiesce" : key.replace(/_(bytes|ms|s)$/, "").replaceAll("_", " ");
    if (text) told.push(value === true ? name : key === "ms" ? text : `${name} ${text}`);
  }
  return told.join(" · ");
}
