// GPU memory: a bar of its parts now, and the chart of the last minutes.
import { Chart } from "/chart.js";
import { $, bytes, chip, el, partClass, partName, setText } from "/format.js";

const cards = new Map();
let minutes = 3;

function cardOf(gpu) {
  if (cards.has(gpu.index)) return cards.get(gpu.index);
  const title = el("h3"),
    figures = el("p.figures"),
    block = el("p.block"),
    bar = el("div.bar"),
    legend = el("ul.legend");
  const canvas = el("canvas"),
    output = el("output");
  bar.setAttribute("role", "img");
  output.setAttribute("aria-live", "polite");
  const root = el(
    "div.card",
    el("div.title", title, figures, block),
    bar,
    legend,
    el("div.chart", canvas, output),
  );
  $("cards").append(root);
  const card = {
    root,
    title,
    figures,
    block,
    bar,
    legend,
    chart: new Chart(canvas, output, `Memory of GPU ${gpu.index}`),
  };
  cards.set(gpu.index, card);
  return card;
}

// The parts of a GPU's bytes now: from its leases, so that a change shows at once.
function partsOf(feed, gpu) {
  const samples = feed.samples.get(gpu.index) ?? [];
  if (feed.status.totals.leases > feed.leases.size)
    return samples.length ? samples[samples.length - 1].parts : [];
  const charged = new Map();
  for (const lease of feed.leases.values()) {
    if (lease.gpu !== gpu.gpu || ["queued", "standby", "parked"].includes(lease.state)) continue;
    const part = lease.state === "verifying" ? -1 : lease.consumer;
    charged.set(part, (charged.get(part) ?? 0) + lease.charge_bytes);
  }
  const sum = [...charged.values()].reduce((a, b) => a + b, 0);
  const last = samples.length ? new Map(samples[samples.length - 1].parts) : new Map();
  const rest = gpu.charged_bytes - sum;
  // of leases that are over
  const debts = Math.min(rest, Math.max(0, (last.get(-1) ?? 0) - (charged.get(-1) ?? 0)));
  if (debts > 0) charged.set(-1, (charged.get(-1) ?? 0) + debts);
  if (rest - debts > 0) charged.set(-2, rest - debts);
  if (gpu.stowaway_bytes) charged.set(-3, gpu.stowaway_bytes);
  const order = (part) => (typeof part === "number" ? `~${-part}` : ` ${part}`);
  return [...charged]
    .filter(([, count]) => count > 0)
    .sort(([a], [b]) => (order(a) < order(b) ? -1 : 1));
}

export function renderGpus(feed) {
  const known = new Set(feed.status.gpus.map((gpu) => gpu.index));
  for (const [index, card] of cards)
    if (!known.has(index)) {
      card.root.remove();
      cards.delete(index);
    }
  for (const gpu of feed.status.gpus) {
    const card = cardOf(gpu),
      parts = partsOf(feed, gpu);
    setText(card.title, `GPU ${gpu.index} · ${gpu.name}`);
    card.figures.replaceChildren(
      el("b", bytes(gpu.charged_bytes)),
      " charged · ",
      el("b", bytes(gpu.measured_used_bytes)),
      " measured · ",
      el("b", bytes(gpu.capacity_bytes)),
      " capacity",
    );
    setText(card.block, gpu.blocked ? `Nothing is granted: ${gpu.blocked.text}` : "");
    card.block.hidden = !gpu.blocked;
    card.block.classList.toggle(
      "hard",
      Boolean(gpu.blocked) && ["unreadable", "pressure"].includes(gpu.blocked.code),
    );
    const used = parts.reduce((sum, [, count]) => sum + count, 0);
    const free = Math.max(0, gpu.capacity_bytes - gpu.reserve_bytes - used);
    card.legend.replaceChildren(
      ...parts.map(([part, count]) =>
        el("li", chip(part), `${partName(part)} `, el("b", bytes(count))),
      ),
      el("li", el("i.chip.reserve"), "reserve ", el("b", bytes(gpu.reserve_bytes))),
      el("li", "free ", el("b", bytes(free))),
      el("li", el("i.chip.mark"), "measured"),
    );
    const scale = Math.max(gpu.capacity_bytes, used + gpu.reserve_bytes);
    const segment = (name, count) => {
      const made = el(`i.${name}`);
      made.style.flexBasis = `${(100 * count) / scale}%`;
      return made;
    };
    card.bar.replaceChildren(
      ...parts.map(([part, count]) => segment(partClass(part), count)),
      el("i.gap"),
      segment("reserve", gpu.reserve_bytes),
    );
    const told = parts.map(([part, count]) => `${partName(part)} ${bytes(count)}`).join(", ");
    card.bar.setAttribute(
      "aria-label",
      `${told || "nothing charged"}; free ${bytes(free)}, reserve ${bytes(gpu.reserve_bytes)}`,
    );
  }
  drawCharts(feed);
}

export function drawCharts(feed) {
  for (const gpu of feed.status.gpus) {
    const samples = feed.samples.get(gpu.index) ?? [];
    cards.get(gpu.index)?.chart.update(gpu, samples, feed.uptime, minutes * 60);
  }
}

export function onRange(changed) {
  const buttons = document.querySelectorAll("[data-minutes]");
  for (const button of buttons) {
    button.addEventListener("click", () => {
      minutes = Number(button.dataset.minutes);
      for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
      changed();
    });
  }
}
