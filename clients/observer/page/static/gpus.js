// GPU memory: a bar of its parts now, and the chart of the last minutes.
import { Chart } from "/chart.js";
import { $, bytes, chip, el, partClass, partName, setText } from "/format.js";
import { term } from "/terms.js";

const panels = new Map();
let minutes = 3;

function panelOf(gpu) {
  if (panels.has(gpu.index)) return panels.get(gpu.index);
  const title = el("h3"),
    block = el("p.block"),
    bar = el("div.bar");
  const [charged, measured, capacity, reserve, free] = Array.from({ length: 5 }, () => el("b"));
  const sensors = el("span");
  const figures = el(
    "p.figures",
    ...[charged, " ", term("charged"), " · ", measured, " measured · ", capacity, " capacity", sensors],
  );
  const fixed = el("li", el("i.chip.reserve"), term("reserve"), " ", reserve);
  const legend = el(
    "ul.legend",
    fixed,
    el("li", "free ", free),
    el("li", el("i.chip.mark"), "measured"),
  );
  const canvas = el("canvas"),
    output = el("output");
  bar.setAttribute("role", "img");
  output.setAttribute("aria-live", "polite");
  const root = el(
    "div.panel",
    el("div.title", title, figures, block),
    bar,
    legend,
    el("div.chart", canvas, output),
  );
  $("panels").append(root);
  const panel = {
    root,
    title,
    block,
    bar,
    fixed,
    sensors,
    sums: { charged, measured, capacity, reserve, free },
    parts: [],
    chart: new Chart(canvas, output, `Memory of GPU ${gpu.index}`),
  };
  panels.set(gpu.index, panel);
  return panel;
}

// " · 87 % busy · 64 °C · 215 W", without what is unknown.
function sensorsText({ utilization, temperature_c, power_w }) {
  const told = [
    [utilization * 100, "% busy"],
    [temperature_c, "°C"],
    [power_w, "W"],
  ];
  const known = told.filter(([figure]) => Number.isFinite(figure));
  return known.map(([figure, unit]) => ` · ${Math.round(figure)} ${unit}`).join("");
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
  for (const [index, panel] of panels)
    if (!known.has(index)) {
      panel.root.remove();
      panels.delete(index);
    }
  for (const gpu of feed.status.gpus) {
    const panel = panelOf(gpu),
      parts = partsOf(feed, gpu);
    setText(panel.title, `GPU ${gpu.index} · ${gpu.name}`);
    setText(panel.block, gpu.blocked ? `Nothing is granted: ${gpu.blocked.text}` : "");
    panel.block.hidden = !gpu.blocked;
    panel.block.classList.toggle(
      "hard",
      Boolean(gpu.blocked) && ["unreadable", "pressure"].includes(gpu.blocked.code),
    );
    const used = parts.reduce((sum, [, count]) => sum + count, 0);
    const free = Math.max(0, gpu.capacity_bytes - gpu.reserve_bytes - used);
    const sums = {
      charged: gpu.charged_bytes,
      measured: gpu.measured_used_bytes,
      capacity: gpu.capacity_bytes,
      reserve: gpu.reserve_bytes,
      free,
    };
    for (const [name, count] of Object.entries(sums)) setText(panel.sums[name], bytes(count));
    setText(panel.sensors, sensorsText(gpu.sensors ?? {}));
    // The terms stay in the document, so that a change does not take the focus from them.
    panel.parts.forEach((item) => item.remove());
    panel.parts = parts.map(([part, count]) =>
      el("li", chip(part), `${partName(part)} `, el("b", bytes(count))),
    );
    panel.fixed.before(...panel.parts);
    const scale = Math.max(gpu.capacity_bytes, used + gpu.reserve_bytes);
    const segment = (name, count) => {
      const made = el(`i.${name}`);
      made.style.flexBasis = `${(100 * count) / scale}%`;
      return made;
    };
    panel.bar.replaceChildren(
      ...parts.map(([part, count]) => segment(partClass(part), count)),
      el("i.gap"),
      segment("reserve", gpu.reserve_bytes),
    );
    const told = parts.map(([part, count]) => `${partName(part)} ${bytes(count)}`).join(", ");
    panel.bar.setAttribute(
      "aria-label",
      `${told || "nothing charged"}; free ${bytes(free)}, reserve ${bytes(gpu.reserve_bytes)}`,
    );
  }
  drawCharts(feed);
}

export function drawCharts(feed) {
  for (const gpu of feed.status.gpus) {
    const samples = feed.samples.get(gpu.index) ?? [];
    panels.get(gpu.index)?.chart.update(gpu, samples, feed.uptime, minutes * 60);
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
