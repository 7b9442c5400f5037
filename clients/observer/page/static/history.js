// Events of the history, with filters.
import { $, chip, clock, el, plural, setText } from "/format.js";
import { facts, isQuiet } from "/story.js";

const SHOWN = 120;
let shown = SHOWN,
  announcedAt = 0,
  announcedSeq = null;

function fits() {
  const kind = $("kind").value,
    consumer = $("consumer").value,
    words = $("text").value.toLowerCase().split(/\s+/).filter(Boolean);
  return (event) =>
    (kind === "-quiet" ? !isQuiet(event) : !kind || event.kind === kind) &&
    (!consumer || event.consumer === consumer) &&
    (!words.length || words.every((word) => JSON.stringify(event).toLowerCase().includes(word)));
}

export function renderHistory(feed) {
  choices(
    $("kind"),
    feed.events.map((event) => event.kind),
  );
  choices($("consumer"), feed.events.map((event) => event.consumer).filter(Boolean));
  const found = feed.events.filter(fits()).reverse();
  const count = `${found.length.toLocaleString("en")} of ${plural(feed.events.length, "event")}`;
  setText($("event-count"), [count, feed.historyProblem].filter(Boolean).join(" · "));
  $("events-empty").hidden = found.length > 0;
  const list = $("events"),
    before = new Map([...list.children].map((item) => [item.dataset.seq, item]));
  list.replaceChildren(
    ...found.slice(0, shown).map((event) => before.get(String(event.seq)) ?? eventItem(event)),
  );
  $("event-more").hidden = found.length <= shown;
  $("older").hidden = Boolean(feed.oldest) || feed.firstSeq <= 1;
}

function eventItem(event) {
  const time = el("time", clock(event.at_wall_s, true));
  time.dateTime = new Date(event.at_wall_s * 1000).toISOString();
  const item = el(
    "li",
    time,
    el("span.kind", event.kind),
    el("span.name", event.consumer ? chip(event.consumer) : "", event.consumer ?? ""),
    el("span.quiet", facts(event)),
  );
  item.dataset.seq = event.seq;
  return item;
}

function choices(select, names) {
  const known = new Set([...select.options].map((option) => option.value));
  const fresh = [...new Set(names)].filter((name) => !known.has(name)).sort();
  for (const name of fresh) select.append(new Option(name, name));
}

// A screen reader hears of evictions, at most one each five seconds.
export function announce(feed) {
  const newest = feed.events.length ? feed.events[feed.events.length - 1].seq : 0;
  if (announcedSeq !== null && performance.now() - announcedAt > 5000) {
    const told = feed.events.filter(
      (event) =>
        event.seq > announcedSeq && ["revoke_asked", "pressure", "stowaway"].includes(event.kind),
    );
    if (told.length) {
      const last = told[told.length - 1];
      setText(
        $("announce"),
        `${last.kind.replace("_", " ")}: ${last.consumer ?? ""} ${last.reason ?? ""}`,
      );
      announcedAt = performance.now();
    }
  }
  announcedSeq = newest;
}

$("filters").addEventListener("submit", (event) => event.preventDefault());
$("filters").addEventListener("input", () => (shown = SHOWN));
$("event-more").addEventListener("click", () => (shown += 4 * SHOWN));

export function onOlder(feed) {
  $("older").addEventListener("click", () => {
    shown += 2 * SHOWN;
    feed.loadOlder(fits());
  });
}
