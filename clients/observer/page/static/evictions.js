// Evictions with their phases, newest first.
import { $, chip, clock, el, span } from "/format.js";
import { evictionsOf } from "/story.js";

let shown = 5;

export function renderEvictions(feed) {
  const all = evictionsOf(feed.events),
    found = all.slice(0, shown);
  $("evictions-empty").hidden = found.length > 0;
  $("eviction-more").hidden = all.length <= shown;
  $("eviction-list").replaceChildren(
    ...found.map((one) => {
      const running = one.running;
      const phases = one.phases
        .map((phase) =>
          phase.end === null
            ? {
                ...phase,
                ms:
                  phase.arrivedAt === null
                    ? 1000 * (Date.now() / 1000 - phase.begin)
                    : feed.now - phase.arrivedAt,
              }
            : { ...phase, ms: phase.ms ?? 1000 * (phase.end - phase.begin) },
        )
        .map((phase) => ({ ...phase, ms: Math.max(0, phase.ms) }));
      const whole = phases.reduce((sum, phase) => sum + phase.ms, 0);
      const track = el(
        "div.track",
        ...phases.map((phase) => {
          const part = el(`i.${phase.name}`);
          part.style.flexBasis = `${(100 * phase.ms) / Math.max(1, whole)}%`;
          return part;
        }),
      );
      track.setAttribute("aria-hidden", "true");
      const tone =
        one.verdict === "verified" ? "good" : running ? "warn" : one.verdict ? "bad" : "";
      const text = phases
        .map(
          (phase) =>
            `${phase.name} ${span(phase.ms / 1000)}${phase.end === null && running ? " …" : ""}`,
        )
        .join(" · ");
      const item = el(
        "li",
        el(
          "div.line",
          el("span.name", chip(one.consumer), one.consumer),
          el("span.quiet", one.reason),
          el(`span.badge${tone ? `.${tone}` : ""}`, one.verdict || (running ? running : "ended")),
          el("span.right", clock(one.at)),
        ),
        track,
        el(
          "p.quiet",
          `${text} · ${span(whole / 1000)} in all`,
        ),
      );
      item.dataset.lease = one.lease;
      return item;
    }),
  );
}

$("eviction-more").addEventListener("click", () => (shown += 20));
