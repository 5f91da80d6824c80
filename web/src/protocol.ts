/** What the server and the page say to each other: HTTP under /api, WebSockets /api/live (JSON) and /api/video (binary). */

export type Role = "viewer" | "operator" | "admin";

export interface Me {
  name: string;
  role: Role;
  seat: number | null;
}

export interface Axis {
  index: number;
  label: string;
  low: number;
  high: number;
  /** KeyboardEvent.code of the key that pushes towards low, and of the one that pushes towards high. */
  keys: [string, string] | string[];
  gamepad?: string | null;
  /** A key press switches between low and high, as a gripper's does, and it stays there. */
  toggle?: boolean;
}

/** A part of the task's plane: its middle and its sides. +y is up. */
export interface Plane {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface Pointer {
  kind: "push" | "go" | "pick_place";
  camera: number;
  /** What a picture shows: whole, in the middle, as large as it fits. */
  view: Plane;
}

export interface Controls {
  axes: Axis[];
  pointer: Pointer | null;
  assist: boolean;
  assist_key?: string;
  /** Each command is one move; else it holds until the next one or until it is stale. */
  once?: boolean;
  help?: string;
}

export interface Description {
  task: string;
  robots: string[];
  cameras: string[];
  hz: number;
  lockstep: boolean;
  humans: number;
  algorithm: string;
  controls: Controls;
  version?: string;
  /** Whether the server can send pictures by WebRTC. */
  webrtc?: boolean;
  /** Timesteps of a hard reset. */
  t_reset?: number;
  /** Seconds without command or heartbeat after which the robot holds, and after which the lease ends. */
  hold_after?: number;
  grace?: number;
}

export type Reason = "" | "violated" | "uncertain" | "risky" | "asked" | "novel" | (string & {});

export interface QueueRow {
  robot: number;
  reason: Reason;
  since: number;
  offered_to: string | null;
}

export interface LeaseRow {
  operator: string;
  id?: string;
  since: number;
  held: boolean;
}

export interface Snapshot {
  t: number;
  time: number;
  mode: number[];
  human: number[];
  age: number[];
  reason: Reason[];
  rank: number[];
  online: boolean[];
  stopped: boolean[];
  held: boolean[];
  queue: QueueRow[];
  leases: Record<string, LeaseRow>;
  policy_version: number;
  tick: number;
  late: number;
}

export interface MetricsRow {
  t: number;
  time: number;
  [name: string]: number | null;
}

export type Level = "info" | "warning" | "error";

export interface Board {
  cards: number;
  /** Card -> picture. */
  face_up: Record<string, number>;
  pairs: number;
  turns: number;
}

/** A participant's session of the user study (appendix B.4). Nothing of it names an algorithm. */
export interface StudyState {
  participant: number;
  stage: "welcome" | "practice_game" | "practice_requests" | "practice_monitoring" | "condition" | "survey" | "done";
  state: "ready" | "running" | "over";
  label: string | null;
  index: number | null;
  of: number;
  interface: "game" | "panes" | null;
  t: number;
  steps: number | null;
  calls: boolean;
  board: Board | null;
  questions: Record<string, string>;
  scale: [number, number] | number[];
  labels: string[];
}

export type ServerMessage =
  | { type: "hello"; me: Me; fleet: Description; metrics: MetricsRow[]; server_time: number; study?: StudyState | null }
  | ({ type: "study" } & StudyState)
  | ({ type: "state" } & Snapshot)
  | { type: "offer"; robot: number; reason: Reason; expires_in: number | null }
  | { type: "lease"; robot: number; id: string }
  | { type: "lease_end"; robot: number; why: string }
  | { type: "metrics"; row: MetricsRow }
  | { type: "notice"; level: Level; text: string }
  | { type: "pong"; n: number; time: number; server_time: number }
  | { type: "error"; code: string; text: string; ref?: number | string | null }
  | { type: "ack"; ref: number | string }
  | { type: "link"; command_latency_ms: { p50: number | null; p99: number | null }; dropped: number };

export interface OperatorRow {
  operator: string;
  /** Whether they have a page open. */
  online?: boolean;
  /** Whether they have a seat and are there. */
  present?: boolean;
  robot?: number | null;
  available?: boolean;
  [statistic: string]: unknown;
}

export interface AuditRow {
  id: number;
  time: number;
  kind: string;
  who: string | null;
  robot: number | null;
  fields: Record<string, unknown>;
  hash: string;
}

export interface EpisodeRow {
  id: number | string;
  robot: number;
  operator: string | null;
  began: number;
  seconds: number;
  outcome: string;
  frames: number;
}

export interface EpisodeFrame {
  t: number;
  mode: number;
  action: number[] | null;
  wanted: number[] | null;
  proposed: number[] | null;
}

export interface Episode extends Omit<EpisodeRow, "frames"> {
  frames: EpisodeFrame[];
  pictures?: boolean;
}

export interface Account {
  name: string;
  role: Role;
  created?: number;
  last_login?: number | null;
}

/** The header of a picture on /api/video, little-endian, 24 bytes. */
export interface PictureHeader {
  robot: number;
  camera: number;
  width: number;
  height: number;
  sequence: number;
  time: number;
}

export const HEADER_BYTES = 24;

export function parseHeader(data: ArrayBuffer): PictureHeader | null {
  if (data.byteLength <= HEADER_BYTES) return null;
  const view = new DataView(data);
  return {
    robot: view.getUint32(0, true),
    camera: view.getUint16(4, true),
    width: view.getUint16(6, true),
    height: view.getUint16(8, true),
    sequence: view.getUint32(12, true),
    time: view.getFloat64(16, true),
  };
}
