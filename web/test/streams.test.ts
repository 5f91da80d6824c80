import { columnsFor } from "../src/fit";
import { describe, expect, it } from "vitest";
import { choose, sizeFor, type Wish } from "../src/streams";

const wish = (robot: number, more: Partial<Wish> = {}): Wish => ({ robot, camera: 0, width: 240, fps: 8, priority: 0, visible: true, ...more });

describe("what is watched", () => {
  it("is only what is seen", () => {
    expect(choose([wish(0), wish(1, { visible: false })], 1, 0).map((s) => s.robot)).toEqual([0]);
  });
  it("is one stream a robot and camera, as large and as fast as the greatest wish", () => {
    const streams = choose([wish(3), wish(3, { width: 900, fps: 20 }), wish(3, { camera: 1 })], 1, 0);
    expect(streams).toHaveLength(2);
    expect(streams[0]).toEqual({ robot: 3, camera: 0, width: 960, height: 540, fps: 20 });
  });
  it("is at most thirty: the important ones always, the others by turns", () => {
    const wishes = Array.from({ length: 100 }, (_, k) => wish(k, { priority: k === 77 ? 1 : 0 }));
    const seen = new Set<number>();
    for (let turn = 0; turn < 5; turn += 1) {
      const streams = choose(wishes, 1, turn);
      expect(streams).toHaveLength(30);
      expect(streams[0]?.robot).toBe(77);
      streams.forEach((stream) => seen.add(stream.robot));
    }
    expect(seen.size).toBe(100);
  });
  it("shows everybody now and then, even where all are important", () => {
    const wishes = Array.from({ length: 60 }, (_, k) => wish(k, { priority: 1 }));
    const seen = new Set<number>();
    for (let turn = 0; turn < 4; turn += 1) choose(wishes, 1, turn).forEach((stream) => seen.add(stream.robot));
    expect(seen.size).toBe(60);
  });
  it("is as sharp as the screen and not sharper", () => {
    expect(sizeFor(150, 1)).toEqual([160, 90]);
    expect(sizeFor(240, 2)).toEqual([640, 360]);
    expect(sizeFor(4000, 3)).toEqual([960, 540]);
  });
});

describe("the wall", () => {
  it("is as large as fits without scrolling, and never too small to see", () => {
    expect(columnsFor(1, 1100, 780)).toBe(1);
    expect(columnsFor(12, 1100, 780)).toBe(4);
    expect(columnsFor(4, 1100, 780)).toBe(2);
    expect(columnsFor(100, 1100, 780)).toBe(5);
    expect(columnsFor(100, 200, 780)).toBe(1);
  });
});
