/** The live socket: one connection that comes back by itself, and what people say through it. */

import { batch } from "@preact/signals";
import { ApiError, get } from "./api";
import { backOff } from "./clocksync";
import { chime } from "./chime";
import { endingText, reasonText } from "./modes";
import type { Me, Reason, ServerMessage } from "./protocol";
import * as store from "./store";

type Waiting = { resolve: () => void; reject: (error: Error) => void; timer: number };

let socket: WebSocket | null = null;
let wanted = false;
let attempt = 0;
let retryTimer = 0;
let pingTimer = 0;
let lastPing = 0;
let pings = 0;
let refs = 0;
const waiting = new Map<string, Waiting>();

export class Refused extends Error {
  constructor(
    readonly code: string,
    text: string,
  ) {
    super(text);
  }
}

export function socketUrl(path: string): string {
  return `${location.protocol === "https:" ? "wss:" : "ws:"}//${location.host}${path}`;
}

export function connect(): void {
  wanted = true;
  if (socket) return;
  window.clearTimeout(retryTimer);
  store.connection.value = { kind: "connecting" };
  const mine = new WebSocket(socketUrl("/api/live"));
  socket = mine;
  mine.onmessage = (event) => {
    if (mine !== socket) return;
    let message: ServerMessage;
    try {
      message = JSON.parse(String(event.data)) as ServerMessage;
    } catch {
      return;
    }
    receive(message);
    if (performance.now() - lastPing > 1500) ping(); // timers sleep in a hidden tab, messages do not
  };
  mine.onclose = (event) => {
    if (mine === socket) closed(event.code);
  };
}

export function disconnect(): void {
  wanted = false;
  window.clearTimeout(retryTimer);
  window.clearInterval(pingTimer);
  const old = socket;
  socket = null;
  old?.close(1000);
  failAll("The connection was closed.");
  store.forget();
  store.connection.value = { kind: "off" };
}

function closed(code: number): void {
  socket = null;
  window.clearInterval(pingTimer);
  failAll("The connection was lost.");
  const held = store.lease.value;
  batch(() => {
    store.forget();
    if (held && code !== 1012) store.note(`${store.robotName(held.robot)}: the connection was lost, the robot holds.`, "error");
  });
  if (!wanted) return;
  if (code === 1012) {
    // The server goes on with other robots: it says so, and is there.
    attempt = 0;
    store.connection.value = { kind: "connecting" };
    retryTimer = window.setTimeout(connect, 250);
    return;
  }
  if (code === 4401 || code === 1008 || code === 4403) void checkSession();
  scheduleRetry();
}

function scheduleRetry(): void {
  const seconds = backOff(attempt);
  store.connection.value = { kind: "lost", retryAt: Date.now() / 1000 + seconds, attempt };
  attempt += 1;
  window.clearTimeout(retryTimer);
  retryTimer = window.setTimeout(() => {
    // A browser tells a socket's refusal from an unreachable server only by asking.
    void checkSession().then((over) => {
      if (!over && wanted && !socket) connect();
    });
  }, seconds * 1000);
}

export function retryNow(): void {
  if (!wanted || socket) return;
  window.clearTimeout(retryTimer);
  connect();
}

async function checkSession(): Promise<boolean> {
  try {
    store.me.value = await get<Me>("/api/me");
    return false;
  } catch (error) {
    return error instanceof ApiError && error.status === 401;
  }
}

function failAll(text: string): void {
  for (const [ref, entry] of waiting) {
    window.clearTimeout(entry.timer);
    waiting.delete(ref);
    entry.reject(new Refused("lost", text));
  }
}

export function send(message: Record<string, unknown>): boolean {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

/** How much has not left this machine yet, bytes: a reason not to send more commands. */
export function backlog(): number {
  return socket?.bufferedAmount ?? 0;
}

/** Say something that the server answers with yes or no. */
export function ask(message: Record<string, unknown>): Promise<void> {
  const ref = `r${++refs}`;
  return new Promise((resolve, reject) => {
    if (!send({ ...message, ref })) {
      reject(new Refused("lost", "There is no connection."));
      return;
    }
    const timer = window.setTimeout(() => {
      waiting.delete(ref);
      reject(new Refused("timeout", "The server did not answer."));
    }, 5000);
    waiting.set(ref, { resolve, reject, timer });
  });
}

function ping(): void {
  lastPing = performance.now();
  send({ type: "ping", n: ++pings, time: Date.now() / 1000 });
}

function receive(message: ServerMessage): void {
  switch (message.type) {
    case "hello":
      attempt = 0;
      batch(() => {
        store.me.value = message.me;
        store.describe(message.fleet);
        store.addMetrics(message.metrics ?? [], true);
        store.study.value = message.study ?? null;
        store.connection.value = { kind: "open" };
      });
      ping();
      window.clearInterval(pingTimer);
      pingTimer = window.setInterval(ping, 1000);
      if (!store.available.value && store.canOperate.value) send({ type: "available", yes: false, ref: `r${++refs}` });
      break;
    case "state":
      store.applySnapshot(message);
      withdraw();
      break;
    case "offer":
      offered(message.robot, message.reason, message.expires_in);
      break;
    case "lease":
      batch(() => {
        store.lease.value = { robot: message.robot, id: message.id };
        forgetRobot(message.robot);
      });
      break;
    case "lease_end":
      ended(message.robot, message.why);
      break;
    case "study": {
      const { type: _, ...state } = message;
      if (state.calls && !store.study.value?.calls && state.interface === "game") {
        chime("request");
        spoken("A robot needs help.");
      }
      store.study.value = state;
      break;
    }
    case "metrics":
      store.addMetrics([message.row]);
      break;
    case "notice":
      store.note(message.text, message.level);
      break;
    case "pong":
      store.clockSync.add(message.time, Date.now() / 1000, message.server_time);
      store.rtt.value = store.clockSync.rtt;
      break;
    case "link":
      store.link.value = { ...message.command_latency_ms, dropped: message.dropped };
      break;
    case "ack": {
      const entry = waiting.get(String(message.ref));
      if (entry) {
        window.clearTimeout(entry.timer);
        waiting.delete(String(message.ref));
        entry.resolve();
      }
      break;
    }
    case "error": {
      const entry = message.ref == null ? undefined : waiting.get(String(message.ref));
      if (entry) {
        window.clearTimeout(entry.timer);
        waiting.delete(String(message.ref));
        entry.reject(new Refused(message.code, message.text));
      } else if (message.code === "stale_lease" || message.code === "not_yours") {
        doubt();
      } else {
        store.note(message.text || message.code, "warning");
      }
    }
  }
}

/** Offers that went to somebody else: the queue says who has them now. A robot that is handed over is not in the queue. */
function withdraw(): void {
  const state = store.snapshot.value;
  const name = store.me.value?.name;
  const at = Date.now() / 1000;
  for (const [robot, offer] of store.offers.value) {
    if (at - offer.since < 1 || state?.leases[String(robot)]) continue;
    if (state?.queue.find((row) => row.robot === robot)?.offered_to !== name) forgetRobot(robot);
  }
}

function forgetRobot(robot: number): void {
  if (store.offers.value.has(robot)) {
    const offers = new Map(store.offers.value);
    offers.delete(robot);
    store.offers.value = offers;
  }
  if (store.asked.value.has(robot)) {
    const asked = new Set(store.asked.value);
    asked.delete(robot);
    store.asked.value = asked;
  }
}

function offered(robot: number, reason: Reason, expiresIn: number | null): void {
  const seconds = expiresIn ?? 15;
  const known = store.offers.value.has(robot);
  const offers = new Map(store.offers.value);
  offers.set(robot, { reason, since: Date.now() / 1000, until: Date.now() / 1000 + seconds, seconds });
  store.offers.value = offers;
  if (!known && !store.study.value) {
    chime(reason === "violated" ? "urgent" : "request");
    spoken(`${store.robotName(robot)} asks for help: ${reasonText(reason)}.`);
  }
}

function ended(robot: number, why: string): void {
  const mine = store.lease.value?.robot === robot;
  batch(() => {
    if (mine) {
      store.lastEnd.value = why;
      store.lease.value = null;
    }
    forgetRobot(robot);
    if (mine) store.note(`${store.robotName(robot)}: ${endingText(why)}`, why === "expired" || why === "lost" ? "warning" : "info");
  });
}

/** A heartbeat was refused. Mostly the news of why is on its way; where none comes, the lease is over all the same. */
function doubt(): void {
  const held = store.lease.value;
  if (!held) return;
  window.setTimeout(() => {
    if (store.lease.value?.id === held.id) ended(held.robot, "expired");
  }, 1500);
}

/** The text that screen readers say at once. */
export function spoken(text: string): void {
  const region = document.getElementById("spoken");
  if (region) region.textContent = text;
}

async function tell(message: Record<string, unknown>): Promise<boolean> {
  try {
    await ask(message);
    return true;
  } catch (error) {
    store.note(error instanceof Error ? error.message : String(error), "warning");
    return false;
  }
}

function markAsked(robot: number, yes: boolean): void {
  const asked = new Set(store.asked.value);
  if (yes) asked.add(robot);
  else asked.delete(robot);
  store.asked.value = asked;
}

/** Accept an offer, or claim a robot that nobody holds. */
export async function takeOver(robot: number): Promise<void> {
  const offered = store.offers.value.has(robot);
  markAsked(robot, true);
  const ok = await tell({ type: offered ? "accept" : "take", robot });
  if (!ok) {
    markAsked(robot, false);
    forgetRobot(robot);
  }
}

export async function decline(robot: number): Promise<void> {
  forgetRobot(robot);
  await tell({ type: "decline", robot });
}

export const giveBack = (robot: number): Promise<boolean> => tell({ type: "give_back", robot });
export const hardReset = (robot: number): Promise<boolean> => tell({ type: "reset", robot });
export const handOver = (robot: number, to: string): Promise<boolean> => tell({ type: "hand_over", robot, to });

export async function setAvailable(yes: boolean): Promise<void> {
  const before = store.available.value;
  store.available.value = yes;
  if (!yes) store.offers.value = new Map();
  if (!(await tell({ type: "available", yes }))) store.available.value = before;
}
