/** Where we are: the part of the address behind #. */

import { signal } from "@preact/signals";

export interface Route {
  page: string;
  id: string | null;
}

export function parseRoute(hash: string): Route {
  const [page = "", id] = hash.replace(/^#\/?/, "").split("/");
  return { page, id: id ? decodeURIComponent(id) : null };
}

export const route = signal<Route>(parseRoute(location.hash));

window.addEventListener("hashchange", () => {
  route.value = parseRoute(location.hash);
});

export function go(path: string): void {
  location.hash = path;
}
