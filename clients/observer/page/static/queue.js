// Requests that wait, with reason and estimate.
import { $, bytes, chip, el, plural, setText, span, whole } from "/format.js";

const WAITERS_SHOWN = 24;

function reasonOf(feed, lease) {
  const told = feed.waits.get(lease.lease_id);
  if (!told)
    return `waits as number ${lease.position}`;
  if (told.condition !== "no_room" || !told.blockers?.length) return told.next;
  const from = told.blockers
    .slice(0, 3)
    .map((one) => `${bytes(one.bytes)} from ${one.consumer}, ${one.text.replace(/^is /, "")}`);
  const more = told.blockers.length - from.length;
  return `waits for ${from.join("; ")}${more > 0 ? `; and ${more} more` : ""}`;
}

export function renderQueue(feed) {
  const queued = [...feed.leases.values()]
    .filter((lease) => lease.state === "queued")
    .sort((a, b) => (a.position ?? 0) - (b.position ?? 0) || a.askedAt - b.askedAt);
  setText($("queue-count"), queued.length ? plural(feed.status.totals.waiting, "request") : "");
  $("queue-empty").hidden = queued.length > 0;
  $("waiters").replaceChildren(
    ...queued.slice(0, WAITERS_SHOWN).map((lease) => {
      const told = feed.waits.get(lease.lease_id),
        eta = told?.eta_s;
      const waited = el("span.waited", whole((feed.now - lease.askedAt) / 1000));
      waited.dataset.at = lease.askedAt;
      const item = el(
        "li",
        el(
          "div.line",
          el("span.place", lease.position ? `${lease.position}.` : "–"),
          el("span.name", chip(lease.consumer), lease.consumer),
          el("span", `needs ${bytes(told?.needed_bytes ?? lease.charge_bytes)}`),
          told?.deficit_bytes ? el("span", `${bytes(told.deficit_bytes)} are missing`) : null,
          el(
            "span.right",
            "waits ",
            waited,
            typeof eta === "number" ? ` · about ${span(eta)} left` : "",
          ),
        ),
        el("p.reason.quiet", reasonOf(feed, lease)),
      );
      item.dataset.lease = lease.lease_id;
      return item;
    }),
  );
  const more = feed.status.totals.waiting - Math.min(queued.length, WAITERS_SHOWN);
  $("queue-more").hidden = more <= 0;
  setText($("queue-more"), more > 0 ? `and ${more.toLocaleString("en")} more` : "");
}

export function countWaits(feed) {
  for (const node of document.querySelectorAll(".waited"))
    setText(node, whole((feed.now - Number(node.dataset.at)) / 1000));
}
