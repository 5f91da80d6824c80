/** Driving: what is pressed becomes commands, at the fleet's rate and only while something is pressed; heartbeats keep the lease. */

import { batch, effect, signal, untracked } from "@preact/signals";
import { actionOf, anythingPressed, assistKey, deflections, driveKeys, switchesOf, type Inputs, type Pad } from "./inputs";
import { backlog, send } from "./live";
import type { Controls } from "./protocol";
import { fleet, lease } from "./store";

const RENEW = 200; // ms; the server holds a robot after 500 ms without a sign of life
const SWITCH = 400; // ms that a switch is repeated for: a gripper needs time to close
const SOONEST = 15; // ms between two commands, however fast people press

/** Where somebody points: in the picture (0..1 from the top left), and on the task's plane. */
export type Spot = { picture: [number, number]; plane: [number, number] };
export type Drag = { from: Spot; to: Spot };

/** What is pressed now, for the page to show. */
export const held = signal<{ values: number[]; assist: boolean; drag: Drag | null }>({ values: [], assist: false, drag: null });
export const padName = signal<string | null>(null);
/** Whether commands leave now. */
export const sending = signal(false);
/** A command went out: how many so far. */
export const sent = signal(0);

const keys = new Set<string>();
const touch = new Map<number, number>();
const switched = new Map<number, boolean>();
let switchedAt = 0;
let drag: Drag | null = null;
let assistButton = false;
let seq = Date.now(); // grows over reloads of the page, too
let lastSent = 0;
let wasPressed = false;
let stopDriving: (() => void) | null = null;

function controls(): Controls | null {
  return fleet.value?.controls ?? null;
}

function pad(): Pad | null {
  const found = navigator.getGamepads?.().find((one) => one?.connected) ?? null;
  padName.value = found ? found.id.replace(/\s*\(.*$/, "") : null;
  return found;
}

function inputs(): Inputs {
  return { keys, pad: pad(), touch, switched };
}

/** Fingers on the on-screen sticks: position in `controls.axes`, value -1..1 (0 lets go). */
export function setTouch(axis: number, value: number): void {
  if (value) touch.set(axis, value);
  else touch.delete(axis);
  tick(true);
}

/** An axis that switches goes to one of its ends and stays there. */
export function setSwitch(axis: number, high: boolean): void {
  switched.set(axis, high);
  switchedAt = performance.now();
  tick(true);
}

export function setAssist(on: boolean): void {
  assistButton = on;
  tick(true);
}

export function dragTo(next: Drag | null): void {
  drag = next;
  const kind = controls()?.pointer?.kind;
  if (kind === "go") tick(true);
  else refresh();
}

/** A push or a pick and place is one command, sent when the finger lifts. */
export function drop(): void {
  const kind = controls()?.pointer?.kind;
  const done = drag;
  drag = null;
  if (done && kind && kind !== "go") {
    const far = Math.hypot(done.to.picture[0] - done.from.picture[0], done.to.picture[1] - done.from.picture[1]);
    if (far > 0.01) command(null, false, [...done.from.plane, ...done.to.plane]);
  }
  tick(true);
}

export function letGo(): void {
  keys.clear();
  touch.clear();
  drag = null;
  assistButton = false;
  tick(true);
}

function assisting(): boolean {
  const which = controls();
  if (!which?.assist) return false;
  const key = assistKey(which);
  return assistButton || (key !== null && keys.has(key));
}

function command(action: number[] | null, assist: boolean, push: number[] | null): void {
  const holding = lease.value;
  if (!holding || backlog() > 65536) return;
  lastSent = performance.now();
  if (send({ type: "command", robot: holding.robot, lease: holding.id, seq: ++seq, sent: Date.now(), action, assist, push })) sent.value += 1;
}

function refresh(): void {
  const which = controls();
  if (!which) return;
  const values = deflections(which, inputs());
  const assist = assisting();
  const old = held.value;
  if (assist !== old.assist || drag !== old.drag || values.length !== old.values.length || values.some((value, k) => value !== old.values[k])) {
    held.value = { values, assist, drag: drag && { ...drag } };
  }
}

function tick(changed = false): void {
  const which = controls();
  const holding = lease.value;
  refresh();
  if (!which || !holding) {
    sending.value = false;
    wasPressed = false;
    return;
  }
  if (changed && performance.now() - lastSent < SOONEST) return;
  const state = inputs();
  const going = which.pointer?.kind === "go" && drag !== null;
  const assist = assisting();
  const switching = performance.now() - switchedAt < SWITCH;
  const pressed = watching() && (going || assist || switching || anythingPressed(which, state));
  if (pressed) {
    if (assist) command(null, true, null);
    else if (going && drag) command(null, false, [...drag.from.plane, ...drag.to.plane]);
    else if (!which.once || !wasPressed) command(actionOf(which, state), false, null); // a push is one move, however long the key is down
  } else if (wasPressed && !which.once) {
    command(null, false, null); // nothing is pressed any more: the robot holds at once, not when the last command is stale
  }
  wasPressed = pressed;
  sending.value = pressed;
}

/** Nobody drives a robot that is not in front of them: on other pages the keys move nothing, and the robot holds. */
function watching(): boolean {
  return document.querySelector(".stage-mine") !== null;
}

function typing(target: EventTarget | null): boolean {
  const element = target as HTMLElement | null;
  return !!element?.closest?.("input:not([type=range]):not([type=checkbox]), textarea, select, [contenteditable]");
}

function begin(): () => void {
  const which = controls();
  if (!which) return () => undefined;
  const mine = driveKeys(which);
  const blocked = (event: KeyboardEvent): boolean =>
    event.ctrlKey || event.metaKey || event.altKey || typing(event.target) || document.querySelector("dialog[open]") !== null;
  const down = (event: KeyboardEvent): void => {
    if (!mine.has(event.code) || blocked(event) || !watching()) return;
    // Space and Enter on a focused button still press the button; on the picture they drive.
    if ((event.code === "Space" || event.code === "Enter") && (event.target as HTMLElement).closest?.("button, a, summary")) return;
    event.preventDefault();
    if (event.repeat) return;
    keys.add(event.code);
    for (const [axis, high] of switchesOf(which, event.code, switched)) setSwitch(axis, high);
    tick(true);
  };
  const up = (event: KeyboardEvent): void => {
    if (!keys.delete(event.code)) return;
    event.preventDefault();
    tick(true);
  };
  const away = (): void => {
    if (document.hidden) letGo();
    else renew();
  };
  const renew = (): void => {
    const holding = lease.value;
    if (holding && !document.hidden) send({ type: "renew", lease: holding.id });
  };
  window.addEventListener("keydown", down);
  window.addEventListener("keyup", up);
  window.addEventListener("blur", letGo);
  document.addEventListener("visibilitychange", away);
  const hz = Math.min(60, Math.max(1, fleet.value?.hz ?? 10));
  const rate = window.setInterval(() => tick(), 1000 / hz);
  const beat = window.setInterval(renew, RENEW);
  switched.clear();
  renew();
  return () => {
    window.removeEventListener("keydown", down);
    window.removeEventListener("keyup", up);
    window.removeEventListener("blur", letGo);
    document.removeEventListener("visibilitychange", away);
    window.clearInterval(rate);
    window.clearInterval(beat);
    batch(() => {
      letGo();
      sending.value = false;
    });
  };
}

let driven: string | null = null;

/** Follows the lease: driving begins when it is granted and ends with it. */
export function followLease(): void {
  effect(() => {
    const id = lease.value?.id ?? null;
    if (id === driven) return;
    driven = id;
    untracked(() => {
      stopDriving?.();
      stopDriving = id ? begin() : null;
    });
  });
}

/** The first of some keys that does not drive the robots of this task: a shortcut that always works. */
export function freeKey(...codes: string[]): string {
  const which = controls();
  const taken = which ? driveKeys(which) : new Set<string>();
  return codes.find((code) => !taken.has(code)) ?? "";
}

export const giveBackKey = (): string => freeKey("KeyG", "KeyB", "KeyY");
export const resetKey = (): string => freeKey("KeyH", "KeyN", "KeyU");

/** Whether a key drives the robot now and so is no shortcut. */
export function isDriveKey(code: string): boolean {
  const which = controls();
  return lease.value !== null && which !== null && driveKeys(which).has(code);
}
