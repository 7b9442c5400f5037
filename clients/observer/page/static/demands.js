// Requests at consumers, as the clients tell that serve them.
import { $, chip, el } from "/format.js";

function count(number, label) {
  const cell = el("td.n.label", number.toLocaleString("en"));
  cell.dataset.label = label;
  return cell;
}

export function renderDemands(feed) {
  const demands = feed.status.demands ?? [];
  $("demands").hidden = demands.length === 0;
  $("demand-rows").replaceChildren(
    ...demands.map((one) =>
      el(
        "tr",
        el("td", chip(one.consumer), el("span.name", one.consumer)),
        count(one.in_flight, "in flight"),
        count(one.waiting, "waiting"),
        el("td", one.client),
      ),
    ),
  );
}
