// Light and dark, and the colours for what is drawn by script.

const KEY = "canwall-theme";
const system = matchMedia("(prefers-color-scheme: dark)");
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const listeners = [];

/** Colours of the theme in force, from the style sheet. */
export const colours = {};

export const reducedMotion = () => calm.matches;

export function onTheme(listener) {
  listeners.push(listener);
}

export function toggleTheme() {
  localStorage.setItem(KEY, dark() ? "light" : "dark");
  apply();
}

function dark() {
  const chosen = localStorage.getItem(KEY);
  return chosen ? chosen === "dark" : system.matches;
}

function apply() {
  document.documentElement.dataset.theme = dark() ? "dark" : "light";
  const style = getComputedStyle(document.documentElement);
  for (const name of [
    "ground", "surface", "raised", "text", "muted", "line", "position", "force", "command", "actual",
    "passive", "active", "referent", "wall", "wall-edge", "handle", "quiet-area", "chatter-area",
  ]) {
    colours[name] = style.getPropertyValue(`--${name}`).trim();
  }
  document.getElementById("theme").textContent = dark() ? "Light" : "Dark";
  for (const listener of listeners) listener();
}

export function beginTheme() {
  system.addEventListener("change", apply);
  apply();
}
