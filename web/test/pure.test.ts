import { describe, expect, it } from "vitest";
import { backOff, ClockSync } from "../src/clocksync";
import { clock, duration, keyLabel, moment, number, percent } from "../src/format";
import { lookOf } from "../src/modes";
import { parseHeader } from "../src/protocol";
import { bounds, nearest, thin, ticks } from "../src/series";

describe("clocks", () => {
  it("trust the fastest round trip for the offset and the median for the delay", () => {
    const sync = new ClockSync();
    sync.add(0, 1, 100.9); // slow, and wrong by 0.4
    sync.add(2, 2.02, 102.01);
    sync.add(3, 3.04, 103.02);
    expect(sync.offset).toBeCloseTo(100, 6);
    expect(sync.rtt).toBeCloseTo(0.04, 6);
    sync.add(5, 4, 100); // a clock that went back says nothing
    expect(sync.rtt).toBeCloseTo(0.04, 6);
  });
  it("wait longer each time, up to a bound, and not all together", () => {
    expect(backOff(0, 0.5)).toBe(0.5);
    expect(backOff(3, 0.5)).toBe(4);
    expect(backOff(50, 1)).toBe(10);
    expect(backOff(50, 0)).toBe(6);
  });
});

describe("what people read", () => {
  it("is short", () => {
    expect([clock(7), clock(245), clock(3723), clock(NaN)]).toEqual(["0:07", "4:05", "1:02:03", "–"]);
    expect([duration(0.44), duration(12), duration(180), duration(7560)]).toEqual(["0.4 s", "12 s", "3 min", "2.1 h"]);
    expect([number(3), number(0.1234), number(12345.6), number(null), number(Infinity)]).toEqual(["3", "0.12", "12\u2009346", "–", "–"]);
    expect([percent(0.153), percent(0.005), percent(0)]).toEqual(["15 %", "0.5 %", "0 %"]);
    expect([keyLabel("ArrowUp"), keyLabel("KeyQ"), keyLabel("Digit3")]).toEqual(["↑", "Q", "3"]);
  });
  it("names the day only when it is not today", () => {
    const noon = new Date(2024, 4, 5, 12, 0, 0).getTime();
    expect(moment(noon / 1000, noon)).toBe("12:00:00");
    expect(moment(noon / 1000 - 86400, noon)).toBe("2024-05-04 12:00:00");
  });
});

describe("a robot's look", () => {
  it("is stopped before anything else, then offline", () => {
    expect(lookOf(2, false, true)).toBe("stopped");
    expect(lookOf(2, false, false)).toBe("offline");
    expect(lookOf(2, true, false, true)).toBe("held");
    expect(lookOf(0, true, false, false, true)).toBe("asking");
    expect(lookOf(1, true, false, false, false, true)).toBe("violated");
    expect(lookOf(3, true, false, false, true)).toBe("violated");
  });
});

describe("pictures", () => {
  it("begin with 24 bytes, little-endian", () => {
    const data = new ArrayBuffer(30);
    const view = new DataView(data);
    view.setUint32(0, 7, true);
    view.setUint16(4, 1, true);
    view.setUint16(6, 320, true);
    view.setUint16(8, 180, true);
    view.setUint32(12, 99, true);
    view.setFloat64(16, 1.5, true);
    expect(parseHeader(data)).toEqual({ robot: 7, camera: 1, width: 320, height: 180, sequence: 99, time: 1.5 });
    expect(parseHeader(new ArrayBuffer(24))).toBeNull();
  });
});

describe("charts", () => {
  it("keep peaks when they drop points", () => {
    const points = Array.from({ length: 5000 }, (_, x) => ({ x, y: x === 2501 ? 99 : Math.sin(x) }));
    const few = thin(points, 300);
    expect(few.length).toBeLessThanOrEqual(302);
    expect(few.some((p) => p.y === 99)).toBe(true);
    expect(few.every((p, k) => k === 0 || p.x > (few[k - 1]?.x ?? 0))).toBe(true);
    expect(few.at(-1)?.x).toBe(4999);
  });
  it("have round ticks and bounds that are never empty", () => {
    expect(ticks(0, 1, 4)).toEqual([0, 0.25, 0.5, 0.75, 1]);
    expect(ticks(0, 18, 3)).toEqual([0, 10]);
    expect(bounds([])).toEqual([0, 1]);
    expect(bounds([5, 5])[1]).toBeGreaterThan(5);
    expect(bounds([-2, 3])[0]).toBe(-2);
  });
  it("find the nearest point", () => {
    const points = [0, 1, 4, 9].map((x) => ({ x, y: 0 }));
    expect([nearest(points, -1), nearest(points, 2.4), nearest(points, 2.6), nearest(points, 99)]).toEqual([0, 1, 2, 3]);
  });
});
