/** From keys, gamepad and touch to an action. Pure: what is pressed goes in, numbers come out. */

import type { Axis, Controls, Plane } from "./protocol";

export interface Pad {
  axes: readonly number[];
  buttons: readonly { value: number }[];
}

export const DEAD_ZONE = 0.15;

/** A stick at rest is never quite at 0; beyond the dead zone the value starts from 0 again, so nothing jumps. */
export function deadZone(value: number, zone = DEAD_ZONE): number {
  const size = Math.abs(value);
  return size <= zone ? 0 : (Math.sign(value) * Math.min(1, size - zone)) / (1 - zone);
}

/** The value of "axis0", "-axis1", "button0/button1" (low/high) or "button7" (high) in -1..1. */
export function padValue(binding: string | null | undefined, pad: Pad | null): number {
  if (!binding || !pad) return 0;
  const button = (name: string): number => {
    const found = /^button(\d+)$/.exec(name.trim());
    return found ? (pad.buttons[Number(found[1])]?.value ?? 0) : 0;
  };
  const axis = /^(-?)axis(\d+)$/.exec(binding.trim());
  if (axis) {
    const value = deadZone(pad.axes[Number(axis[2])] ?? 0);
    return axis[1] && value !== 0 ? -value : value;
  }
  if (binding.includes("/")) {
    const [low = "", high = ""] = binding.split("/");
    return button(high) - button(low);
  }
  return button(binding);
}

/** -1..1 as a number between the bounds of an axis; 0 is the resting place, moved into the bounds where it lies outside. */
export function scale(axis: Axis, value: number): number {
  const rest = Math.min(axis.high, Math.max(axis.low, 0));
  const clipped = Math.min(1, Math.max(-1, value));
  return clipped >= 0 ? rest + clipped * (axis.high - rest) : rest + clipped * (rest - axis.low);
}

export interface Inputs {
  keys: ReadonlySet<string>;
  pad: Pad | null;
  /** What fingers hold on the screen, by position in `controls.axes`, -1..1. */
  touch: ReadonlyMap<number, number>;
  /** Axes that switch, by position: whether they are at their high end. */
  switched?: ReadonlyMap<number, boolean>;
}

/** Deflection of every axis in -1..1, in the order of `controls.axes`. */
export function deflections(controls: Controls, inputs: Inputs): number[] {
  return controls.axes.map((axis, k) => {
    if (axis.toggle) return inputs.switched?.get(k) ? 1 : -1;
    const [low = "", high = ""] = axis.keys;
    const keyed = (high && inputs.keys.has(high) ? 1 : 0) - (low && inputs.keys.has(low) ? 1 : 0);
    const sum = keyed + padValue(axis.gamepad, inputs.pad) + (inputs.touch.get(k) ?? 0);
    return Math.min(1, Math.max(-1, sum));
  });
}

/** Whether a person presses anything that moves the robot. Opposite keys held together count: they mean 0. */
export function anythingPressed(controls: Controls, inputs: Inputs): boolean {
  const values = deflections(controls, inputs);
  if (controls.axes.some((axis, k) => !axis.toggle && values[k] !== 0)) return true;
  return controls.axes.some((axis) => !axis.toggle && axis.keys.some((key) => key !== "" && inputs.keys.has(key)));
}

/** The action: as long as the highest index of the axes says, in the action's own units. */
export function actionOf(controls: Controls, inputs: Inputs): number[] {
  const length = controls.axes.reduce((most, axis) => Math.max(most, axis.index + 1), 0);
  const action = new Array<number>(length).fill(0);
  const values = deflections(controls, inputs);
  controls.axes.forEach((axis, k) => {
    action[axis.index] = scale(axis, values[k] ?? 0);
  });
  return action;
}

/** What a key does to the axes that switch: [position, at its high end?]. */
export function switchesOf(controls: Controls, code: string, now: ReadonlyMap<number, boolean>): [number, boolean][] {
  return controls.axes.flatMap((axis, k): [number, boolean][] => {
    if (!axis.toggle) return [];
    const [low = "", high = ""] = axis.keys;
    if (code === low && code === high) return [[k, !now.get(k)]];
    if (code === high) return [[k, true]];
    return code === low ? [[k, false]] : [];
  });
}

/** The keys that drive: the page must not use them for anything else meanwhile. */
export function driveKeys(controls: Controls): Set<string> {
  const keys = new Set(controls.axes.flatMap((axis) => axis.keys).filter((key) => key !== ""));
  const assist = assistKey(controls);
  if (assist) keys.add(assist);
  return keys;
}

export function assistKey(controls: Controls): string | null {
  if (!controls.assist) return null;
  const taken = new Set(controls.axes.flatMap((axis) => axis.keys));
  return controls.assist_key ?? ["Space", "KeyE", "KeyF", "Enter"].find((key) => !taken.has(key)) ?? null;
}

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** Where the picture lies inside a box that shows it whole (object-fit: contain). */
export function fitted(box: Box, width: number, height: number): Box {
  const scale = Math.min(box.width / width, box.height / height);
  const [w, h] = [width * scale, height * scale];
  return { left: box.left + (box.width - w) / 2, top: box.top + (box.height - h) / 2, width: w, height: h };
}

/** A point of the screen in the picture's own coordinates, 0..1 from the top left, kept inside. */
export function normalised(x: number, y: number, picture: Box): [number, number] {
  const clip = (value: number): number => Math.min(1, Math.max(0, value));
  return [clip((x - picture.left) / picture.width), clip((y - picture.top) / picture.height)];
}

/** Where on the task's plane a point of a picture is (0..1 from the top left) that shows `view` and is width x height pixels. */
export function onPlane([x, y]: [number, number], width: number, height: number, view: Plane): [number, number] {
  const scale = Math.min(width / view.width, height / view.height); // as the server draws
  return [view.x + ((x - 0.5) * width) / scale, view.y - ((y - 0.5) * height) / scale];
}
