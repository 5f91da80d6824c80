/** Two soft tones for a request, made by the browser; a lower, longer pair where a robot has violated its constraint. */

import { signal } from "@preact/signals";

export type Chime = "request" | "urgent";

const KEY = "tutelage.sound";
export const soundOn = signal(read() !== "off");
/** Browsers make no sound before a person has touched the page. */
export const soundReady = signal(false);
let context: AudioContext | null = null;
let last = 0;

function read(): string | null {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}

export function setSound(on: boolean): void {
  soundOn.value = on;
  try {
    localStorage.setItem(KEY, on ? "on" : "off");
  } catch {
    // private windows have no storage: the choice lasts as long as the page
  }
  if (on) {
    unlock();
    chime("request");
  }
}

export function unlock(): void {
  try {
    context ??= new AudioContext();
    void context.resume().then(() => {
      soundReady.value = context?.state === "running";
    });
  } catch {
    soundReady.value = false;
  }
}

/** For tests: how many chimes were asked for. */
export const chimes = { count: 0 };

export function chime(kind: Chime): void {
  chimes.count += 1;
  document.documentElement.dataset["chimes"] = String(chimes.count);
  if (!soundOn.value || !context || context.state !== "running") return;
  const at = context.currentTime;
  if (at - last < 0.4) return; // ten requests at once are one sound
  last = at;
  const tones = kind === "urgent" ? [392, 311.1] : [659.3, 880];
  tones.forEach((frequency, k) => tone(frequency, at + k * 0.16, kind === "urgent" ? 0.7 : 0.45));
}

function tone(frequency: number, at: number, seconds: number): void {
  if (!context) return;
  const gain = context.createGain();
  gain.gain.setValueAtTime(0.0001, at);
  gain.gain.exponentialRampToValueAtTime(0.16, at + 0.015);
  gain.gain.exponentialRampToValueAtTime(0.0001, at + seconds);
  gain.connect(context.destination);
  for (const [multiple, level] of [[1, 1], [2, 0.25]] as const) {
    const oscillator = context.createOscillator();
    const part = context.createGain();
    oscillator.frequency.value = frequency * multiple;
    part.gain.value = level;
    oscillator.connect(part).connect(gain);
    oscillator.start(at);
    oscillator.stop(at + seconds + 0.05);
  }
}
