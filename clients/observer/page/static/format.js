// Numbers, times and elements as the page writes them. Text only ever becomes a text node.

const GIB = 2 ** 30,
  MIB = 2 ** 20;

export const $ = (id) => document.getElementById(id);

export function bytes(count) {
  if (count === null || count === undefined) return "unknown";
  if (Math.abs(count) >= 0.1 * GIB) return `${(count / GIB).toFixed(2)} GiB`;
  return count ? `${Math.max(1, Math.round(Math.abs(count) / MIB)) * Math.sign(count)} MiB` : "0";
}

export function span(seconds) {
  if (seconds < 1) return `${Math.max(0, Math.round(seconds * 1000))} ms`;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  if (seconds < 172800) return `${Math.floor(seconds / 3600)} h`;
  return `${Math.floor(seconds / 86400)} d`;
}

export function whole(seconds) {
  return seconds < 10 ? `${Math.floor(Math.max(0, seconds))} s` : span(seconds);
}

export function clock(wall, parts = false) {
  const at = new Date(wall * 1000);
  const time = at.toLocaleTimeString([], {
    hour: "2-digit",
    minute: "2-digit",
    second: "2-digit",
    hour12: false,
  });
  if (!parts) return time;
  const day = at.toDateString() === new Date().toDateString() ? "" : `${at.toLocaleDateString()} `;
  return `${day}${time}.${String(at.getMilliseconds()).padStart(3, "0")}`;
}

export function plural(count, word) {
  return `${count.toLocaleString("en")} ${word}${count === 1 ? "" : "s"}`;
}

// el("li.name", "text", child): an element with classes; children are nodes or text.
export function el(what, ...children) {
  const [tag, ...classes] = what.split(".");
  const made = document.createElement(tag);
  if (classes.length) made.className = classes.join(" ");
  made.append(...children.filter((child) => child !== null && child !== undefined && child !== ""));
  return made;
}

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// A consumer keeps its color: by its name, and the next free one where two names would share it.
const COLORS = 12;
const taken = new Map(),
  colors = new Map();
export function colorOf(name) {
  if (colors.has(name)) return colors.get(name);
  let hash = 2166136261;
  for (const letter of name) hash = Math.imul(hash ^ letter.codePointAt(0), 16777619);
  const first = (hash >>> 0) % COLORS;
  let color = first;
  if (taken.size < COLORS) while (taken.has(color)) color = (color + 1) % COLORS;
  taken.set(color, name);
  colors.set(name, `c${color}`);
  return colors.get(name);
}

export const CODES = {
  [-1]: ["pending", "pending free"],
  [-2]: ["retained", "retained by processes"],
  [-3]: ["stowaway", "stowaways"],
  [-4]: ["others", "other consumers"],
};

export function partName(part) {
  return typeof part === "number" ? CODES[part][1] : part;
}
export function partClass(part) {
  return typeof part === "number" ? CODES[part][0] : colorOf(part);
}
export function chip(part) {
  return el(`i.chip.${partClass(part)}`);
}
