/** The states of a robot, in the words and shapes that people see. Numbers are those of tutelage.fleet.modes.Mode. */

import type { Reason } from "./protocol";

export const Mode = { AUTONOMOUS: 0, SWITCHING: 1, TELEOPERATED: 2, VIOLATED: 3, RESETTING: 4, OFFLINE: 5 } as const;

export type Look = "auto" | "asking" | "switching" | "driven" | "violated" | "resetting" | "offline" | "stopped" | "held";

export const LOOK_TEXT: Record<Look, string> = {
  auto: "Autonomous",
  asking: "Asks",
  switching: "Waiting",
  driven: "Driven",
  violated: "Violated",
  resetting: "Resetting",
  offline: "Offline",
  stopped: "Stopped",
  held: "Holding",
};

const OF_MODE: Look[] = ["auto", "switching", "driven", "violated", "resetting", "offline"];

export function lookOfMode(mode: number): Look {
  return OF_MODE[mode] ?? "offline";
}

/** A stop outranks everything, and a robot that is off the air is offline whatever it did last. */
export function lookOf(mode: number, online: boolean, stopped: boolean, held = false, asking = false, fallen = false): Look {
  if (stopped) return "stopped";
  if (!online) return "offline";
  const look = lookOfMode(mode);
  if (fallen && look === "switching") return "violated"; // somebody is with it, and it still lies there
  if (held && look === "driven") return "held";
  return asking && look === "auto" ? "asking" : look;
}

const REASONS: Record<string, string> = {
  violated: "Violated its constraint",
  uncertain: "Uncertain what to do",
  risky: "Likely to fail",
  asked: "Asked for help",
  novel: "New situation",
};

export function reasonText(reason: Reason): string {
  return reason === "" ? "Needs help" : (REASONS[reason] ?? reason);
}

const SHORT: Record<string, string> = { violated: "violated", uncertain: "uncertain", risky: "risky", asked: "asked", novel: "novel" };

export function reasonShort(reason: Reason): string {
  return reason === "" ? "needs help" : (SHORT[reason] ?? reason);
}

const ENDINGS: Record<string, string> = {
  given_back: "You gave it back.",
  expired: "The lease expired: no sign of you for too long.",
  handed_over: "It was handed over.",
  reset_done: "The reset is done; it goes on by itself.",
  offline: "It went offline.",
  stopped: "It was stopped.",
  violated: "It violated its constraint; it needs a reset.",
  completed: "It completed its task.",
  ceded: "The algorithm lets it go on.",
  lost: "The connection was lost.",
};

export function endingText(why: string): string {
  return ENDINGS[why] ?? why;
}
