/** Light, dark, or as the system says. */

import { signal } from "@preact/signals";

export type Theme = "system" | "light" | "dark";
const KEY = "tutelage.theme";

function stored(): Theme {
  try {
    const value = localStorage.getItem(KEY);
    return value === "light" || value === "dark" ? value : "system";
  } catch {
    return "system";
  }
}

export const theme = signal<Theme>(stored());
/** Grows when colours change: what is drawn on canvases is drawn again. */
export const palette = signal(0);

function apply(): void {
  const root = document.documentElement;
  if (theme.value === "system") delete root.dataset["theme"];
  else root.dataset["theme"] = theme.value;
  palette.value += 1;
}

export function setTheme(next: Theme): void {
  theme.value = next;
  try {
    localStorage.setItem(KEY, next);
  } catch {
    // private windows have no storage
  }
  apply();
}

apply();
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);

/** A colour of the style sheet as it is now, light or dark: what a property holds is not yet decided, what an element has is. */
export function colour(name: string): string {
  const probe = document.createElement("i");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}
