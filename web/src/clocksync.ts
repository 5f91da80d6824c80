/** How far the server's clock is from ours, and how long a round trip takes. */

interface Sample {
  rtt: number;
  offset: number;
}

export class ClockSync {
  private samples: Sample[] = [];

  constructor(private readonly keep = 20) {}

  /** A ping that left at `sent` came back at `received` (s, our clock); the server stamped it `server` (s, its clock). */
  add(sent: number, received: number, server: number): void {
    const rtt = received - sent;
    if (!(rtt >= 0) || !Number.isFinite(server)) return;
    this.samples.push({ rtt, offset: server - (sent + received) / 2 });
    if (this.samples.length > this.keep) this.samples.shift();
  }

  reset(): void {
    this.samples = [];
  }

  /** Median round trip of the last pings, s. */
  get rtt(): number | null {
    if (!this.samples.length) return null;
    const sorted = this.samples.slice(-5).map((sample) => sample.rtt).sort((a, b) => a - b);
    return sorted[Math.floor(sorted.length / 2)] ?? null;
  }

  /** Server's clock minus ours, s: from the fastest round trip, whose error is smallest. */
  get offset(): number {
    let best: Sample | undefined;
    for (const sample of this.samples) if (!best || sample.rtt <= best.rtt) best = sample;
    return best?.offset ?? 0;
  }
}

/** Seconds to wait before attempt n (from 0) to reconnect: doubles up to 8 s, spread so that consoles do not come back at once. */
export function backOff(attempt: number, random = Math.random()): number {
  return Math.min(8, 0.5 * 2 ** attempt) * (0.75 + 0.5 * random);
}
