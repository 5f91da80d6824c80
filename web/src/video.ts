/** Live pictures: canvases say what they show and whether they are seen, one socket brings it, the newest frame wins. */

import { signal, type Signal } from "@preact/signals";
import { backOff } from "./clocksync";
import { socketUrl } from "./live";
import { parseHeader, type PictureHeader } from "./protocol";
import { serverNow } from "./store";
import { choose, MOST_STREAMS, type Wish } from "./streams";

export interface ViewStats {
  /** Pictures drawn in the last second or so. */
  fps: number;
  /** Age of the newest picture when it was drawn, s. */
  age: number | null;
  /** When it was taken, server's clock, s. */
  captured: number | null;
  width: number;
  height: number;
}

export interface View extends Wish {
  canvas: HTMLCanvasElement;
  stats: Signal<ViewStats>;
}

export const videoOpen = signal(false);

const views = new Set<View>();
const drawn = new WeakMap<View, number[]>();
const busy = new Set<string>();
const newest = new Map<string, { header: PictureHeader; jpeg: Blob }>();
let socket: WebSocket | null = null;
let wanted = false;
let attempt = 0;
let retry = 0;
let askTimer = 0;
let asked = "";
let turn = 0;
let begun = 0;
let pings = 0;

export const noStats = (): ViewStats => ({ fps: 0, age: null, captured: null, width: 0, height: 0 });

export function startVideo(): void {
  wanted = true;
  if (!socket) open();
}

export function stopVideo(): void {
  wanted = false;
  window.clearTimeout(retry);
  const old = socket;
  socket = null;
  old?.close(1000);
  videoOpen.value = false;
}

function open(): void {
  const mine = new WebSocket(socketUrl("/api/video"));
  mine.binaryType = "arraybuffer";
  socket = mine;
  asked = "";
  mine.onopen = () => {
    attempt = 0;
    begun = performance.now();
    videoOpen.value = true;
    watch();
  };
  mine.onmessage = (event) => {
    if (event.data instanceof ArrayBuffer) arrived(mine, event.data);
  };
  mine.onclose = () => {
    if (mine !== socket) return;
    socket = null;
    videoOpen.value = false;
    if (wanted) retry = window.setTimeout(open, backOff(attempt++) * 1000);
  };
}

export function addView(view: View): () => void {
  views.add(view);
  soon();
  return () => {
    views.delete(view);
    soon();
  };
}

/** Something about the views changed: tell the server, at most ten times a second. */
export function soon(): void {
  if (!askTimer) askTimer = window.setTimeout(watch, 100);
}

function watch(): void {
  window.clearTimeout(askTimer);
  askTimer = 0;
  if (socket?.readyState !== WebSocket.OPEN) return;
  const streams = document.hidden ? [] : choose(views, window.devicePixelRatio || 1, turn);
  const text = JSON.stringify({ type: "watch", streams });
  if (text === asked) return;
  asked = text;
  socket.send(text);
}

document.addEventListener("visibilitychange", soon);
window.setInterval(() => {
  turn += 1;
  // Pictures of a fleet that stands still may not change for long; the server closes a socket that says nothing.
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ type: "ping", n: ++pings, time: (performance.now() - begun) / 1000 }));
  let seen = 0;
  const since = performance.now() - 2000;
  for (const view of views) {
    if (view.visible) seen += 1;
    const times = drawn.get(view) ?? [];
    if (view.stats.value.fps && !times.some((time) => time > since)) view.stats.value = { ...view.stats.value, fps: 0 };
  }
  if (seen > MOST_STREAMS) soon();
}, 2500);

function arrived(from: WebSocket, data: ArrayBuffer): void {
  const header = parseHeader(data);
  if (!header) return;
  // Confirmed when it has arrived, not when it is drawn: what is drawn too slowly is skipped here.
  if (from.readyState === WebSocket.OPEN) from.send(`{"type":"got","sequence":${header.sequence}}`);
  const key = `${header.robot}/${header.camera}`;
  newest.set(key, { header, jpeg: new Blob([new Uint8Array(data, 24)], { type: "image/jpeg" }) });
  if (!busy.has(key)) void draw(key);
}

async function draw(key: string): Promise<void> {
  busy.add(key);
  try {
    for (let next = newest.get(key); next; next = newest.get(key)) {
      newest.delete(key);
      let bitmap: ImageBitmap;
      try {
        bitmap = await createImageBitmap(next.jpeg);
      } catch {
        continue; // a picture that cannot be read: the next one may
      }
      for (const view of views) if (`${view.robot}/${view.camera}` === key) paint(view, bitmap, next.header);
      bitmap.close();
    }
  } finally {
    busy.delete(key);
  }
}

function paint(view: View, bitmap: ImageBitmap, header: PictureHeader): void {
  const { canvas } = view;
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  canvas.getContext("2d", { alpha: false })?.drawImage(bitmap, 0, 0);
  const at = performance.now();
  const times = (drawn.get(view) ?? []).filter((time) => time > at - 2000);
  times.push(at);
  drawn.set(view, times);
  const span = (at - (times[0] ?? at)) / 1000;
  view.stats.value = {
    fps: span > 0.2 ? (times.length - 1) / span : 0,
    age: Math.max(0, serverNow() - header.time),
    captured: header.time,
    width: bitmap.width,
    height: bitmap.height,
  };
}
