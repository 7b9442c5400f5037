// Bars over time of one GPU on a canvas: bytes by consumer, what is measured, and the budget.
import { bytes, partClass, partName, span } from "/format.js";

const BAR = 4,
  LEFT = 44,
  BOTTOM = 16,
  TOP = 6;

function total(sample) {
  return sample.parts.reduce((sum, [, count]) => sum + count, 0);
}

export class Chart {
  constructor(canvas, output, label) {
    Object.assign(this, { canvas, output, label, cursor: null, samples: [], seconds: 180, now: 0 });
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("blur", () => this.point(null));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  get columns() {
    return Math.max(1, Math.floor((this.canvas.clientWidth - LEFT) / BAR));
  }

  point(x) {
    this.cursor =
      x === null || x < LEFT
        ? null
        : Math.min(this.columns - 1, Math.floor((x - LEFT) / BAR));
    this.draw();
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 }[event.key];
    if (step === undefined && event.key !== "Home" && event.key !== "End") return;
    event.preventDefault();
    const last = this.columns - 1;
    if (event.key === "Home") this.cursor = 0;
    else if (event.key === "End") this.cursor = last;
    else this.cursor = Math.max(0, Math.min(last, (this.cursor ?? last + 1) + step));
    this.draw();
  }

  // For each column the sample with the most bytes: a short eviction must not fall between two.
  sampled() {
    // columns keep their instants while time moves on
    const count = this.columns,
      width = this.seconds / count,
      begin = (Math.ceil(this.now / width) - count) * width;
    const found = new Array(count).fill(null);
    let current = null,
      index = 0;
    for (let column = 0; column < count; column += 1) {
      const end = begin + (column + 1) * width;
      let best = current;
      while (index < this.samples.length && this.samples[index].at <= end) {
        current = this.samples[index];
        if (best === null || total(current) > total(best)) best = current;
        index += 1;
      }
      found[column] = best;
    }
    return found;
  }

  update(gpu, samples, now, seconds) {
    Object.assign(this, { gpu, samples, now, seconds });
    this.draw();
  }

  draw() {
    const { canvas, gpu } = this,
      ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth,
      height = canvas.clientHeight;
    if (!gpu || !width) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d"),
      style = getComputedStyle(canvas),
      colors = new Map();
    const color = (name) => {
      if (!colors.has(name)) colors.set(name, style.getPropertyValue(`--${name}`).trim());
      return colors.get(name);
    };
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const found = this.sampled(),
      floor = height - BOTTOM;
    const most = Math.max(
      gpu.capacity_bytes,
      ...found.map((one) => (one ? Math.max(total(one), one.used ?? 0) : 0)),
    );
    const y = (count) => floor - (count / most) * (floor - TOP);
    const budget = gpu.capacity_bytes - gpu.reserve_bytes;
    pen.fillStyle = color("reserve");
    pen.fillRect(LEFT, y(gpu.capacity_bytes), width - LEFT, y(budget) - y(gpu.capacity_bytes));
    this.axes(pen, color, y, width, floor);
    found.forEach((sample, column) => {
      if (!sample) return;
      const x = LEFT + column * BAR;
      let base = 0;
      pen.globalAlpha = this.cursor === null || this.cursor === column ? 1 : 0.55;
      for (const [part, count] of sample.parts) {
        pen.fillStyle = color(partClass(part));
        pen.fillRect(x, y(base + count), BAR, Math.max(0.5, y(base) - y(base + count)));
        base += count;
      }
      pen.globalAlpha = 1;
      if (sample.used !== null) {
        pen.fillStyle = color("ink");
        pen.fillRect(x, y(sample.used) - 0.75, BAR, 1.5);
      }
    });
    this.tell(found);
  }

  axes(pen, color, y, width, floor) {
    pen.font = `11px ${getComputedStyle(this.canvas).fontFamily}`;
    pen.strokeStyle = color("line");
    pen.fillStyle = color("quiet");
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const gib = this.gpu.capacity_bytes / 2 ** 30;
    const step = [0.25, 0.5, 1, 2, 4, 8, 16, 32, 64, 128].find((size) => gib / size <= 5) ?? 256;
    for (let at = 0; at <= gib + 1e-6; at += step) {
      const line = Math.round(y(at * 2 ** 30)) + 0.5;
      pen.beginPath();
      pen.moveTo(LEFT, line);
      pen.lineTo(width, line);
      pen.stroke();
      pen.fillText(at ? `${at} GiB` : "0", LEFT - 6, line);
    }
    pen.textBaseline = "bottom";
    const span_s = this.columns * (this.seconds / this.columns),
      right = LEFT + this.columns * BAR;
    for (const part of [1, 0.5, 0]) {
      pen.textAlign = part === 1 ? "left" : part ? "center" : "right";
      const text = part ? `−${span(span_s * part)}` : "now";
      pen.fillText(text, right - part * (right - LEFT), floor + BOTTOM);
    }
  }

  tell(found) {
    const last = found[found.length - 1],
      column = this.cursor;
    const of = (sample) =>
      sample
        ? [...sample.parts]
            .reverse()
            .map(([part, count]) => `${partName(part)} ${bytes(count)}`)
            .concat(`measured ${bytes(sample.used)}`)
            .join(" · ")
        : "not recorded";
    const ago = column === null ? 0 : (found.length - 1 - column) * (this.seconds / found.length);
    const text =
      column === null ? "" : `${ago < 1 ? "now" : `${span(ago)} ago`}: ${of(found[column])}`;
    if (this.output.textContent !== text) this.output.textContent = text;
    const past = `${this.label}, the last ${span(this.seconds)}`;
    const label = `${past}. Now: ${of(last)}. Arrow keys read earlier moments.`;
    if (column === null && this.canvas.getAttribute("aria-label") !== label)
      this.canvas.setAttribute("aria-label", label);
  }
}
