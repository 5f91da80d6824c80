/** All robots with live pictures. Only those on the screen are watched. */

import { signal, type Signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { columnsFor } from "../fit";
import { LOOK_TEXT, reasonShort, reasonText } from "../modes";
import { Mode } from "../parts/Glyph";
import { Picture } from "../parts/Picture";
import { Ribbon } from "../parts/Ribbon";
import { fleet, me, now, robots, type Robot } from "../store";
import { clockSync } from "../store";
import { noStats, type ViewStats } from "../video";

type Size = "fit" | "s" | "m" | "l";
const FPS: Record<Size, number> = { fit: 10, s: 4, m: 8, l: 12 };
const KEY = "tutelage.wall";

function stored(): Size | null {
  try {
    const value = localStorage.getItem(KEY);
    return value === "fit" || value === "s" || value === "m" || value === "l" ? value : null;
  } catch {
    return null;
  }
}

const chosen = signal<Size | null>(stored());
const needyFirst = signal(false);
const camera = signal(0);

function choose(size: Size): void {
  chosen.value = size;
  try {
    localStorage.setItem(KEY, size);
  } catch {
    // private windows have no storage
  }
}

/** Robots that need somebody, by their place in the queue; then the others as they are numbered. */
function order(cells: Signal<Robot>[]): Signal<Robot>[] {
  if (!needyFirst.value) return cells;
  const weight = (robot: Robot): number => {
    if (robot.rank >= 0) return robot.rank;
    return robot.look === "auto" ? 1e6 : 1e5;
  };
  return [...cells].sort((a, b) => weight(a.value) - weight(b.value) || a.value.index - b.value.index);
}

export function Wall() {
  const count = robots.value.length;
  const size = chosen.value ?? "fit";
  const list = useRef<HTMLUListElement>(null);
  const [space, setSpace] = useState<[number, number] | null>(null);
  useEffect(() => {
    const measure = (): void => {
      const element = list.current;
      if (element) setSpace([element.clientWidth, window.innerHeight - element.getBoundingClientRect().top - window.scrollY - 20]);
    };
    const sized = new ResizeObserver(measure);
    if (list.current) sized.observe(list.current);
    window.addEventListener("resize", measure);
    return () => {
      sized.disconnect();
      window.removeEventListener("resize", measure);
    };
  }, []);
  const narrow = space !== null && space[0] < 700;
  const columns = space && size === "fit" ? (narrow ? 2 : columnsFor(count, ...space)) : null;
  const look = size === "fit" ? (narrow || (space && columns && space[0] / columns < 230) ? "m" : "l") : size;
  const cameras = fleet.value?.cameras ?? [];
  return (
    <section class="wall-section" aria-label="Robots">
      <div class="wall-bar">
        <h1 class="head">
          Robots <span class="count num">{count || ""}</span>
        </h1>
        {cameras.length > 1 ? (
          <label class="inline">
            <span class="quiet">Camera</span>
            <select value={camera.value} onChange={(event) => (camera.value = Number(event.currentTarget.value))}>
              {cameras.map((name, k) => (
                <option key={name} value={k}>
                  {name}
                </option>
              ))}
            </select>
          </label>
        ) : null}
        <label class="check">
          <input type="checkbox" checked={needyFirst.value} onChange={(event) => (needyFirst.value = event.currentTarget.checked)} />
          Who needs help first
        </label>
        <fieldset class="segments small" aria-label="Size of pictures">
          {(["fit", "s", "m", "l"] as const).map((value) => (
            <label key={value}>
              <input type="radio" name="size" checked={size === value} onChange={() => choose(value)} />
              <span>{value === "fit" ? "Fit" : value.toUpperCase()}</span>
            </label>
          ))}
        </fieldset>
      </div>
      <ul ref={list} class={`wall wall-${look}`} style={columns ? { gridTemplateColumns: `repeat(${columns}, minmax(0, 1fr))` } : undefined}>
        {order(robots.value).map((cell) => (
          <Tile key={cell.peek().index} cell={cell} fps={FPS[size]} camera={Math.min(camera.value, Math.max(0, cameras.length - 1))} />
        ))}
      </ul>
    </section>
  );
}

export function Tile({ cell, fps, camera }: { cell: Signal<Robot>; fps: number; camera: number }) {
  const robot = cell.value;
  const [stats] = useState(() => signal<ViewStats>(noStats()));
  const needs = robot.rank >= 0 || robot.look === "violated";
  const who = withWhom(robot);
  const quietLook = robot.look === "auto" || robot.look === "offline";
  return (
    <li class={`tile look-${robot.look} ${needs ? "tile-needs" : ""} ${quietLook ? "" : "tile-loud"}`}>
      <a href={`#/robot/${robot.index}`} aria-label={[robot.name, LOOK_TEXT[robot.look], who, needs ? reasonText(robot.reason) : ""].filter(Boolean).join(", ")}>
        <div class="tile-picture">
          <Picture robot={robot.index} camera={camera} fps={fps} priority={needs || robot.operator ? 1 : 0} label={`Picture of ${robot.name}`} stats={stats} />
          <Age stats={stats} />
        </div>
        <div class="tile-line">
          <span class="tile-name">{robot.name}</span>
          <Mode look={robot.look} note={who ?? (needs && robot.reason !== robot.look ? reasonShort(robot.reason) : undefined)} />
        </div>
        <Ribbon robot={robot.index} />
      </a>
    </li>
  );
}

/** Who has it, in words that follow its state: "Driven by you", "Violated · with ana". */
export function withWhom(robot: Robot): string | undefined {
  if (!robot.operator) return undefined;
  const person = robot.operator === me.value?.name ? "you" : robot.operator;
  return robot.look === "violated" || robot.look === "switching" ? `with ${person}` : `by ${person}`;
}

/** A picture that has stopped says so. */
function Age({ stats }: { stats: Signal<ViewStats> }) {
  const captured = stats.value.captured;
  if (captured === null) return <span class="tile-age">no picture yet</span>;
  if (fleet.value?.lockstep) return null; // the simulation waits for people, and so do its pictures
  const age = now.value + clockSync.offset - captured;
  return age > 3 ? <span class="tile-age tile-old">{age < 100 ? `${Math.round(age)} s old` : "old picture"}</span> : null;
}
