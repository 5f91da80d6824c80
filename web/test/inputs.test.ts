import { describe, expect, it } from "vitest";
import { actionOf, anythingPressed, assistKey, deadZone, deflections, driveKeys, fitted, normalised, onPlane, padValue, scale, switchesOf, type Inputs } from "../src/inputs";
import type { Controls } from "../src/protocol";

const controls: Controls = {
  axes: [
    { index: 0, label: "x", low: -1, high: 1, keys: ["ArrowLeft", "ArrowRight"], gamepad: "axis0" },
    { index: 2, label: "z", low: -0.5, high: 2, keys: ["KeyS", "KeyW"], gamepad: "-axis1" },
    { index: 1, label: "grip", low: -1, high: 1, keys: ["Space", "Space"], gamepad: null, toggle: true },
  ],
  pointer: null,
  assist: true,
};
const pressed = (...keys: string[]): Inputs => ({ keys: new Set(keys), pad: null, touch: new Map() });

describe("keys become actions", () => {
  it("puts each axis at its index and scales it to its own bounds", () => {
    expect(actionOf(controls, pressed("ArrowRight", "KeyW"))).toEqual([1, -1, 2]);
    expect(actionOf(controls, pressed("KeyS"))).toEqual([0, -1, -0.5]);
  });
  it("lets opposite keys cancel, and still counts them as pressed", () => {
    expect(deflections(controls, pressed("ArrowLeft", "ArrowRight"))[0]).toBe(0);
    expect(anythingPressed(controls, pressed("ArrowLeft", "ArrowRight"))).toBe(true);
  });
  it("does not take a switch that rests for a press", () => {
    expect(anythingPressed(controls, pressed())).toBe(false);
    expect(anythingPressed(controls, { ...pressed(), switched: new Map([[2, true]]) })).toBe(false);
    expect(anythingPressed(controls, { ...pressed(), touch: new Map([[0, 0.4]]) })).toBe(true);
  });
  it("switches where one key is both ends, and sets where each end has its own", () => {
    expect(switchesOf(controls, "Space", new Map())).toEqual([[2, true]]);
    expect(switchesOf(controls, "Space", new Map([[2, true]]))).toEqual([[2, false]]);
    expect(switchesOf(controls, "KeyW", new Map())).toEqual([]);
  });
  it("chooses a key for the expert that nothing else uses", () => {
    expect(assistKey(controls)).toBe("KeyE");
    expect(assistKey({ ...controls, assist: false })).toBeNull();
    expect(driveKeys(controls)).toEqual(new Set(["ArrowLeft", "ArrowRight", "KeyS", "KeyW", "Space", "KeyE"]));
  });
  it("rests at the nearest bound where 0 lies outside", () => {
    const axis = { index: 0, label: "", low: 1, high: 3, keys: ["", ""] };
    expect([scale(axis, 0), scale(axis, 1), scale(axis, 9)]).toEqual([1, 3, 3]);
  });
});

describe("gamepads", () => {
  const pad = { axes: [0.05, -1], buttons: [{ value: 0 }, { value: 1 }] };
  it("reads axes, reversed axes and buttons", () => {
    expect(padValue("axis0", pad)).toBe(0);
    expect(padValue("-axis1", pad)).toBe(1);
    expect(padValue("button0/button1", pad)).toBe(1);
    expect(padValue("button1/button0", pad)).toBe(-1);
    expect(padValue("button9", pad)).toBe(0);
    expect(padValue("nonsense", pad)).toBe(0);
    expect(padValue("axis0", null)).toBe(0);
  });
  it("has no jump at the edge of the dead zone", () => {
    expect(deadZone(0.15)).toBe(0);
    expect(deadZone(0.1501)).toBeLessThan(0.001);
    expect(deadZone(-1)).toBe(-1);
  });
});

describe("the pointer", () => {
  it("is measured in the picture, not in the box around it", () => {
    const picture = fitted({ left: 0, top: 0, width: 400, height: 400 }, 320, 180);
    expect(picture).toEqual({ left: 0, top: 87.5, width: 400, height: 225 });
    expect(normalised(200, 200, picture)).toEqual([0.5, 0.5]);
    expect(normalised(500, 0, picture)).toEqual([1, 0]);
  });
  it("means the same place on the plane whatever the shape of the picture", () => {
    const table = { x: 0, y: 0, width: 0.32, height: 0.32 };
    for (const [width, height] of [[320, 180], [320, 240], [240, 240], [180, 320]] as const) {
      const pixel = 0.32 / Math.min(width, height);
      expect(onPlane([0.5, 0.5], width, height, table)).toEqual([0, 0]);
      const [x, y] = onPlane([0.5 + 30 / width, 0.5 + 40 / height], width, height, table);
      expect([x / pixel, y / pixel]).toEqual([expect.closeTo(30, 9), expect.closeTo(-40, 9)]);
    }
  });
  it("means the corners of the plane at those of a picture of its shape", () => {
    const maze = { x: 49.5, y: 30, width: 100, height: 61 };
    expect(onPlane([0, 0], 200, 122, maze)).toEqual([-0.5, 60.5]);
    expect(onPlane([1, 1], 200, 122, maze)).toEqual([99.5, -0.5]);
  });
});
