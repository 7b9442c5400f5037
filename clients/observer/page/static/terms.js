// Explanations of terms: shown under the pointer or the focus, hidden by Escape.
import { $, el } from "/format.js";

let explained = null,
  tip = null;

// A term of the text, explained by `#term-NAME` of the document.
export function term(name) {
  const made = el("button.term", name);
  made.type = "button";
  made.setAttribute("aria-describedby", `term-${name}`);
  return made;
}

function hide() {
  if (tip) tip.hidden = true;
  explained = tip = null;
}

function show(of) {
  hide();
  explained = of;
  tip = $(of.getAttribute("aria-describedby"));
  tip.hidden = false;
  const at = of.getBoundingClientRect(),
    { clientWidth, clientHeight } = document.documentElement,
    below = at.bottom + tip.offsetHeight <= clientHeight;
  tip.style.left = `${Math.max(8, Math.min(at.left, clientWidth - tip.offsetWidth - 8))}px`;
  tip.style.top = `${below ? at.bottom : at.top - tip.offsetHeight}px`;
}

// What is focused stays explained while the pointer is elsewhere.
function follow(target) {
  if (target === tip) return;
  const of = target.closest(".term") ?? document.activeElement.closest(".term");
  if (of) show(of);
  else hide();
}

document.addEventListener("pointerover", (event) => follow(event.target));
document.addEventListener("focusin", (event) => follow(event.target));
document.addEventListener("focusout", hide);
document.addEventListener("scroll", () => explained && show(explained), { passive: true });
document.addEventListener("keydown", (event) => event.key === "Escape" && hide());
