/** What the console knows, as signals: a part of the page redraws when what it shows changes, not at every message. */

import { batch, computed, signal, type Signal } from "@preact/signals";
import { ClockSync } from "./clocksync";
import { lookOf, Mode, type Look } from "./modes";
import type { Description, Level, Me, MetricsRow, QueueRow, Reason, Snapshot, StudyState } from "./protocol";

/** undefined: not asked yet; null: nobody is signed in. */
export const me = signal<Me | null | undefined>(undefined);
export const fleet = signal<Description | null>(null);

export type Connection = { kind: "off" } | { kind: "connecting" } | { kind: "open" } | { kind: "lost"; retryAt: number; attempt: number };
export const connection = signal<Connection>({ kind: "off" });

export interface Robot {
  index: number;
  name: string;
  look: Look;
  mode: number;
  reason: Reason;
  rank: number;
  online: boolean;
  stopped: boolean;
  held: boolean;
  /** Who drives it or holds its lease. */
  operator: string | null;
  /** Since when (server's clock, s) it waits in the queue; null: it does not wait. */
  waiting: number | null;
  offeredTo: string | null;
}

export const robots = signal<Signal<Robot>[]>([]);
export const snapshot = signal<Snapshot | null>(null);
export const queue = signal<QueueRow[]>([]);
export const metrics = signal<MetricsRow[]>([]);

/** Requests that the server offers to this person: robot -> when the offer lapses (our clock, s). */
export const offers = signal<ReadonlyMap<number, { reason: Reason; since: number; until: number; seconds: number }>>(new Map());
/** The robot that this person drives, and the lease's id. */
export const lease = signal<{ robot: number; id: string } | null>(null);
/** Why the last one ended. */
export const lastEnd = signal("");
/** Robots that this person asked for and does not have yet. */
export const asked = signal<ReadonlySet<number>>(new Set());
export const available = signal(true);
/** The user study, where the server runs one; null: it runs a fleet. */
export const study = signal<StudyState | null>(null);

export const clockSync = new ClockSync();
/** Updated twice a second, so that countdowns and ages move. Our clock, s. */
export const now = signal(Date.now() / 1000);
export const rtt = signal<number | null>(null);
export const link = signal<{ p50: number | null; p99: number | null; dropped: number }>({ p50: null, p99: null, dropped: 0 });
/** When the last state arrived, our clock, s. */
export const stateAt = signal<number | null>(null);
/** The last robots' modes, newest last: one column a second, for the ribbons under the pictures. */
export const RIBBON = 90;
export const history = signal<Uint8Array[]>([]);
export const historyTick = signal(0);

/** Whether states stopped coming. In lock-step the simulation waits for people: then silence means nothing. */
export function silent(seconds: number): boolean {
  return !fleet.value?.lockstep && stateAt.value !== null && now.value - stateAt.value > seconds;
}

/** The server's clock, s. */
export function serverNow(): number {
  return Date.now() / 1000 + clockSync.offset;
}

export interface Note {
  id: number;
  level: Level;
  text: string;
  at: number;
}
export const notes = signal<Note[]>([]);
let noteId = 0;

export function note(text: string, level: Level = "info"): void {
  const last = notes.value.at(-1);
  if (last && last.text === text && Date.now() - last.at < 2000) return;
  notes.value = [...notes.value.slice(-4), { id: ++noteId, level, text, at: Date.now() }];
}

export function dropNote(id: number): void {
  notes.value = notes.value.filter((other) => other.id !== id);
}

export const canOperate = computed(() => me.value?.role === "operator" || me.value?.role === "admin");
export const isAdmin = computed(() => me.value?.role === "admin");
export const anyStopped = computed(() => snapshot.value?.stopped.some(Boolean) ?? false);
export const allStopped = computed(() => {
  const stopped = snapshot.value?.stopped;
  return !!stopped?.length && stopped.every(Boolean);
});

export const tally = computed(() => {
  const counts: Record<Look, number> = { auto: 0, asking: 0, switching: 0, driven: 0, violated: 0, resetting: 0, offline: 0, stopped: 0, held: 0 };
  for (const robot of robots.value) counts[robot.value.look] += 1;
  return counts;
});

export function robotName(index: number): string {
  return fleet.value?.robots[index] ?? `Robot ${index}`;
}

function blank(index: number, name: string): Robot {
  return {
    index, name, look: "offline", mode: Mode.OFFLINE, reason: "", rank: -1, online: false, stopped: false, held: false,
    operator: null, waiting: null, offeredTo: null,
  };
}

export function describe(description: Description): void {
  batch(() => {
    const same = fleet.value && fleet.value.robots.join("\n") === description.robots.join("\n");
    fleet.value = description;
    if (!same) {
      robots.value = description.robots.map((name, index) => signal(blank(index, name)));
      history.value = description.robots.map(() => new Uint8Array(RIBBON).fill(255));
    }
  });
}

let queueKey = "";

const FIELDS: (keyof Robot)[] = ["look", "mode", "reason", "rank", "online", "stopped", "held", "operator", "waiting", "offeredTo"];

/** Take in a state; robots that did not change keep their object. */
export function applySnapshot(next: Snapshot): void {
  batch(() => {
    const waiting = new Map(next.queue.map((row) => [row.robot, row]));
    robots.value.forEach((cell, index) => {
      const old = cell.value;
      const row = waiting.get(index);
      const held = !!next.held[index];
      const mode = next.mode[index] ?? Mode.OFFLINE;
      const online = !!next.online[index];
      const stopped = !!next.stopped[index];
      const fresh: Robot = {
        index,
        name: old.name,
        mode,
        look: lookOf(mode, online, stopped, held, row !== undefined, next.reason[index] === "violated"),
        reason: row?.reason || next.reason[index] || "",
        rank: next.rank[index] ?? -1,
        online,
        stopped,
        held,
        operator: next.leases[String(index)]?.operator ?? null,
        waiting: row?.since ?? null,
        offeredTo: row?.offered_to ?? null,
      };
      if (FIELDS.some((field) => fresh[field] !== old[field])) cell.value = fresh;
    });
    snapshot.value = next;
    const key = next.queue.map((row) => `${row.robot} ${row.reason} ${row.since} ${row.offered_to}`).join("|");
    if (key !== queueKey) {
      queueKey = key;
      queue.value = next.queue;
    }
    stateAt.value = Date.now() / 1000;
  });
}

const LOOK_CODE: Look[] = ["auto", "switching", "driven", "violated", "resetting", "offline", "stopped", "held", "asking"];
export const lookOfCode = (code: number): Look | null => LOOK_CODE[code] ?? null;

/** Called once a second: the ribbons move on by one column. */
export function advanceHistory(): void {
  if (!snapshot.value) return;
  robots.value.forEach((cell, index) => {
    const row = history.value[index];
    if (!row) return;
    row.copyWithin(0, 1);
    row[RIBBON - 1] = LOOK_CODE.indexOf(cell.value.look);
  });
  historyTick.value += 1;
}

/** After a lost connection: nothing that was granted is known to hold. */
export function forget(): void {
  batch(() => {
    offers.value = new Map();
    lease.value = null;
    asked.value = new Set();
    rtt.value = null;
    clockSync.reset();
  });
}

export function addMetrics(rows: MetricsRow[], replace = false): void {
  const kept = replace ? [] : metrics.value;
  const last = kept.at(-1)?.t ?? -1;
  metrics.value = [...kept, ...rows.filter((row) => replace || row.t > last)].slice(-7200);
}
