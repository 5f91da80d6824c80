/** Which pictures to ask for, and how large. Pure. */

export const MOST_STREAMS = 30;

/** A place on the page that wants to show a robot. */
export interface Wish {
  robot: number;
  camera: number;
  /** CSS pixels on the screen. */
  width: number;
  fps: number;
  /** Higher ones are watched first where there are too many. */
  priority: number;
  visible: boolean;
}

const SIZES: [number, number][] = [[160, 90], [320, 180], [640, 360], [960, 540]];

/** The smallest picture that fills so many CSS pixels sharply enough. */
export function sizeFor(cssWidth: number, density: number): [number, number] {
  const want = cssWidth * Math.min(density, 2) * 0.85;
  return SIZES.find(([width]) => width >= want) ?? [960, 540];
}

export interface Stream {
  robot: number;
  camera: number;
  width: number;
  height: number;
  fps: number;
}

/** What to watch: one stream for each robot and camera (the largest wish), the most important first; the rest by turns. */
export function choose(
  wishes: Iterable<Wish>,
  density: number,
  turn: number,
  most = MOST_STREAMS,
): Stream[] {
  const merged = new Map<string, Stream & { priority: number }>();
  for (const wish of wishes) {
    if (!wish.visible) continue;
    const [width, height] = sizeFor(wish.width, density);
    const key = `${wish.robot}/${wish.camera}`;
    const old = merged.get(key);
    if (old) {
      if (width > old.width) [old.width, old.height] = [width, height];
      old.fps = Math.max(old.fps, wish.fps);
      old.priority = Math.max(old.priority, wish.priority);
    } else {
      merged.set(key, { robot: wish.robot, camera: wish.camera, width, height, fps: wish.fps, priority: wish.priority });
    }
  }
  const all = [...merged.values()].sort((a, b) => b.priority - a.priority || a.robot - b.robot || a.camera - b.camera);
  let chosen = all;
  if (all.length > most) {
    // A third of the places goes round among the others, so that nobody's picture never comes.
    const first = all.filter((stream) => stream.priority > 0).slice(0, most - Math.ceil(most / 3));
    const rest = all.filter((stream) => !first.includes(stream));
    const places = most - first.length;
    const start = places ? (turn * places) % rest.length : 0;
    chosen = [...first, ...[...rest, ...rest].slice(start, start + places)];
  }
  return chosen.map(({ priority: _, ...stream }) => stream);
}
